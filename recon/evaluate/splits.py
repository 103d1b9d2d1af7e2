"""Which views of a scene train a reconstruction and which test it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatnode.capture.process.printable import sanitize_text
from splatnode.recon.evaluate.json_file import read_json
from splatnode.recon.evaluate.truth import find_scene_folder

_PAPER_FRAMES, _PAPER_TEST = 24, 12


@dataclass(frozen=True)
class Split:
    train: tuple[str, ...]
    test: tuple[str, ...]


def load_split(folder: Path, names: Sequence[str], views: int) -> Split:
    """The split of the scene in `folder` for `views` training images.

    It is that of the splits.json beside the scene's folder where that lists the scene, else the paper's of `names`.
    Raises ValueError, which names the scene, where there is no such split, where it lists photographs that are not
    among `names`, and where it lists one twice: what trains must not test.
    """
    place = find_scene_folder(folder)
    listed = place.parent / "splits.json"
    splits: dict[str, dict[str, list[str]]] = {}
    if listed.is_file():
        splits = read_json(listed, dict[str, dict[str, list[str]]], "lists of photographs by scene and split")
    if not names:
        raise ValueError(f"{place.name} must have photographs with a true camera, there are none")
    if place.name not in splits:
        try:
            return make_paper_split(names, views)
        except ValueError as error:
            raise ValueError(f"{place.name}: {error}") from error
    split = splits[place.name]
    if not {f"train{views}", "test"} <= split.keys():
        raise ValueError(f"{listed} must list train{views} and test for {place.name}, has {sorted(split)}")
    found = Split(tuple(split[f"train{views}"]), tuple(split["test"]))
    _check_names(found, names, f"{listed}, train{views} and test of {place.name}")
    return found


def _check_names(split: Split, names: Sequence[str], where: str) -> None:
    listed = (*split.train, *split.test)
    if absent := sorted(set(listed) - set(names)):
        raise ValueError(f"{where} must be of photographs with a true camera; these are not: {_format_names(absent)}")
    if twice := sorted(name for name, times in Counter(listed).items() if times > 1):
        raise ValueError(f"{where} must list each photograph once; these are there twice: {_format_names(twice)}")


def _format_names(names: Sequence[str]) -> str:
    return ", ".join(sanitize_text(name, 100) for name in names[:5]) + (" and more" if len(names) > 5 else "")


def make_paper_split(names: Sequence[str], views: int) -> Split:
    """The split of InstantSplat and of the paper: of 24 frames 12 test, without the first and the last.

    The training views are spread evenly over the rest. More than 24 frames are thinned evenly to 24; of fewer, half
    test.
    """
    if len(names) > _PAPER_FRAMES:
        return make_paper_split([names[i] for i in _space_evenly(0, len(names) - 1, _PAPER_FRAMES)], views)
    num_test = min(_PAPER_TEST, len(names) // 2)
    test = sorted(set(_space_evenly(1, len(names) - 2, num_test)))
    rest = [i for i in range(len(names)) if i not in test]
    if not 1 <= views <= len(rest):
        raise ValueError(f"views must be 1 to {len(rest)} for {len(names)} images, got {views}")
    train = [rest[i] for i in _space_evenly(0, len(rest) - 1, views)]
    return Split(tuple(names[i] for i in train), tuple(names[i] for i in test))


def _space_evenly(first: int, last: int, count: int) -> list[int]:
    return np.linspace(first, last, count).astype(int).tolist()
