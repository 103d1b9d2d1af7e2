"""Which camera of a station took what in which recording: by folders, by episodes of data sets, by MCAP files."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from splatnode.capture import film
from splatnode.capture.cameras.folder import foreign_file, frame_name, image_paths
from splatnode.capture.lerobot import data_set
from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.capture.process.packages import remedy
from splatnode.capture.process.printable import printable, printable_name
from splatnode.capture.recording import is_recording
from splatnode.recon.batch import sources

MOST_PHOTOGRAPHS = 3  # of a camera that took many in one recording: the first, the last, and between
_ONE_CAMERA = "camera"  # the name of that which took a video that is named itself

_log = logging.getLogger(__name__)

_Place = tuple[str, ...]  # where a recording is: the parts of a path, of a data set's with the episode


@dataclass(frozen=True)
class Photographs:
    """Files, in their order; at most MOST_PHOTOGRAPHS."""

    paths: tuple[Path, ...]


@dataclass(frozen=True)
class Film:
    """A recording that is read in its order: what `capture/film.py` names, or a folder that `splatnode record` made."""

    path: Path


@dataclass(frozen=True)
class Recording:
    """One visit to the station."""

    name: str
    cameras: Mapping[str, Photographs | Film]  # by the name of the camera
    problem: str = ""  # why it has no cameras, in a sentence: it cannot be read


@dataclass(frozen=True)
class _Shot:
    """What one camera took in one recording."""

    place: _Place
    camera: str
    pictures: Photographs | Film


@dataclass(frozen=True)
class _Unreadable:
    place: _Place
    reason: str


def recordings(named: Sequence[Path]) -> list[Recording]:
    """What was recorded, in the order given; episodes by their numbers, and what lies in a folder by its name.

    A recording is a folder of photographs, one a camera, or of a folder a camera; an MCAP file, whose image topics are
    cameras; an episode of a LeRobot data set; a video, or a folder of videos, one a camera. A folder may hold such at
    any depth, and a text file may name them. Folders of photographs that lie side by side are cameras, or recordings if
    `_hold_a_camera_a_photograph` says so. Where two have one name, more of their paths tells them apart. What cannot be
    read is a recording with a problem.
    Raises FileNotFoundError or ValueError, with what to do, for what is named and is not there, holds nothing, or is
    named twice.
    """
    found: dict[_Place, dict[str, Photographs | Film]] = {}
    problems: dict[_Place, str] = {}
    lists: set[Path] = set()
    for path in named:
        for each in _found(path, lists):
            cameras = found.setdefault(each.place, {})
            if each.place in problems or (isinstance(each, _Shot) and each.camera in cameras):
                raise ValueError(f"{str(Path(*each.place))!r} is given twice; give each recording once")
            if isinstance(each, _Shot):
                cameras[each.camera] = each.pictures
            else:
                problems[each.place] = printable(each.reason)
    names = _names(list(found))
    return [Recording(name, found[place], problems.get(place, "")) for name, place in zip(names, found, strict=True)]


def _found(path: Path, seen: set[Path], lists: tuple[Path, ...] = ()) -> Iterator[_Shot | _Unreadable]:
    """What `path` names; `lists` led to it, and those of `seen` were read before."""
    if path.suffix.lower() == sources.LIST and path.is_file():
        for listed in sources.listed(path, lists, seen):
            try:
                yield from _found(listed, seen, (*lists, sources.real(path)))
            except (ValueError, FileNotFoundError) as error:
                raise_shortage(error)
                yield _Unreadable(listed.absolute().parts, str(error))
        return
    cameras = _in_folder(path) if path.is_dir() else {}
    for camera, pictures in cameras.items():
        yield _Shot(path.absolute().parts, camera, pictures)
    if not cameras:
        of_days: dict[Path, bool] = {}  # of each folder, whether those in it are recordings
        for each in sources.recordings([path], None):
            source = Path(each.source)
            above = source.parent
            if source.is_dir() and above not in of_days:
                of_days[above] = _hold_a_camera_a_photograph(_folders_of_photographs(above))
            if source.is_dir() and of_days[above]:
                yield from (_Shot(source.parts, camera, of) for camera, of in _in_folder(source).items())
            else:
                yield _of_source(source, named=path.resolve())


def _in_folder(folder: Path) -> dict[str, Photographs | Film]:
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
        _log.warning("%s: its photographs are its cameras; left out: %s", printable_name(folder.name), names)
    if not photographs:
        return {} if _hold_a_camera_a_photograph(below) else {frame_name(child): _of_camera(child) for child in below}
    cameras: defaultdict[str, list[Path]] = defaultdict(list)
    for path in photographs:
        cameras[_camera(path)].append(path)
    return {camera: Photographs(_few(_readable(paths))) for camera, paths in cameras.items()}


def _folders_of_photographs(folder: Path) -> list[Path]:
    return sorted(child for child in folder.iterdir() if child.is_dir() and _is_of_one_camera(child))


def _is_of_one_camera(folder: Path) -> bool:
    return is_recording(folder) or (bool(image_paths(folder)) and not (folder / sources.REPORT).is_file())


def _hold_a_camera_a_photograph(folders: Sequence[Path]) -> bool:
    """Whether folders that lie side by side are recordings, with a photograph a camera, rather than cameras.

    They are if two of them have two names of photographs in common that are no numbers of a sequence.
    """
    named = [{_camera(path) for path in image_paths(folder)} for folder in folders if not is_recording(folder)]
    named = [{name for name in names if not name[-1].isdigit()} for names in named]
    return any(len(one & other) > 1 for one, other in combinations(named, 2))


def _camera(path: Path) -> str:
    """The name of the camera that a photograph, beside those of others, or a video is called by."""
    return Path(frame_name(path)).stem


def _readable(paths: Sequence[Path]) -> Sequence[Path]:
    """Without raw files, beside which their cameras put photographs; all where there is nothing else."""
    return [path for path in paths if foreign_file(path) is None] or paths


def _of_camera(folder: Path) -> Photographs | Film:
    return Film(folder) if is_recording(folder) else Photographs(_few(_readable(image_paths(folder))))


def _of_source(path: Path, named: Path) -> _Shot | _Unreadable:
    """What a recording of a batch is to a station; `named` is what led to it."""
    file, part = film.file_and_part(path)
    try:
        if part and data_set.is_data_set(file):
            number, key = data_set.episode_and_camera(file, data_set.read_info(file), part)
            return _Shot((*file.parts, data_set.episode_name(number)), printable_name(key), Film(path))
        if not part and (data_set.is_data_set(file) or file.suffix.lower() == film.MCAP):
            sources.parts(file)  # which has found none; one of both tells why
            film.stream(file)
    except ModuleNotFoundError as error:
        return _Unreadable(path.parts, f"{error.name} is not installed. {remedy(error.name or '')}")
    except (ValueError, OSError) as error:
        raise_shortage(error)
        return _Unreadable(path.parts, str(error))
    if part and file.suffix.lower() == film.MCAP:
        return _Shot(file.parts, printable_name(part), Film(path))
    if path == named:
        return _Shot(path.parts, _ONE_CAMERA, Film(path))
    camera = frame_name(path) if path.is_dir() else _camera(file)
    return _Shot(path.parent.parts, camera, _of_camera(path) if path.is_dir() else Film(path))


def _few(paths: Sequence[Path]) -> tuple[Path, ...]:
    """The first, the last, and what lies evenly between."""
    most = min(len(paths), MOST_PHOTOGRAPHS)
    return tuple(paths[round(i * (len(paths) - 1) / max(most - 1, 1))] for i in range(most))


def _names(places: Sequence[_Place]) -> list[str]:
    """As short as tells them apart."""
    length = 1
    while len({place[-length:] for place in places}) < len(places):
        length += 1
    return [printable_name("/".join(place[-length:])) for place in places]
