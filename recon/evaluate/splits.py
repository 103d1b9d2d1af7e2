"""Which views of a scene train a reconstruction and which test it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatnode.recon.evaluate.json_file import read_json
from splatnode.recon.evaluate.truth import scene_folder

_PAPER_FRAMES, _PAPER_TEST = 24, 12


@dataclass(frozen=True)
class Split:
    train: tuple[str, ...]
    test: tuple[str, ...]


def load_split(folder: Path, names: Sequence[str], views: int) -> Split:
    """The split of the scene in `folder` for `views` training images.

    It is that of the splits.json beside the scene's folder where that lists the scene, else the paper's of `names`.
    """
    place = scene_folder(folder)
    listed = place.parent / "splits.json"
    splits: dict[str, dict[str, list[str]]] = {}
    if listed.is_file():
        splits = read_json(listed, dict[str, dict[str, list[str]]], "lists of photographs by scene and split")
    if place.name not in splits:
        return paper_split(names, views)
    split = splits[place.name]
    if not {f"train{views}", "test"} <= split.keys():
        raise ValueError(f"{listed} must list train{views} and test for {place.name}, has {sorted(split)}")
    return Split(tuple(split[f"train{views}"]), tuple(split["test"]))


def paper_split(names: Sequence[str], views: int) -> Split:
    """The split of InstantSplat and of the paper: of 24 frames 12 test, without the first and the last.

    The training views are spread evenly over the rest. More than 24 frames are thinned evenly to 24; of fewer, half
    test.
    """
    if len(names) > _PAPER_FRAMES:
        return paper_split([names[i] for i in _evenly(0, len(names) - 1, _PAPER_FRAMES)], views)
    num_test = min(_PAPER_TEST, len(names) // 2)
    test = sorted(set(_evenly(1, len(names) - 2, num_test)))
    rest = [i for i in range(len(names)) if i not in test]
    if not 1 <= views <= len(rest):
        raise ValueError(f"views must be 1 to {len(rest)} for {len(names)} images, got {views}")
    train = [rest[i] for i in _evenly(0, len(rest) - 1, views)]
    return Split(tuple(names[i] for i in train), tuple(names[i] for i in test))


def _evenly(first: int, last: int, count: int) -> list[int]:
    return np.linspace(first, last, count).astype(int).tolist()
