"""Which pairs of keyframes are worth matching, so that the work grows with the keyframes and not with their pairs.

Up to `exhaustive` keyframes all pairs are. Of more, each is matched with its likeliest partners: by the codes of their
images a short list, of which those count that have most matches among their strongest features, "at a glance". Where a
keyframe does not become firmly connected with the others, further partners follow, in the end all.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.matching.features import Code, similarities

# Connected components of a graph of frames.


def find_components(nodes: Iterable[int], edges: Iterable[tuple[int, int]]) -> list[list[int]]:
    """The connected components of the undirected graph, the largest first; equally large ones by their first nodes."""
    label = {node: node for node in nodes}
    for i, j in edges:
        old, new = max(label[i], label[j]), min(label[i], label[j])
        label = {node: new if name == old else name for node, name in label.items()}
    groups = [[node for node, name in label.items() if name == group] for group in sorted(set(label.values()))]
    return sorted(groups, key=lambda group: (-len(group), group))


Pair = tuple[int, int]


class PairSelectionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which pairs of keyframes are worth matching, so that the work grows with the keyframes and not with their
    pairs."""

    exhaustive: int = 12  # keyframes up to which all pairs are matched
    partners: int = 8  # with which a keyframe is matched first: with 8 of 29, real sets were as exact as with all
    short_list: int = 24  # keyframes with similar codes that are matched at a glance, to choose the partners
    glance_features: int = 500  # the strongest of each, for that; 1000 chose no better partners
    enough_firm: int = 3  # partners with firm matches that make a keyframe firmly connected


def select_short_list_pairs(codes: Sequence[Code], config: PairSelectionConfig) -> set[Pair]:
    """The pairs (i < j) of which either keyframe has the other on its short list."""
    if len(codes) <= config.exhaustive:
        return set()
    if len(codes) - 1 <= config.short_list:
        return set(itertools.combinations(range(len(codes)), 2))
    alike = similarities(codes)
    return _union([_best(alike[index], index)[: config.short_list] for index in range(len(codes))])


def select_pairs_worth_matching(
    num_keyframes: int,
    glanced: Mapping[Pair, int],
    is_known: Callable[[Pair], bool],
    is_firm: Callable[[Pair], bool],
    config: PairSelectionConfig,
) -> set[Pair]:
    """The pairs (i < j) that are to be matched, as far as that can be said from those that are.

    `glanced` has the number of matches of pairs at a glance. Once all pairs of the answer are known, it is the same
    whatever the order in which the keyframes came.
    """
    everyone = range(num_keyframes)
    if num_keyframes <= config.exhaustive:
        return set(itertools.combinations(everyone, 2))
    likeness = np.full((num_keyframes, num_keyframes), -1)
    for (i, j), count in glanced.items():
        likeness[i, j] = likeness[j, i] = count
    ranked = [_best(likeness[index], index) for index in everyone]
    depth = [config.partners] * num_keyframes
    while True:
        chosen = _union([ranked[index][: depth[index]] for index in everyone])
        if not all(map(is_known, chosen)):
            return chosen
        loose = _find_weakly_connected(everyone, set(filter(is_firm, chosen)), config)
        loose = [index for index in loose if depth[index] < num_keyframes]
        if not loose:
            return chosen
        for index in loose:
            depth[index] += config.partners


def _best(scores: npt.NDArray[Any], index: int) -> list[int]:
    """The other keyframes, that with the highest score first."""
    order = np.argsort(-scores, kind="stable").tolist()
    return [other for other in order if other != index]


def _union(partners: Sequence[Sequence[int]]) -> set[Pair]:
    return {(min(index, other), max(index, other)) for index, those in enumerate(partners) for other in those}


def _find_weakly_connected(everyone: Collection[int], firm: Collection[Pair], config: PairSelectionConfig) -> list[int]:
    """The keyframes with few firm partners, or outside of the largest group that firm pairs connect."""
    (largest, *_) = find_components(everyone, firm)
    counts = np.bincount(np.array(sorted(firm), np.int64).ravel(), minlength=len(everyone))
    return [index for index in everyone if counts[index] < config.enough_firm or index not in largest]
