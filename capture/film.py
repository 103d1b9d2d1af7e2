"""A recording in a file, by its name: a video, an image topic of an MCAP file, or an episode of a LeRobot data set.

film.mp4, film.mp4#t=10,20.5, drive.mcap#/front/image, pusht#episode_000003/observation.images.top

Videos are read here. Other recordings are read by cameras that an entry point of `splatnode.recordings` names.
"""

from __future__ import annotations

import errno
import heapq
import itertools
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol, TypeAlias
from urllib.parse import quote, unquote

from splatnode.capture import recording
from splatnode.capture.cameras import folder, video
from splatnode.capture.frame import Clock, DroppedFrame, Frame, Stamp
from splatnode.capture.image_file import UnusableImage, read_image_file
from splatnode.capture.image_header import exif_time, name_time, read_header
from splatnode.capture.process import plugins
from splatnode.capture.process.system import outlast
from splatnode.capture.process.text import LONGEST_NAME, digest_name, guard_untrusted, sanitize_name, sanitize_text
from splatnode.capture.rig import TOLERANCE_S, FrameSet, Rig, form_frame_sets

_MARK = "#"  # between a file and the part of it that is meant
# Seconds of a video from its first frame, the first of which is in it, as W3C's Media Fragments have it: t=10,20.5.
# No more digits than there are in the largest that a video has: more could be infinite.
_SECONDS = re.compile(r"t=(\d{1,9}(?:\.\d{0,9})?)?(?:,(\d{1,9}(?:\.\d{0,9})?))?", re.ASCII)


class RecordingReader(Protocol):
    """The interface of a camera that reads recordings of one kind, which is the name of its entry point."""

    Config: Callable[..., Any]  # of the camera
    stream: Callable[[Any], Iterator[Frame | DroppedFrame]]

    def is_recording(self, path: Path) -> bool:
        """Whether this file or folder, by its name or by what lies in it, is of this kind."""
        ...

    def configure_part(self, path: Path, part: str) -> dict[str, Any]:
        """The camera's configuration for this part of it; an empty part means all."""
        ...

    def explain_many(self, path: Path) -> str | None:
        """Why this recording is no film as a whole, and what to name; None where it is one."""
        ...

    def list_cameras(self, path: Path, part: str) -> Sequence[tuple[Sequence[str], str]] | None:
        """The cameras of this part, each by its name in segments and its own part; None where it is one camera's.

        Raises ValueError where several cameras are those of another part.
        """
        ...

    def read_rig(self, path: Path, parts: Mapping[str, str]) -> Rig | None:
        """Returns where cameras stand to each other, by the part of each; None where such a recording does not tell it.

        Raises ValueError where this one does not tell it.
        """
        ...


def find_reader(path: Path) -> tuple[str, RecordingReader] | None:
    """The kind of camera that reads this file or folder, and its module; None where it is a video, or no recording.

    Raises BrokenPlugin.
    """
    for kind, entry in plugins.entry_points(plugins.RECORDINGS).items():
        reader: RecordingReader = entry.load()
        if reader.is_recording(path):
            return kind, reader
    return None


def file_and_part(path: Path) -> tuple[Path, str]:
    """The file or the data set, and what of it is meant; all where that is empty.

    A file whose own name has a # is itself.
    """
    if _is_there(path):
        return path, ""
    text = str(path)
    for place in (place for place, letter in enumerate(text) if letter == _MARK):
        file = Path(text[:place])
        if _is_there(file) and (file.is_file() or find_reader(file) is not None):
            return file, unquote(text[place + 1 :])
    return path, ""


def _is_there(path: Path) -> bool:
    """Whether a path leads somewhere; one that is too long for the system does not."""
    try:
        return path.exists()
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        return False


def part_of(file: Path, part: str) -> Path:
    """The path by which `file_and_part` finds this part, whatever characters it has."""
    plain = f"{file}{_MARK}{quote(part, safe='/')}"
    return Path(plain if os.path.normpath(plain) == plain else f"{file}{_MARK}{quote(part, safe='')}")


def is_film(path: Path) -> bool:
    """Whether this is a file, or a part of one or of a data set, and not a folder."""
    file, part = file_and_part(path)
    return bool(part) or (_is_there(file) and file.is_file())


def camera(path: Path) -> tuple[str, dict[str, Any]]:
    """The kind of camera that gives its frames, and its configuration.

    Raises ValueError for a part of a video that is no range of seconds.
    """
    kind, _, camera_config = _find_camera(path)
    return kind, camera_config


def _find_camera(path: Path) -> tuple[str, Any, dict[str, Any]]:
    """As `camera`, with the module between."""
    file, part = file_and_part(path)
    if (found := find_reader(file)) is not None:
        kind, reader = found
        return kind, reader, reader.configure_part(file, part)
    return "video", video, {"file": file, **(_parse_seconds(file, part) if part else {})}


def _parse_seconds(file: Path, part: str) -> dict[str, float]:
    """From when to when a part of a video is. Raises ValueError."""
    found = _SECONDS.fullmatch(part)
    bounds = {} if found is None else {"start_s": found[1], "end_s": found[2]}
    span = {name: float(text) for name, text in bounds.items() if text}
    if not span or span.get("start_s", 0.0) >= span.get("end_s", math.inf):
        raise ValueError(
            f"{sanitize_text(str(file))!r}: behind the # must be seconds of the video, the first before the last, "
            "such as "
            f"#t=10,20.5, #t=10 or #t=,20.5; got {sanitize_text(part, 100)!r}. Of an MCAP file it is a topic"
        )
    return span


def stream(path: Path) -> Iterator[Frame | DroppedFrame]:
    """Its frames. Raises FileNotFoundError, or ValueError where they cannot be had."""
    _, module, camera_config = _find_camera(path)
    return module.stream(module.Config(**camera_config))


# Several cameras of one robot as one stream: a folder or a film of each, their images in the order of their times.
#
# Each image has the id of its camera, and a name that begins with it: left/0001.jpg. Images that were taken together
# come one after the other, as a frame set.

ALL = "all"  # in place of the names of cameras


@dataclass(frozen=True)
class CameraSource:
    """The images of one camera: a folder of photographs, or a film."""

    camera_id: str
    path: Path


@dataclass(frozen=True)
class CameraSet:
    """Cameras that looked at one place at the same time. Raises ValueError for fewer than two, or two of one id."""

    cameras: tuple[CameraSource, ...]
    tolerance_s: float = TOLERANCE_S  # between images that were taken together

    def __post_init__(self) -> None:
        ids = [camera.camera_id for camera in self.cameras]
        if len(ids) < 2 or len(set(ids)) < len(ids):
            raise ValueError(f"several cameras must be two or more, each with its own name; got {', '.join(ids)}")
        if len({is_film(camera.path) for camera in self.cameras}) > 1:
            raise ValueError("cameras must be all folders of photographs, or all films; they have no common time else")

    @property
    def is_film(self) -> bool:
        return is_film(self.cameras[0].path)

    @property
    def folder(self) -> Path | None:
        """The folder in which the names of the frames are those of their files; None: there is none."""
        parents = {camera.path.resolve().parent for camera in self.cameras}
        named = all(camera.path.name == camera.camera_id for camera in self.cameras)
        return self.cameras[0].path.parent if len(parents) == 1 and named and not self.is_film else None

    def find_rig(self) -> Rig | None:
        """Returns where the cameras stand to each other, as their one recording tells; None: they have none that may.

        Raises as the recording's reader does.
        """
        parts = {camera.camera_id: file_and_part(camera.path) for camera in self.cameras}
        files = {file for file, _ in parts.values()}
        found = find_reader(min(files)) if len(files) == 1 else None
        return found and found[1].read_rig(min(files), {camera_id: part for camera_id, (_, part) in parts.items()})

    def form_frame_sets(self, names: Sequence[str] = ()) -> Sequence[FrameSet]:
        """Returns which photographs of folders, all or those called `names`, were taken together, in their order.

        Raises ValueError where one of the names is none, and what reading the folders raises.
        """
        return self._form_frame_sets(_select_times(self._times, names))

    @cached_property
    def _times(self) -> _Times:
        """The time of each photograph of the folders, whose files are read once for it."""
        return _list_times(self.cameras)

    def _form_frame_sets(self, times: _Times) -> Sequence[FrameSet]:
        timed = ((join_name(*key), key[0], stamp) for key, stamp in times.items())
        return form_frame_sets(timed, self.tolerance_s)

    def stream(self, names: Sequence[str] = ()) -> Iterator[Frame | DroppedFrame]:
        """The frames of all cameras, or of folders those called `names`; frame sets one after the other.

        Raises as the streams of its cameras do.
        """
        frames = self._stream_films() if self.is_film else self._stream_folders(names)
        frame_id, last_ns, first_ns = 0, 0, None
        for each in frames:
            if isinstance(each, Frame):
                first_ns = each.stamp_ns if first_ns is None else first_ns
                last_ns = max(last_ns, each.stamp_ns - first_ns)
                each = replace(each, frame_id=frame_id, stamp_ns=last_ns)
                frame_id += 1
            yield each

    def _stream_films(self) -> Iterator[Frame | DroppedFrame]:
        """The frames by their times; by those of their streams where the cameras' clocks are different ones."""
        streams, clocks = [], set()
        for camera in self.cameras:
            frames, before = iter(stream(camera.path)), []
            for each in frames:
                before.append(each)
                if isinstance(each, Frame):
                    clocks.add(each.captured_at and each.captured_at.clock)
                    break
            streams.append((camera.camera_id, itertools.chain(before, frames)))
        by_clock = len(clocks) == 1 and None not in clocks
        timed = [_time_frames(camera_id, frames, by_clock) for camera_id, frames in streams]
        for _, each in heapq.merge(*timed, key=lambda pair: pair[0]):
            yield each

    def _stream_folders(self, names: Sequence[str]) -> Iterator[Frame | DroppedFrame]:
        times = _select_times(self._times, names)
        streams = {}
        for camera in self.cameras:
            files = tuple(file for camera_id, file in times if camera_id == camera.camera_id)
            if files:
                config = folder.Config(folder=camera.path, names=files if names else ())
                name_item = partial(_name_item, camera_id=camera.camera_id)
                streams[camera.camera_id] = map(name_item, folder.stream(config))
        stamps = {join_name(*key): stamp for key, stamp in times.items()}
        held: dict[str, Frame | DroppedFrame] = {}  # that came before their turn
        for each in self._form_frame_sets(times):
            for camera_id, name in sorted(each.names.items()):
                while name not in held and (item := next(streams[camera_id], None)) is not None:
                    held[item.name] = item
                item = held.pop(name, None)
                if isinstance(item, Frame):
                    item = replace(item, captured_at=stamps[name], stamp_ns=each.stamp.ns)
                if item is not None:
                    yield item
        yield from itertools.chain(held.values(), *streams.values())


def join_name(camera_id: str, name: str) -> str:
    """Returns the name of a camera's frame among those of several cameras."""
    joined = f"{camera_id}/{name}"
    return joined if len(joined) <= LONGEST_NAME else digest_name(joined)


def _name_item(item: Frame | DroppedFrame, camera_id: str, name: str = "") -> Frame | DroppedFrame:
    """The item with the name and the camera id of one of several cameras."""
    named = replace(item, name=join_name(camera_id, name or item.name))
    return replace(named, camera_id=camera_id) if isinstance(named, Frame) else named


def _time_frames(
    camera_id: str, frames: Iterator[Frame | DroppedFrame], by_clock: bool
) -> Iterator[tuple[int, Frame | DroppedFrame]]:
    """The frames of a film, each with its time in nanoseconds; what is no frame comes with the frame before it."""
    last_ns = 0
    for each in frames:
        item = _name_item(each, camera_id, each.name.rpartition("_")[2])
        if isinstance(item, Frame):
            stamp = item.captured_at if by_clock else None
            stamp = stamp or Stamp(item.stamp_ns, Clock.RECORDING)
            last_ns = max(last_ns, stamp.ns)
            item = replace(item, captured_at=stamp, stamp_ns=last_ns)
        yield last_ns, item


# The times of photographs in folders: by their files, without decoding them.

_Times: TypeAlias = "Mapping[tuple[str, str], Stamp]"  # by a camera's id and a photograph's name


def _list_times(cameras: Sequence[CameraSource]) -> dict[tuple[str, str], Stamp]:
    """The time of each photograph by its camera's id and its name.

    Where not all have a time of one clock, or those of one camera have the same, times do not tell which were taken
    together: those of one name were, then, ten a second.
    """
    stamps: dict[tuple[str, str], Stamp | None] = {}
    for camera in cameras:
        stamps |= {(camera.camera_id, name): stamp for name, stamp in _read_times(camera.path).items()}
    known = {key: stamp for key, stamp in stamps.items() if stamp is not None}
    one_clock = len({stamp.clock for stamp in known.values()}) == 1
    are_distinct = len({(camera_id, stamp.ns) for (camera_id, _), stamp in known.items()}) == len(stamps)
    if one_clock and are_distinct:
        return known
    stems = sorted({Path(name).stem for _, name in stamps}, key=lambda stem: folder.natural_order(Path(stem)))
    places = {stem: place for place, stem in enumerate(stems)}
    step = folder.DEFAULT_STEP_NS
    return {key: Stamp(places[Path(key[1]).stem] * step, Clock.RECORDING) for key in stamps}


def _select_times(times: _Times, names: Sequence[str]) -> _Times:
    """Those of the photographs called `names`, with or without suffix; all where there are none. Raises ValueError."""
    if not names:
        return times
    called = {key: {join_name(*key), join_name(*key).rpartition(".")[0]} for key in times}
    known = {name for own in called.values() for name in own}
    if missing := sorted(set(names) - known):
        raise ValueError(
            f"no photograph named {', '.join(map(sanitize_text, missing[:5]))}: of several cameras a photograph is "
            f"named with its camera, such as {join_name(*min(times))}"
        )
    return {key: stamp for key, stamp in times.items() if not called[key].isdisjoint(names)}


def _read_times(path: Path) -> dict[str, Stamp | None]:
    """The time of each photograph of a folder by its name; None where nothing tells it. Raises as a folder does."""
    if recording.is_recording(path):
        lines = recording.read(path).lines
        return {line.name: getattr(line, "captured_at", None) for line in lines if hasattr(line, "stamp_ns")}
    files = folder.select_images(path)
    return {folder.frame_name(file): name_time(file.name) or _read_exif_time(file) for file in files}


def _read_exif_time(file: Path) -> Stamp | None:
    """None where the file cannot be read: it is named when its turn comes."""
    try:
        data = outlast(lambda: read_image_file(file), folder.frame_name(file))
        with guard_untrusted(UnusableImage):
            return exif_time(read_header(data).exif)
    except (UnusableImage, OSError):
        return None


# Which cameras there are: in a folder, an MCAP file, an episode of a data set, or one for each path that is given.


def find_cameras(path: Path) -> tuple[CameraSource, ...]:
    """The cameras of one source: the folders in a folder, the image topics of an MCAP file, the cameras of an episode.

    Raises ValueError where the source has one camera alone, FileNotFoundError, and what reading the source raises.
    """
    file, part = file_and_part(path)
    shown = repr(sanitize_text(str(path)))
    if not part and not file.exists():
        raise FileNotFoundError(f"{shown} is not there; give a folder with a folder of each camera, or a film of each")
    found = find_reader(file)
    if found is not None and (listed := found[1].list_cameras(file, part)) is not None:
        return _name_cameras([name for name, _ in listed], [part_of(file, each) for _, each in listed])
    if not part and file.is_dir():
        return _find_folders(file, shown)
    raise ValueError(
        f"{shown} has one camera; give a folder with a folder of each camera, an MCAP file, an episode of a data set, "
        "or a film of each camera"
    )


def _find_folders(path: Path, shown: str) -> tuple[CameraSource, ...]:
    if recording.is_recording(path) or folder.image_paths(path):
        raise ValueError(
            f"{shown} has photographs beside the folders of its cameras; give a folder that has a folder of each "
            "camera and nothing else"
        )
    inside = sorted(child for child in path.iterdir() if child.is_dir() and not child.name.startswith("."))
    inside = [child for child in inside if recording.is_recording(child) or folder.image_paths(child)]
    return tuple(CameraSource(sanitize_name(child.name), child) for child in inside)


def select_cameras(
    paths: Sequence[Path], wanted: Sequence[str] = (ALL,), tolerance_s: float = TOLERANCE_S
) -> CameraSet:
    """The cameras that the command line names: those of one source that are `wanted`, or one of each path.

    Of several paths `wanted` are their names, in their order; of one source the ids of its cameras, or the names of its
    topics or keys. Raises as `find_cameras`, and ValueError where there is no such camera.
    """
    if len(paths) > 1:
        return CameraSet(_name_paths(paths, wanted), tolerance_s)
    there = find_cameras(paths[0])
    if tuple(wanted) == (ALL,):
        chosen = there
    else:
        chosen = tuple(camera for name in wanted for camera in there if name in _names_of(camera))
        known = {name for camera in there for name in _names_of(camera)}
        if unknown := [name for name in wanted if name not in known]:
            ids = ", ".join(camera.camera_id for camera in there) or "none"
            raise ValueError(f"there is no camera {', '.join(map(sanitize_text, unknown))}; there are: {ids}")
    if len(chosen) < 2:
        ids = ", ".join(camera.camera_id for camera in there) or "none"
        raise ValueError(
            f"{str(paths[0])!r} must have two cameras or more that are used together, it has: {ids}. Leave --cameras "
            "out for one camera"
        )
    return CameraSet(chosen, tolerance_s)


def _names_of(camera: CameraSource) -> set[str]:
    """Returns the names by which a camera may be called: its id, and its topic, or its key in a data set."""
    _, part = file_and_part(camera.path)
    return {camera.camera_id, part, part.lstrip("/"), part.partition("/")[2]} - {""}


def _name_paths(paths: Sequence[Path], wanted: Sequence[str]) -> tuple[CameraSource, ...]:
    for path in paths:
        if not is_film(path) and not path.is_dir():
            raise FileNotFoundError(
                f"{str(path)!r} is not there; give a folder of photographs or a film of each camera"
            )
    if tuple(wanted) != (ALL,):
        if len(wanted) != len(paths):
            raise ValueError(f"--cameras must name each of the {len(paths)} sources in their order, got {len(wanted)}")
        return tuple(
            CameraSource(sanitize_name(name.replace("/", "_")), path) for name, path in zip(wanted, paths, strict=True)
        )
    split = []
    for path in paths:
        file, part = file_and_part(path)
        behind = [segment for segment in part.replace("/", ".").split(".") if segment]
        split.append([*file.resolve().parent.parts, file.stem if file.is_file() else file.name, *behind])
    return _name_cameras(split, paths)


def _name_cameras(split: Sequence[Sequence[str]], paths: Sequence[Path]) -> tuple[CameraSource, ...]:
    """Cameras that are called by what of their names, split into segments, tells them from each other."""
    prefix = _common(split)
    suffix = _common([each[prefix:][::-1] for each in split])
    names = ["_".join(each[prefix : len(each) - suffix]) for each in split]
    if not all(names):
        names = ["_".join(each) for each in split]
    return tuple(CameraSource(sanitize_name(name), path) for name, path in zip(names, paths, strict=True))


def _common(split: Sequence[Sequence[str]]) -> int:
    """How many segments all begin with; none where there is one alone."""
    if len(split) < 2:
        return 0
    columns = zip(*split, strict=False)
    different = (place for place, segments in enumerate(columns) if len(set(segments)) > 1)
    return next(different, min(map(len, split)))
