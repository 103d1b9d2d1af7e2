"""Mirror images among the frames: do some look more like the others when they are turned left to right?

Where a place is symmetric, the mirror image of a photograph fits the others as one taken from the other side, to the
pixel. But it shows the details that are not symmetric, too, the wrong way round: turned back, it matches better.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import PLAIN, Features, Keyframe
from splatnode.recon.matching import nearest_neighbours
from splatnode.recon.workers import map_parallel_lazily

Array = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]


class ReflectionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    num_features: int = 1500  # of each frame, the strongest
    by_chance: float = 50.0  # matches of frames that have nothing in common, which say nothing
    partners: int = 4  # known frames with which a further one is compared, those that share most points with it
    # Largest gain of a further frame beside them when mirrored; right ones of ten scenes reach 0.08
    max_further_gain: float = 0.1
    nearest_neighbours: nearest_neighbours.NearestNeighbourConfig = nearest_neighbours.NearestNeighbourConfig()


@dataclass(frozen=True)
class Reflection:
    """The frames that stand out most as mirror images of what the others show."""

    frames: tuple[str, ...]  # at most half of them
    gain: float  # mean logarithm of the matches of mirrored over plain pairs of one of them and one of the others


def measure_reflection(
    keyframes: Sequence[Keyframe], pairs: Collection[tuple[int, int]], config: ReflectionConfig
) -> Reflection:
    """Measures the reflection of two or more frames over `pairs` (i < j) of their positions."""
    plain = [_select_descriptors(keyframe.features, config.num_features) for keyframe in keyframes]
    mirrored = [mirror_descriptors(descriptors) for descriptors in plain]
    gains, compared = np.zeros((len(plain), len(plain))), np.zeros((len(plain), len(plain)))
    ordered = sorted(pairs)
    of_pairs = map_parallel_lazily(
        lambda pair: _compute_gain(plain[pair[0]], mirrored[pair[1]], plain[pair[1]], config), ordered
    )
    for (i, j), gain in zip(ordered, of_pairs, strict=True):
        gains[i, j] = gains[j, i] = gain
        compared[i, j] = compared[j, i] = 1.0
    grown = [_grow_group(gains, compared, first) for first in range(len(plain))]
    group, gain = grown[int(np.argmax([gain for _, gain in grown]))]  # the first NaN, where there is one
    return Reflection(tuple(keyframes[index].name for index in np.flatnonzero(group).tolist()), gain)


def measure_further(further: Keyframe, known: Sequence[Keyframe], config: ReflectionConfig) -> Reflection:
    """Measures the reflection of a further frame beside frames that are the right way round."""
    descriptors = _select_descriptors(further.features, config.num_features)
    mirrored = mirror_descriptors(descriptors)
    others = (_select_descriptors(keyframe.features, config.num_features) for keyframe in known)
    gains = [_compute_gain(other, mirrored, descriptors, config) for other in others]
    return Reflection((further.name,), float(np.mean(gains)))


def select_strongest_reflection(found: Sequence[Reflection]) -> Reflection:
    """The one with the largest gain; the first whose gain is NaN, where there is one."""
    return found[int(np.argmax([each.gain for each in found]))]


def _compute_gain(other: Bytes, mirrored: Bytes, plain: Bytes, config: ReflectionConfig) -> float:
    """The logarithm of the matches that a frame has with another one when it is mirrored, over those as it is."""
    found, expected = (
        len(nearest_neighbours.match(other, descriptors, config.nearest_neighbours)) + config.by_chance
        for descriptors in (mirrored, plain)
    )
    return float(np.log(found / expected))


def _select_descriptors(features: Features, count: int) -> Bytes:
    return features.select_tilt(PLAIN).descriptors[:count]


def mirror_descriptors(descriptors: Bytes) -> Bytes:
    """SIFT descriptors (M, 128) as they are in the mirrored image.

    They are histograms of 8 directions in 4 x 4 cells, along and across the direction of the keypoint: mirroring
    reverses the rows of cells across it, and the sense of the directions.
    """
    cells = descriptors.reshape(-1, 4, 4, 8)
    return np.ascontiguousarray(cells[:, ::-1][..., -np.arange(8) % 8].reshape(-1, 128))


def _grow_group(gains: Array, compared: Array, first: int) -> tuple[Flags, float]:
    """The group with the largest mean gain across its border, grown from one frame by the frame that suits best.

    Pairs that are not `compared` (1, else 0) have a gain of 0 and do not count.
    """
    group = np.zeros(len(gains), bool)
    group[first] = True
    total, count = gains[first].sum(), compared[first].sum()
    best = group.copy(), float(_compute_mean(total, count))
    while 2 * (group.sum() + 1) <= len(gains):
        # A frame that joins the group takes its pairs with the group from the border, and adds those with the others.
        totals = total + gains @ ~group - gains @ group
        counts = count + compared @ ~group - compared @ group
        means = np.where(group, -np.inf, _compute_mean(totals, counts))
        other = int(means.argmax())
        group[other], total, count = True, totals[other], counts[other]
        if means[other] > best[1]:
            best = group.copy(), float(means[other])
    return best


def _compute_mean(total: Array, count: Array) -> Any:
    """Minus infinity where nothing was compared."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count > 0, total / count, -np.inf)
