"""Which photographs each camera of a station took in each recording, by the folders that they lie in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splatnode.capture.cameras.folder import chosen_images, frame_name, image_paths
from splatnode.capture.process.printable import printable_name

MOST_PHOTOGRAPHS = 3  # of a camera that took many in one recording: the first, the last, and between


@dataclass(frozen=True)
class Recording:
    """One visit to the station."""

    name: str
    photographs: dict[str, tuple[Path, ...]]  # by the name of the camera; at most MOST_PHOTOGRAPHS each, in their order


def recordings(folders: Sequence[Path]) -> list[Recording]:
    """What each folder holds, in the order given; where two have one name, more of their paths tells them apart.

    Raises FileNotFoundError or ValueError, with what to do, for a folder that is not there, is given twice or holds no
    photographs.
    """
    twice = [folder for index, folder in enumerate(folders) if folder.absolute() in map(Path.absolute, folders[:index])]
    if twice:
        raise ValueError(f"{str(twice[0])!r} is given twice; give each recording once")
    names = _names(folders)
    return [Recording(name, _photographs(folder)) for name, folder in zip(names, folders, strict=True)]


def _photographs(folder: Path) -> dict[str, tuple[Path, ...]]:
    if not folder.is_dir():
        raise FileNotFoundError(f"{str(folder)!r} is no folder; give a folder of photographs for each recording")
    below = sorted(child for child in folder.iterdir() if child.is_dir() and image_paths(child))
    if below:
        return {frame_name(child): _few(image_paths(child)) for child in below}
    return {Path(frame_name(path)).stem: (path,) for path in chosen_images(folder)}


def _few(paths: Sequence[Path]) -> tuple[Path, ...]:
    """The first, the last, and what lies evenly between."""
    most = min(len(paths), MOST_PHOTOGRAPHS)
    return tuple(paths[round(i * (len(paths) - 1) / max(most - 1, 1))] for i in range(most))


def _names(folders: Sequence[Path]) -> list[str]:
    """As short as tells them apart."""
    parts = [folder.absolute().parts for folder in folders]
    length = 1
    while len({part[-length:] for part in parts}) < len(parts):
        length += 1
    return [printable_name("/".join(part[-length:])) for part in parts]
