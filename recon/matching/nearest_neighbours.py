"""Mutual nearest neighbours with the ratio test (Lowe, 2004), in one native sweep over all descriptor pairs."""

from __future__ import annotations

import ctypes
import math

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.core import library, pointer

Bytes = npt.NDArray[np.uint8]
Index = npt.NDArray[np.int64]
Index32 = npt.NDArray[np.int32]

DESCRIPTOR_SIZE = 128
QUANTISED_NORM = 175.0  # length of a descriptor in bytes: with rounding at most 181, so that products fit 16 bits
_MAX_BYTE = 127  # the core multiplies signed bytes
_TOO_LARGE = "descriptors must have bytes below 128 and norms of at most 181, as `quantise` makes them; some have more"
_MAX_DESCRIPTORS = 65535  # that recon/core/match.cpp is written for
_SCORE_OFFSET = 16320  # `kOffset` of recon/core/match.cpp: keeps scores positive


class NearestNeighbourConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    ratio: float = 0.85  # largest ratio of nearest to second-nearest distance; loose, because geometry decides later


def quantise(descriptors: npt.NDArray[np.float32]) -> Bytes:
    """`descriptors` (M, 128), not negative and of unit length, as bytes below 128; rounding costs 2 % of the length."""
    return np.minimum(np.rint(descriptors * QUANTISED_NORM), _MAX_BYTE).astype(np.uint8)


def match(descriptors1: Bytes, descriptors2: Bytes, config: NearestNeighbourConfig) -> Index:
    """(M, 2) indices into both sets: each is the other's nearest neighbour, and clearly nearer than the second nearest.

    The most distinct match comes first: the one with the lowest ratio of distances. Raises ValueError unless both are
    (*, 128) bytes, as `quantise` makes them, of at most 65535 rows.
    """
    _check(descriptors1, descriptors2)
    count1, count2 = len(descriptors1), len(descriptors2)
    if count1 < 2 or count2 < 2:
        return np.zeros((0, 2), np.int64)
    first, second = np.ascontiguousarray(descriptors1), np.ascontiguousarray(descriptors2)
    nearest, score, second_score = (np.empty(count1, np.int32) for _ in range(3))
    back = np.empty(count2, np.int32)
    problem = library().core_match(
        *(pointer(first), count1, pointer(second), count2),
        *(pointer(nearest), pointer(score), pointer(second_score), pointer(back)),
    )
    if problem:
        raise ValueError(_TOO_LARGE)
    return _distinct(first, nearest, score, second_score, back, config)


def match_near(
    descriptors1: Bytes,
    points1: npt.NDArray[np.float64],  # (M, 2)
    descriptors2: Bytes,
    points2: npt.NDArray[np.float64],  # (N, 2)
    reach: float,
    config: NearestNeighbourConfig,
) -> Index:
    """As `match`, among pairs whose points are nearer than `reach` alone; what has one such neighbour is distinct.

    Points are pixels of one picture, finite; `reach` is positive. Raises ValueError also where they are not.
    """
    _check(descriptors1, descriptors2)
    count1, count2 = len(descriptors1), len(descriptors2)
    places = [np.ascontiguousarray(points, np.float32) for points in (points1, points2)]
    for points, count in zip(places, (count1, count2), strict=True):
        if points.shape != (count, 2) or not np.isfinite(points).all():
            raise ValueError(f"points must be ({count}, 2) and finite, got {points.shape}")
    if not (math.isfinite(reach) and reach > 0):
        raise ValueError(f"reach must be positive, got {reach}")
    first, second = np.ascontiguousarray(descriptors1), np.ascontiguousarray(descriptors2)
    nearest, score, second_score = (np.empty(count1, np.int32) for _ in range(3))
    back = np.empty(count2, np.int32)
    problem = library().core_match_near(
        *(pointer(first), pointer(places[0]), count1, pointer(second), pointer(places[1]), count2),
        *(ctypes.c_float(reach), pointer(nearest), pointer(score), pointer(second_score), pointer(back)),
    )
    if problem:
        raise ValueError(_TOO_LARGE)
    return _distinct(first, nearest, score, second_score, back, config)


def _check(*sets: Bytes) -> None:
    for descriptors in sets:
        if descriptors.dtype != np.uint8 or descriptors.ndim != 2 or descriptors.shape[1] != DESCRIPTOR_SIZE:
            raise ValueError(f"descriptors must be (M, 128) uint8, got {descriptors.shape} {descriptors.dtype}")
        if len(descriptors) > _MAX_DESCRIPTORS:
            raise ValueError(f"at most {_MAX_DESCRIPTORS} descriptors can be matched, got {len(descriptors)}")


def _distinct(
    first: Bytes, nearest: Index32, score: Index32, second_score: Index32, back: Index32, config: NearestNeighbourConfig
) -> Index:
    """The pairs that are each other's nearest and pass the ratio test, the most distinct first."""
    (there,) = np.nonzero(nearest >= 0)
    chosen = there[back[nearest[there]] == there]
    squared_norm = (first[chosen].astype(np.int32) ** 2).sum(1)
    nearest_squared, second_squared = (
        np.maximum(squared_norm + 2 * (_SCORE_OFFSET - value[chosen]), 0) for value in (score, second_score)
    )
    good = nearest_squared < config.ratio**2 * second_squared
    ratios = nearest_squared[good] / np.maximum(second_squared[good], 1)
    chosen = chosen[good][np.argsort(ratios, kind="stable")]
    return np.stack([chosen, nearest[chosen]], 1).astype(np.int64)
