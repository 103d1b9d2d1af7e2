"""Which camera of a station took what in which recording: by folders, by episodes of data sets, by MCAP files."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, islice
from pathlib import Path

from splatnode.capture import film
from splatnode.capture.cameras import folder as cameras_folder
from splatnode.capture.cameras.folder import explain_unreadable_file, frame_name, image_paths
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.lens_file import assign_lens
from splatnode.capture.process.system import raise_shortage, remedy
from splatnode.capture.process.text import sanitize_name, sanitize_text
from splatnode.capture.recording import is_recording
from splatnode.extras.batch import batch
from splatnode.extras.cameras.mcap import SUFFIX as MCAP
from splatnode.extras.lerobot import data_set
from splatnode.recon.locating.localize import stream_query_frames

MOST_PHOTOGRAPHS = 3  # of a camera that took many in one recording: the first, the last, and between
_ONE_CAMERA = "camera"  # the name of that which took a video that is named itself

_log = logging.getLogger(__name__)

_Place = tuple[str, ...]  # where a recording is: the parts of a path, of a data set's with the episode


@dataclass(frozen=True)
class ImageFiles:
    """Files, in their order; at most MOST_PHOTOGRAPHS."""

    paths: tuple[Path, ...]


@dataclass(frozen=True)
class Film:
    """A recording that is read in its order: what `capture/film.py` names, or a folder that `splatnode record` made."""

    path: Path


@dataclass(frozen=True)
class StationRecording:
    """One visit to the station."""

    name: str
    cameras: Mapping[str, ImageFiles | Film]  # by the name of the camera
    problem: str = ""  # why it has no cameras, in a sentence: it cannot be read


@dataclass(frozen=True)
class _Shot:
    """The images of one camera in one recording."""

    place: _Place
    camera: str
    pictures: ImageFiles | Film


@dataclass(frozen=True)
class _Unreadable:
    place: _Place
    reason: str


def find_recordings(named: Sequence[Path]) -> list[StationRecording]:
    """Finds the recordings in the order given: episodes by number, the content of a folder by name.

    A recording is a folder of photographs, one a camera, or of a folder a camera; an MCAP file, whose image topics are
    cameras; an episode of a LeRobot data set; a video, or a folder of videos, one a camera. A folder may hold such at
    any depth, and a text file may name them. Folders of photographs that lie side by side are cameras, or recordings if
    `_hold_a_camera_a_photograph` says so. Where two have one name, more of their paths tells them apart. What cannot be
    read is a recording with a problem.
    Raises FileNotFoundError or ValueError, with what to do, for what is named and is not there, holds nothing, or is
    named twice.
    """
    found: dict[_Place, dict[str, ImageFiles | Film]] = {}
    problems: dict[_Place, str] = {}
    lists: set[Path] = set()
    for path in named:
        for each in _find_shots(path, lists):
            cameras = found.setdefault(each.place, {})
            if each.place in problems or (isinstance(each, _Shot) and each.camera in cameras):
                raise ValueError(f"{str(Path(*each.place))!r} is given twice; give each recording once")
            if isinstance(each, _Shot):
                cameras[each.camera] = each.pictures
            else:
                problems[each.place] = sanitize_text(each.reason)
    names = _make_short_names(list(found))
    return [
        StationRecording(name, found[place], problems.get(place, "")) for name, place in zip(names, found, strict=True)
    ]


def _find_shots(path: Path, seen: set[Path], lists: tuple[Path, ...] = ()) -> Iterator[_Shot | _Unreadable]:
    """Yields what `path` names; `lists` led to it, and those of `seen` were read before."""
    if path.suffix.lower() == batch.LIST and path.is_file():
        for listed in batch.read_list(path, lists, seen):
            try:
                yield from _find_shots(listed, seen, (*lists, batch.real(path)))
            except (ValueError, FileNotFoundError) as error:
                raise_shortage(error)
                yield _Unreadable(listed.absolute().parts, str(error))
        return
    cameras = _find_cameras(path) if path.is_dir() else {}
    for camera, pictures in cameras.items():
        yield _Shot(path.absolute().parts, camera, pictures)
    if not cameras:
        of_days: dict[Path, bool] = {}  # of each folder, whether those in it are recordings
        for each in batch.recordings([path], None):
            source = Path(each.source)
            above = source.parent
            if source.is_dir() and above not in of_days:
                of_days[above] = _hold_a_camera_a_photograph(_folders_of_photographs(above))
            if source.is_dir() and of_days[above]:
                yield from (_Shot(source.parts, camera, of) for camera, of in _find_cameras(source).items())
            else:
                yield _make_shot(source, named=path.resolve())


def _find_cameras(folder: Path) -> dict[str, ImageFiles | Film]:
    """The cameras of a folder of photographs, or of folders of them; none of any other.

    What photographs lie beside is left out, and said: small copies of them, for example.
    """
    if is_recording(folder):
        return {_ONE_CAMERA: Film(folder)}
    if data_set.is_data_set(folder):
        return {}
    below, photographs = _folders_of_photographs(folder), image_paths(folder)
    if photographs and below:
        names = ", ".join(frame_name(child) for child in below)
        _log.warning("%s: its photographs are its cameras; left out: %s", sanitize_name(folder.name), names)
    if not photographs:
        return (
            {} if _hold_a_camera_a_photograph(below) else {frame_name(child): _make_pictures(child) for child in below}
        )
    cameras: defaultdict[str, list[Path]] = defaultdict(list)
    for path in photographs:
        cameras[_parse_camera_name(path)].append(path)
    return {camera: ImageFiles(_select_few(_skip_raw_files(paths))) for camera, paths in cameras.items()}


def _folders_of_photographs(folder: Path) -> list[Path]:
    return sorted(child for child in folder.iterdir() if child.is_dir() and _is_of_one_camera(child))


def _is_of_one_camera(folder: Path) -> bool:
    return is_recording(folder) or (bool(image_paths(folder)) and not (folder / batch.REPORT).is_file())


def _hold_a_camera_a_photograph(folders: Sequence[Path]) -> bool:
    """Whether folders that lie side by side are recordings, with a photograph a camera, rather than cameras.

    They are if two of them have two names of photographs in common that are no numbers of a sequence.
    """
    named = [
        {_parse_camera_name(path) for path in image_paths(folder)} for folder in folders if not is_recording(folder)
    ]
    named = [{name for name in names if not name[-1].isdigit()} for names in named]
    return any(len(one & other) > 1 for one, other in combinations(named, 2))


def _parse_camera_name(path: Path) -> str:
    """The name of the camera that a photograph, beside those of others, or a video is called by."""
    return Path(frame_name(path)).stem


def _skip_raw_files(paths: Sequence[Path]) -> Sequence[Path]:
    """Without raw files, beside which their cameras put photographs; all where there is nothing else."""
    return [path for path in paths if explain_unreadable_file(path) is None] or paths


def _make_pictures(folder: Path) -> ImageFiles | Film:
    return Film(folder) if is_recording(folder) else ImageFiles(_select_few(_skip_raw_files(image_paths(folder))))


def _make_shot(path: Path, named: Path) -> _Shot | _Unreadable:
    """Makes the shot of one recording of a batch; `named` is the path that led to it."""
    file, part = film.file_and_part(path)
    try:
        if part and data_set.is_data_set(file):
            number, key = data_set.episode_and_camera(file, data_set.read_info(file), part)
            return _Shot((*file.parts, data_set.episode_name(number)), sanitize_name(key), Film(path))
        if not part and (data_set.is_data_set(file) or file.suffix.lower() == MCAP):
            batch.list_parts(file)  # which has found none; one of both tells why
            film.stream(file)
    except ModuleNotFoundError as error:
        return _Unreadable(path.parts, f"{error.name} is not installed. {remedy(error.name or '')}")
    except (ValueError, OSError) as error:
        raise_shortage(error)
        return _Unreadable(path.parts, str(error))
    if part and file.suffix.lower() == MCAP:
        return _Shot(file.parts, sanitize_name(part), Film(path))
    if path == named:
        return _Shot(path.parts, _ONE_CAMERA, Film(path))
    camera = frame_name(path) if path.is_dir() else _parse_camera_name(file)
    return _Shot(path.parent.parts, camera, _make_pictures(path) if path.is_dir() else Film(path))


def _select_few(paths: Sequence[Path]) -> tuple[Path, ...]:
    """The first, the last, and what lies evenly between."""
    most = min(len(paths), MOST_PHOTOGRAPHS)
    return tuple(paths[round(i * (len(paths) - 1) / max(most - 1, 1))] for i in range(most))


def _make_short_names(places: Sequence[_Place]) -> list[str]:
    """As short as tells them apart."""
    length = 1
    while len({place[-length:] for place in places}) < len(places):
        length += 1
    return [sanitize_name("/".join(place[-length:])) for place in places]


# The few photographs of a camera that tell where it stood in a recording, and whether it stood still.

_MOST_HELD = 9  # photographs in memory, evenly spread over what was read of a film so far


def load_sample_frames(pictures: ImageFiles | Film, given: Intrinsics | None) -> list[Frame | DroppedFrame]:
    """The photographs; of a film the first, one from about the middle and the last. `given` is their lens.

    At least one: where nothing can be read, it is a dropped frame that says why.
    """
    if isinstance(pictures, ImageFiles):
        return _read_all(stream_query_frames(pictures.paths, given), pictures.paths[0])
    frames = _read_all(_sample_frames(_stream(pictures.path)), pictures.path)
    return frames if given is None else [assign_lens(frame, given) for frame in frames]


def load_first_frames(recordings: Iterable[StationRecording]) -> Iterator[Frame | DroppedFrame]:
    """The first photograph that can be read of each camera in each recording; where there is none, why."""
    for pictures in (each for recording in recordings for each in recording.cameras.values()):
        if isinstance(pictures, ImageFiles):
            frames, path = stream_query_frames(pictures.paths, None), pictures.paths[0]
        else:
            frames, path = _stream(pictures.path), pictures.path
        yield from _read_all(islice((frame for frame in frames if isinstance(frame, Frame)), 1), path)


def _stream(path: Path) -> Iterator[Frame | DroppedFrame]:
    yield from film.stream(path) if film.is_film(path) else cameras_folder.stream(cameras_folder.Config(folder=path))


def _read_all(frames: Iterator[Frame | DroppedFrame], path: Path) -> list[Frame | DroppedFrame]:
    """All of them; in place of what cannot be read from `path`, why."""
    found: list[Frame | DroppedFrame] = []
    try:
        found += frames
    except ModuleNotFoundError as error:
        reason = f"{error.name} is not installed. {remedy(error.name or '')}"
    except (ValueError, OSError) as error:
        raise_shortage(error)
        reason = str(error)
    else:
        reason = "it holds no photographs"
    return found or [DroppedFrame(sanitize_name(path.name), sanitize_text(reason))]


def _sample_frames(frames: Iterator[Frame | DroppedFrame]) -> Iterator[Frame | DroppedFrame]:
    """The first, one within an eighth of the middle, and the last; what cannot be used only where there is no other.

    However many there are, few are in memory: when these are too many, every second one is given up, and from then on
    every second one is held.
    """
    held: list[tuple[int, Frame]] = []
    unusable: DroppedFrame | None = None
    last, count, step = None, 0, 1
    for frame in frames:
        if isinstance(frame, DroppedFrame):
            unusable = unusable or frame
            continue
        if count % step == 0:
            held.append((count, frame))
        if len(held) > _MOST_HELD:
            held, step = held[::2], 2 * step
        last, count = frame, count + 1
    if last is not None:
        middle, between = min(held, key=lambda each: abs(2 * each[0] - count + 1))
        chosen = {0: held[0][1], middle: between, count - 1: last}
        yield from chosen.values()
    elif unusable is not None:
        yield unusable
