"""What is reconstructed offline: a folder of photographs, some of its photographs, a recording, a film, or frames.

A film is a video, an image topic of an MCAP file, or an episode of a LeRobot data set, by the name that `film` knows.
Of several cameras there is a folder or a film each; what they took together is used, or left out, as one.
"""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture import film
from splatnode.capture.cameras import folder
from splatnode.capture.cameras.folder import find_photographs
from splatnode.capture.depth_image import DepthImage, find_depth_files, read_depth_file
from splatnode.capture.film import ALL as EVERY_CAMERA
from splatnode.capture.film import CameraSet, select_cameras
from splatnode.capture.frame import DroppedFrame, Frame, make_given_pose
from splatnode.capture.image_file import UnusableImage, encode_png
from splatnode.capture.keyframe_selection import THINNED, Choice, Config, Limits, choose, group_frame_sets
from splatnode.capture.lenses import Lenses, describe_image
from splatnode.capture.masks import Find, mask_frames, open_masks
from splatnode.capture.process.terminal import Tell, ignore_progress, notify, report_items
from splatnode.capture.process.text import sanitize_name, sanitize_text
from splatnode.capture.rig import MOUNT_SIGMA_DEG, MOUNT_SIGMA_M, TOLERANCE_S, Rig, RigCamera, form_frame_sets, read_rig
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.config import ReconstructionConfig as Reconstruction
from splatnode.recon.metric.metres import NOTHING, Evidence

Array = npt.NDArray[np.float64]

ALL = 30  # photographs of a folder that are all used; of more, keyframes are chosen
MOST = 60  # keyframes of a video, or of a folder of more photographs
EVERY = 300  # frames of a video, where all that are sharp and no copies are asked for
IMAGES = "images"  # in the result folder: the keyframes of a video

_OF_PHOTOGRAPHS = Config(max_fps=1e9, patience_s=0.0)  # which were not taken at any rate


@dataclass(frozen=True)
class Request:
    """A request for a reconstruction: which images, masks and lens."""

    source: Path  # a folder, or a film
    listed: tuple[str, ...] = ()  # the photographs of the folder that were named; none: all
    views: int | None = None  # so many of them, evenly spread
    frames: tuple[str, ...] = ()  # those of the folder with these names
    every_frame: bool = False  # all that are sharp and no copies
    masks: Path | None = None  # a folder of masks, or one for all; None: photographs are used whole
    lenses: Lenses | None = None  # in place of what EXIF tells
    cameras: CameraSet | None = None  # that `source` has, or is the first of; None: it is one camera's

    @property
    def is_film(self) -> bool:
        return film.is_film(self.source) if self.cameras is None else self.cameras.is_film

    @property
    def tolerance_s(self) -> float:
        return TOLERANCE_S if self.cameras is None else self.cameras.tolerance_s

    @property
    def photographs(self) -> Path | None:
        """The folder in which frames lie by their names; None: they lie in none."""
        if self.is_film:
            return None
        return find_photographs(self.source) if self.cameras is None else self.cameras.folder


@dataclass(frozen=True, eq=False)
class Source:
    """The frames to reconstruct, in their order, and where they come from."""

    frames: tuple[Frame | DroppedFrame, ...]
    photographs: Path | None  # the folder that they lie in; None: they lie in none, as a film's
    choice: Choice | None  # None: all that were asked for are used
    cameras: CameraSet | None = None  # whose they are; None: they are one camera's, or no source tells

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(width, height) of each frame."""
        return [(frame.width, frame.height) for frame in self.frames if isinstance(frame, Frame)]

    @property
    def further_bytes(self) -> int:
        """Bytes that `files` has at most."""
        return 0 if self.photographs else sum(3 * width * height for width, height in self.sizes)

    def files(self) -> dict[str, bytes]:
        """The frames as files of the result folder, by their names in it; none where they lie in a folder already."""
        frames = () if self.photographs else self.frames
        return {f"{IMAGES}/{each.name}": _encode_image(each) for each in frames if isinstance(each, Frame)}


def _encode_image(frame: Frame) -> bytes:
    """The file of a frame that has no place of its own: as it came where its name says so, else PNG."""
    return encode_png(frame.image) if frame.encoded is None or not frame.camera_id else frame.encoded


@dataclass(frozen=True, eq=False)
class ReplayRecording:
    """All keyframes of a recording, which are read again when they are needed."""

    request: Request
    choice: Choice
    images: frozenset[tuple[str, str, str, int, int]] = frozenset()  # as `Lenses.check` asks of all that there are
    # Of poses and motions that came with images one each, if there is any, and a mount of each camera, by its id
    evidence: Evidence = NOTHING
    has_depth: bool = False  # some images came with a right image or a depth image

    @property
    def path(self) -> Path:
        return self.request.source

    @property
    def photographs(self) -> Path | None:
        """The folder in which the keyframes lie; None: they lie in none, as a film's."""
        return self.request.photographs

    def identity(self, config: Reconstruction, rig: Rig | None = None) -> str:
        """32 hexadecimal digits that tell it, reconstructed in this way, its cameras on this rig, from others.

        Of a folder the names count: it may hold the results, too, which change when it was last written.
        """
        request, cameras = self.request, self.request.cameras
        written_ns = film.file_and_part(self.path)[0].stat().st_mtime_ns if request.is_film else 0
        known = [str(self.path.resolve()), written_ns, self.choice.names, config]
        if request.masks is not None:
            known.append(str(request.masks.resolve()))
        if request.lenses is not None:
            known.append(request.lenses)
        if rig is not None:
            known.append(rig)
        if cameras is not None:
            known += [[each.camera_id, str(each.path.resolve())] for each in cameras.cameras]
            known.append(cameras.tolerance_s)
        return hashlib.sha256(msgspec.json.encode(known)).hexdigest()[:32]

    def frames(self) -> Iterator[Frame | DroppedFrame]:
        """The keyframes in their order, and what the recording could not give."""
        names, masks = set(self.choice.names), self.request.masks
        streamed = _stream(self.request)
        chosen = (each for each in streamed if isinstance(each, DroppedFrame) or each.name in names)
        if self.request.lenses is not None:
            chosen = map(self.request.lenses.apply, chosen)
        return chosen if masks is None else mask_frames(chosen, open_masks(masks))


def parse_paths(paths: Sequence[Path]) -> tuple[Path, tuple[str, ...]]:
    """The folder or the video that the command line names, and the photographs of that folder; none of these: all.

    Raises ValueError where several are named that are not photographs of one folder.
    """
    (first, *others) = paths
    if not others and not (first.suffix.lower() in folder.SUFFIXES | folder.FOREIGN_SUFFIXES and first.is_file()):
        return first, ()
    for path in paths:
        if path.is_dir():
            raise ValueError(f"{str(path)!r} is a folder; give one folder alone, or photographs of one")
        if not path.is_file():
            raise FileNotFoundError(f"{str(path)!r} is not there; give a folder, a video, or photographs of one folder")
        if path.parent.resolve() != first.parent.resolve():
            raise ValueError(f"{str(path)!r} lies in another folder than {str(first)!r}; put them into one folder")
    return first.parent, tuple(folder.name_photographs(paths))


def parse_sources(
    paths: Sequence[Path], cameras: Sequence[str] | None = None, tolerance_s: float = TOLERANCE_S
) -> tuple[Path, tuple[str, ...], CameraSet | None]:
    """As `parse_paths`, and the cameras: those called `cameras`, or one of each of several folders or films.

    Raises as `parse_paths` and `select_cameras`.
    """
    several = len(paths) > 1 and all(path.is_dir() or _is_film(path) for path in paths)
    if cameras or several:
        return paths[0], (), select_cameras(paths, cameras or (EVERY_CAMERA,), tolerance_s)
    return *parse_paths(paths), None


def _is_film(path: Path) -> bool:
    """Whether this is a film, and no photograph, which is a file, too."""
    _, part = film.file_and_part(path)
    return bool(part) or (path.is_file() and path.suffix.lower() not in folder.SUFFIXES | folder.FOREIGN_SUFFIXES)


def select_frames(
    frames: Sequence[Frame],
    views: int | None = None,
    every_frame: bool = False,
    tell: Tell = ignore_progress,
    tolerance_s: float = TOLERANCE_S,
) -> Source:
    """Photographs that lie in no folder, or what is used of them: as of a folder's. Of several cameras by frame sets.

    Raises ValueError as `load_source`.
    """
    if any(frame.camera_id and frame.captured_at for frame in frames):
        frames = _sort_by_sets(frames, tolerance_s)
        if views:
            _check_enough(views, len(frames))
            sets = [each for each in group_frame_sets(frames, tolerance_s) if isinstance(each, tuple)]
            return Source(_select_sets(sets, views), None, None)
    if views:
        return Source(tuple(frames[i] for i in _select_evenly(views, len(frames))), None, None)
    if every_frame or len(frames) <= ALL:
        return Source(tuple(frames), None, None)
    looked_through = report_items(frames, tell, "choosing keyframes", len(frames), "photograph")
    choice = choose(looked_through, _OF_PHOTOGRAPHS, Limits(), MOST, "photograph", tolerance_s)
    return Source((*choice.keyframes, *choice.dropped), None, choice)


def _sort_by_sets(frames: Sequence[Frame], tolerance_s: float) -> list[Frame]:
    """The frames in the order of their frame sets, then those that are in none."""
    by_name = {frame.name: frame for frame in frames}
    timed = [(frame.name, frame.camera_id, frame.captured_at) for frame in frames if frame.captured_at is not None]
    names = [name for each in form_frame_sets(timed, tolerance_s) for name in each.names.values()]
    alone = [frame.name for frame in frames if frame.name not in set(names)]
    ordered = [by_name[name] for name in (*names, *alone)]
    stamps = sorted(frame.stamp_ns for frame in frames)
    return [replace(frame, frame_id=i, stamp_ns=ns) for i, (frame, ns) in enumerate(zip(ordered, stamps, strict=True))]


def load_recording(request: Request, tell: Tell = ignore_progress) -> ReplayRecording:
    """As `load_source`, without a limit to the number of keyframes."""
    _check_there(request)
    images: set[tuple[str, str, str, int, int]] = set()
    came: dict[str, dict[str, Any]] = {"tracked": {}, "motions": {}, "mounts": {}}
    beside: set[str] = set()
    looked_through = _record_content(_stream_candidates(request, tell), images, came, beside)
    choice = choose(looked_through, _selection(request), Limits(), None, _unit_name(request), request.tolerance_s)
    if request.lenses is not None:
        request.lenses.check(images)
    evidence = Evidence(tracked=came["tracked"], motions=came["motions"], mounts=came["mounts"])
    return ReplayRecording(request, choice, frozenset(images), evidence, has_depth=bool(beside))


def load_source(request: Request, tell: Tell = ignore_progress) -> Source:
    """The frames that are asked for; `tell` hears how far the reading is.

    Raises FileNotFoundError and ValueError where there is nothing that can be used.
    """
    _check_there(request)
    found = replace(_load_unmasked(request, tell), cameras=request.cameras)
    if request.lenses is not None:
        found = apply_lenses(found, request.lenses)
    return found if request.masks is None else apply_masks(found, open_masks(request.masks), tell)


def apply_lenses(given: Source, lenses: Lenses) -> Source:
    """Returns the frames, each with its lens. Raises ValueError where a lens is of none of them."""
    lenses.check(describe_image(each) for each in given.frames if isinstance(each, Frame))
    return replace(given, frames=tuple(map(lenses.apply, given.frames)))


def add_poses(
    given: Source,
    poses: Mapping[str, Array],
    sigmas: tuple[float, float] | None,
    own: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> Source:
    """The frames, each with its pose of `poses` (4, 4), metres, by their names, and its sigmas, metres and degrees.

    `sigmas` are of those poses that have none of their `own`. Raises ValueError where neither tells a pose's.
    """

    def add_pose(frame: Frame | DroppedFrame) -> Frame | DroppedFrame:
        if not isinstance(frame, Frame) or frame.name not in poses:
            return frame
        pose_sigmas = own.get(frame.name, sigmas)
        if pose_sigmas is None:
            raise ValueError(
                f"some poses tell how unsure they are, and that of {sanitize_name(frame.name)} does not: tell it for "
                "each, or give --poses-sigma (poses_sigma) for those that do not"
            )
        try:
            return replace(frame, given_pose=make_given_pose(poses[frame.name], *pose_sigmas))
        except ValueError as error:
            raise ValueError(f"{sanitize_name(frame.name)}: {error}") from error

    return replace(given, frames=tuple(map(add_pose, given.frames)))


def add_depth_folder(given: Source, folder: Path) -> Source:
    """The frames, each with the depth image of its name in the folder.

    Raises FileNotFoundError, OSError, and ValueError where a file is no depth image, or none has the name of a frame.
    """
    files = find_depth_files(folder, [frame.name for frame in given.frames])

    def find(frame: Frame) -> DepthImage | None:
        if frame.name not in files:
            return None
        try:
            return read_depth_file(files[frame.name])
        except UnusableImage as error:
            raise ValueError(f"{sanitize_text(str(files[frame.name]))}: {error}") from error

    return attach_depths(given, find)


def attach_depths(given: Source, find: Callable[[Frame], DepthImage | None]) -> Source:
    """The frames, each with the depth image that is found for it. Raises ValueError where it cannot be its."""

    def attach(frame: Frame | DroppedFrame) -> Frame | DroppedFrame:
        depth = find(frame) if isinstance(frame, Frame) else None
        if depth is None or not isinstance(frame, Frame):
            return frame
        try:
            return replace(frame, depth=depth)
        except ValueError as error:
            raise ValueError(f"the depth image of {sanitize_name(frame.name)}: {error}") from error

    return replace(given, frames=tuple(map(attach, given.frames)))


def apply_masks(given: Source, find: Find, tell: Tell = ignore_progress) -> Source:
    """The frames, each with the mask that is found for it. Raises UnusableMask where one cannot be its mask."""
    return replace(given, frames=tuple(mask_frames(given.frames, find, tell)))


def _load_unmasked(request: Request, tell: Tell) -> Source:
    if request.is_film:
        if request.frames:
            raise ValueError("--frames names photographs of a folder; of a video, give --views N or nothing")
        return _select_keyframes(request, tell)
    names, there = _names(request), _list_photographs(request)
    if names or request.every_frame or len(_skip_raw_files(there)) <= ALL:
        of = len(names or there)
        frames = report_items(_stream(request, names), tell, "reading", of, "photograph")
        return Source(tuple(frames), request.photographs, None)
    return _select_keyframes(request, tell)


def _check_there(request: Request) -> None:
    path = request.source
    if request.cameras is not None:  # they were found
        return
    if not path.exists() and re.match(r"[a-z]+:/+", str(path)):
        raise ValueError(f"{str(path)!r} is an address; nothing is fetched: download it first and give the file")
    if not path.exists() and not film.is_film(path):
        raise FileNotFoundError(
            f"{str(path)!r} is not there; give a folder that holds photographs, a video, or an MCAP file"
        )
    found = film.find_reader(path) if path.is_dir() else None
    if found is not None and (why := found[1].explain_many(path)) is not None:
        raise ValueError(why)


def _list_photographs(request: Request) -> Sequence[str]:
    """The names of the photographs that there are to choose from; of several cameras by frame sets, in their order."""
    if request.cameras is not None:
        return [name for each in request.cameras.form_frame_sets() for name in each.names.values()]
    return request.listed or folder.names_in(request.source)


def _skip_raw_files(names: Sequence[str]) -> Sequence[str]:
    """Without raw files, beside which their cameras put photographs; all where there is nothing else."""
    return [name for name in names if folder.explain_unreadable_file(Path(name)) is None] or names


def _stream(request: Request, names: tuple[str, ...] = ()) -> Iterator[Frame | DroppedFrame]:
    if request.cameras is not None:
        return request.cameras.stream(names)
    if request.is_film:
        return film.stream(request.source)
    return folder.stream(folder.Config(folder=request.source, names=names or request.listed))


def _stream_candidates(request: Request, tell: Tell) -> Iterator[Frame | DroppedFrame]:
    """All that there is to choose from; how many frames a video has is known at its end."""
    of = 0 if request.is_film else len(_list_photographs(request))
    doing = f"choosing keyframes of {sanitize_name(request.source.name)}"
    return report_items(_stream(request), tell, doing, of, _unit_name(request))


def _record_content(
    frames: Iterator[Frame | DroppedFrame],
    images: set[tuple[str, str, str, int, int]],
    came: Mapping[str, dict[str, Any]],
    beside: set[str],
) -> Iterator[Frame | DroppedFrame]:
    """The frames, whose names, cameras and sizes are added to `images` as they pass.

    The first pose and motion that there is go to `came`, as `Evidence` has them, the first mount of each camera by its
    id, and the names of frames that have a right or a depth image to `beside`.
    """
    for each in frames:
        if isinstance(each, Frame):
            images.add(describe_image(each))
            for kind, value in (("tracked", each.given_pose), ("motions", each.motion)):
                if value is not None and not came[kind]:
                    came[kind][each.name] = value
            if each.mount is not None:
                came["mounts"].setdefault(each.camera_id, each.mount)
            if each.right is not None or each.depth is not None:
                beside.add(each.name)
        yield each


def _unit_name(request: Request) -> str:
    """One of those that keyframes are chosen of."""
    return "frame" if request.is_film else "photograph"


def _selection(request: Request) -> Config:
    config = Config() if request.is_film else _OF_PHOTOGRAPHS
    return msgspec.structs.replace(config, every_frame=request.every_frame)


def _select_keyframes(request: Request, tell: Tell) -> Source:
    """The keyframes of a recording; with --views N so many, evenly spread: thinning leaves half of the most."""
    most = EVERY if request.every_frame else max(MOST, 2 * (request.views or 0))
    candidates, unit = _stream_candidates(request, tell), _unit_name(request)
    choice = choose(candidates, _selection(request), Limits(), most, unit, request.tolerance_s)
    frames = choice.keyframes
    if request.every_frame and THINNED in choice.left_out:
        raise ValueError(
            f"{sanitize_name(request.source.name)!r} has more than {EVERY} frames that are sharp and no copies, which "
            "is more than one scene takes. Leave --every-frame out to use keyframes, or add --map for a map of all"
        )
    if request.views:
        if request.views > len(frames):
            raise ValueError(f"{request.views} views are asked for: {choice}; ask for at most as many")
        sets = [each for each in group_frame_sets(frames, request.tolerance_s) if isinstance(each, tuple)]
        frames = _select_sets(sets, request.views)
    return Source((*frames, *choice.dropped), request.photographs, choice)


_Each = TypeVar("_Each")


def _select_sets(sets: Sequence[Sequence[_Each]], views: int) -> tuple[_Each, ...]:
    """The images of frame sets that are evenly spread, whole, and at most `views` together; one set at least."""
    count = len(sets)
    while count > 1 and sum(len(sets[i]) for i in _space_evenly(len(sets), count)) > views:
        count -= 1
    return tuple(each for i in _space_evenly(len(sets), count) for each in sets[i])


def _names(request: Request) -> tuple[str, ...]:
    """Returns the names of the images to use; none means all."""
    if request.frames and request.listed:
        raise ValueError("--frames names photographs of a folder; here they are listed already, so leave it out")
    if request.frames:
        return request.frames
    if not request.views:
        return ()
    if request.cameras is not None:
        sets = [tuple(each.names.values()) for each in request.cameras.form_frame_sets()]
        _check_enough(request.views, sum(map(len, sets)))
        return _select_sets(sets, request.views)
    names = _skip_raw_files(_list_photographs(request))
    return tuple(names[i] for i in _select_evenly(request.views, len(names)))


def _select_evenly(views: int, count: int) -> list[int]:
    """So many of `count` photographs. Raises ValueError where there are fewer."""
    _check_enough(views, count)
    return _space_evenly(count, views)


def _check_enough(views: int, count: int) -> None:
    if views > count:
        raise ValueError(f"{views} views are asked for: there are {count} photographs; ask for at most as many")


def _space_evenly(count: int, wanted: int) -> list[int]:
    return np.linspace(0, count - 1, wanted).round().astype(int).tolist()


# Which rig a reconstruction is given, with its lenses: that of a file, or what a recording tells of its cameras.

log = logging.getLogger(__name__)

DRAWN_SIGMA_M, DRAWN_SIGMA_DEG = MOUNT_SIGMA_M, MOUNT_SIGMA_DEG  # by a log's static transforms
LONGEST_BASELINE_M = 20.0  # between two cameras of a robot; beyond, the file is probably in millimetres
_TRUSTED = ("given", "calibration")  # sources of a lens that a rig's does not replace


def apply_rig(
    given: Source, config: ReconstructionConfig, file: str | PathLike[str] | None, tell: Tell
) -> tuple[Source, ReconstructionConfig]:
    """The frames with the lenses of their rig, and the configuration with it: that of a file, or of their recording.

    What of the rig does not count is notified. Raises as `choose_rig` and `add_rig_lenses`.
    """
    rig = choose_rig(None if file is None else Path(file), given.cameras, tell)
    if rig is None:
        return given, config
    given = add_mounts(given, rig)
    if len(rig.cameras) < 2:
        return given, config
    with_lenses = add_rig_lenses(given, rig)
    for text in describe_rig_use(rig, [each.camera_id for each in given.frames if isinstance(each, Frame)]):
        notify(log, text)
    return with_lenses, hold_rig(config, rig)


def choose_recording_rig(
    recording: ReplayRecording, config: ReconstructionConfig, file: str | PathLike[str] | None, tell: Tell
) -> tuple[Rig | None, ReconstructionConfig]:
    """As `apply_rig`, of a recording whose frames are not in memory: `place_on_rig` is for each of them."""
    rig = choose_rig(None if file is None else Path(file), recording.request.cameras, tell)
    if rig is None:
        return None, config
    ids = [camera_id for _, _, camera_id, *_ in recording.images]
    _check_mounts(rig, ids)
    if len(rig.cameras) < 2:
        return rig, config
    _check_names(rig, ids)
    lenses = _collect_lenses(rig, ids)
    lenses.check(recording.images)
    for text in describe_rig_use(rig, ids):
        notify(log, text)
    return rig, hold_rig(config, rig)


def place_on_rig(each: Frame | DroppedFrame, rig: Rig) -> Frame | DroppedFrame:
    """The frame with where its camera stands on the base, and with the rig's lens where its own is not trusted."""
    if not isinstance(each, Frame):
        return each
    mount = rig.find_mount(each.camera_id)
    placed = replace(each, T_base_camera=mount) if mount else each
    return (
        placed
        if len(rig.cameras) < 2 or not _lacks_lens(each)
        else _collect_lenses(rig, [each.camera_id]).apply(placed)
    )


def add_mounts(given: Source, rig: Rig) -> Source:
    """The frames with where their camera stands on the robot's base, as far as the rig tells it.

    Raises ValueError where it tells it of no camera of the frames.
    """
    _check_mounts(rig, [each.camera_id for each in given.frames if isinstance(each, Frame)])
    mounts = {each.name: rig.find_mount(each.camera_id) for each in given.frames if isinstance(each, Frame)}
    frames = (replace(each, T_base_camera=mount) if isinstance(each, Frame) and (mount := mounts[each.name]) else each
              for each in given.frames)  # fmt: skip
    return replace(given, frames=tuple(frames))


def _check_mounts(rig: Rig, camera_ids: Sequence[str]) -> None:
    if rig.is_base and camera_ids and not any(map(rig.find_mount, camera_ids)):
        names = ", ".join(each.camera_id for each in rig.cameras)
        raise ValueError(
            f"the rig has T_base_camera of {sanitize_text(names, 200)}, and no image is of such a camera. Name the "
            "cameras as the rig does: --cameras A,B"
        )


def describe_rig_use(rig: Rig, camera_ids: Iterable[str]) -> Iterator[str]:
    """Describes what of a rig does not count for images of these cameras, and what of it is probably not meant."""
    ids = list(camera_ids)
    there = set(ids) - {""}
    if not there:
        return
    used = [each for each in rig.cameras if each.camera_id in there]
    absent = [each.camera_id for each in rig.cameras if each.camera_id not in there]
    further = sorted(there - {each.camera_id for each in used})
    if absent:
        yield (
            f"no image is of {_join(absent)} of the rig, so the rig counts for {_join(e.camera_id for e in used)} "
            "alone. Name the cameras as the rig does (--cameras, camera_ids), or leave those out of it"
        )
    if further:
        yield (
            f"the rig does not have {_join(further)}, whose images are there: these images alone tell where it stands. "
            f"The rig has {_join(each.camera_id for each in rig.cameras)}; name the cameras as it does, or add it"
        )
    if unnamed := ids.count(""):
        yield f"{unnamed} of {len(ids)} images are of no camera that is named: the rig does not count for these"
    unplaced = [each.camera_id for each in used if each.matrix is None]
    if unplaced:
        few = len(used) - len(unplaced) < 2
        yield (
            f"the rig does not tell where {_join(unplaced)} stands (T_rig_camera, or cam_from_rig of COLMAP): the "
            "images alone tell it. "
            + ("The rig gives no metres: give two cameras or more a pose" if few else "The others give the metres")
        )
    yield from _describe_lengths(used)


def _describe_lengths(cameras: Iterable[RigCamera]) -> Iterator[str]:
    placed = [each for each in cameras if each.matrix is not None]
    centres = {each.camera_id: each.matrix[:3, 3] for each in placed if each.matrix is not None}
    apart = [(float(np.linalg.norm(centres[a] - centres[b])), a, b) for a, b in combinations(centres, 2)]
    longest = max(apart, default=None)
    if longest is not None and longest[0] > LONGEST_BASELINE_M:
        yield (
            f"the rig has {_join([longest[1]])} and {_join([longest[2]])} {longest[0]:.3g} m apart: its poses are "
            "metres. Where they are millimetres, divide the translations by 1000; else all lengths are 1000 times too "
            "large"
        )
    elif longest is not None and longest[0] <= max(each.sigma_m for each in placed):
        yield f"the rig has {_join(centres)} in one place, within their sigma_m: it gives no metres"


def _join(camera_ids: Iterable[str]) -> str:
    return sanitize_text(", ".join(camera_ids), 200)


def choose_rig(file: Path | None, cameras: CameraSet | None, tell: Tell) -> Rig | None:
    """The rig of a file, else that of the static transforms of the one log of all cameras; None: neither tells one.

    Raises UnusableRig where the file gives none. `tell` hears what the log tells, or why it tells nothing.
    """
    if file is not None:
        return read_rig(file)
    try:
        log_rig = None if cameras is None else cameras.find_rig()
    except ValueError as error:
        tell(f"no rig is known before, the images tell: {error}")
        return None
    if log_rig is None:
        return None
    tell(
        f"the static transforms of the recording tell where its {len(log_rig.cameras)} cameras stand, "
        f"within {100 * DRAWN_SIGMA_M:g} cm and {DRAWN_SIGMA_DEG:g} degrees (--rig FILE in place of these)"
    )
    return Rig(tuple(replace(each, sigma_m=DRAWN_SIGMA_M, sigma_deg=DRAWN_SIGMA_DEG) for each in log_rig.cameras))


def hold_rig(config: ReconstructionConfig, rig: Rig) -> ReconstructionConfig:
    """The configuration with a rig that is given."""
    return msgspec.structs.replace(config, registration=msgspec.structs.replace(config.registration, rig=rig))


def add_rig_lenses(given: Source, rig: Rig) -> Source:
    """The frames, each whose lens is neither given nor calibrated with the lens that the rig has of its camera.

    Raises ValueError where fewer than two of the rig's cameras took frames, or a lens is of none of their aspect ratio.
    """
    frames = [each for each in given.frames if isinstance(each, Frame)]
    _check_names(rig, [each.camera_id for each in frames])
    lensless = [each for each in frames if _lacks_lens(each)]
    lenses = _collect_lenses(rig, [each.camera_id for each in lensless])
    lenses.check(map(describe_image, lensless))
    added = {each.name: lenses.apply(each) for each in lensless}
    return replace(given, frames=tuple(added.get(each.name, each) for each in given.frames))


def _lacks_lens(frame: Frame) -> bool:
    return frame.intrinsics is None or frame.intrinsics.source not in _TRUSTED


def _collect_lenses(rig: Rig, camera_ids: Collection[str]) -> Lenses:
    """The lenses that the rig has of these cameras."""
    return Lenses({each.camera_id: each.intrinsics for each in rig.cameras
                   if each.intrinsics is not None and each.camera_id in camera_ids})  # fmt: skip


def _check_names(rig: Rig, camera_ids: Collection[str]) -> None:
    there = set(camera_ids) - {""}
    if camera_ids and sum(camera.camera_id in there for camera in rig.cameras) < 2:
        raise ValueError(
            f"a rig must name two or more of the cameras of the images; it has "
            f"{_join(each.camera_id for each in rig.cameras)}, and the "
            f"images are of {_join(sorted(there)) or 'no cameras that are named'}. Name the "
            "cameras as the rig does: --cameras A,B with a folder or a film of each in their order"
        )
