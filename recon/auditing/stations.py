"""Which camera of a station took what in which recording: by folders, by episodes of data sets, by MCAP files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatnode.capture import film
from splatnode.capture.cameras.folder import frame_name, image_paths
from splatnode.capture.lerobot import data_set
from splatnode.capture.process.packages import remedy
from splatnode.capture.process.printable import printable, printable_name
from splatnode.capture.recording import is_recording
from splatnode.recon.batch import sources

MOST_PHOTOGRAPHS = 3  # of a camera that took many in one recording: the first, the last, and between
_ONE_CAMERA = "camera"  # the name of that which took a video that is named itself

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
    any depth, and a text file may name them. Where two have one name, more of their paths tells them apart. What cannot
    be read is a recording with a problem.
    Raises FileNotFoundError or ValueError, with what to do, for what is named and is not there, holds nothing, or is
    named twice.
    """
    found: dict[_Place, dict[str, Photographs | Film]] = {}
    problems: dict[_Place, str] = {}
    for path in named:
        for each in _found(path):
            cameras = found.setdefault(each.place, {})
            if each.place in problems or (isinstance(each, _Shot) and each.camera in cameras):
                raise ValueError(f"{str(Path(*each.place))!r} is given twice; give each recording once")
            if isinstance(each, _Shot):
                cameras[each.camera] = each.pictures
            else:
                problems[each.place] = printable(each.reason)
    names = _names(list(found))
    return [Recording(name, found[place], problems.get(place, "")) for name, place in zip(names, found, strict=True)]


def _found(path: Path, lists: tuple[Path, ...] = ()) -> Iterator[_Shot | _Unreadable]:
    """What `path` names; `lists` led to it."""
    if path.suffix.lower() == sources.LIST and path.is_file():
        for listed in sources.listed(path, lists):
            try:
                yield from _found(listed, (*lists, path.resolve()))
            except (ValueError, FileNotFoundError) as error:
                yield _Unreadable(listed.absolute().parts, str(error))
        return
    cameras = _in_folder(path) if path.is_dir() else {}
    for camera, pictures in cameras.items():
        yield _Shot(path.absolute().parts, camera, pictures)
    if not cameras:
        for each in sources.recordings([path], None):
            yield _of_source(Path(each.source), named=path.resolve())


def _in_folder(folder: Path) -> dict[str, Photographs | Film]:
    """The cameras of a folder of photographs, or of folders of them; none of any other."""
    if is_recording(folder):
        return {_ONE_CAMERA: Film(folder)}
    if data_set.is_data_set(folder):
        return {}
    below = sorted(child for child in folder.iterdir() if child.is_dir() and _is_of_one_camera(child))
    if below:
        return {frame_name(child): _of_camera(child) for child in below}
    return {Path(frame_name(path)).stem: Photographs((path,)) for path in image_paths(folder)}


def _is_of_one_camera(folder: Path) -> bool:
    return is_recording(folder) or (bool(image_paths(folder)) and not (folder / sources.REPORT).is_file())


def _of_camera(folder: Path) -> Photographs | Film:
    return Film(folder) if is_recording(folder) else Photographs(_few(image_paths(folder)))


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
        return _Unreadable(path.parts, str(error))
    if part:
        return _Shot(file.parts, printable_name(part), Film(path))
    if path == named:
        return _Shot(path.parts, _ONE_CAMERA, Film(path))
    camera = frame_name(path) if path.is_dir() else Path(frame_name(path)).stem
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
