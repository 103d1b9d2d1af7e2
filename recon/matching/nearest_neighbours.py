"""Mutual nearest neighbours with the ratio test (Lowe, 2004), in one native sweep over all descriptor pairs."""

from __future__ import annotations

from dataclasses import dataclass

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
_MAX_DESCRIPTORS = 65535  # that recon/core/match.cpp is written for
_SCORE_OFFSET = 16320  # `kOffset` of recon/core/match.cpp: keeps scores positive


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    ratio: float = 0.85  # most of the nearest distance over the second nearest; loose, because geometry decides later


def quantise(descriptors: npt.NDArray[np.float32]) -> Bytes:
    """`descriptors` (M, 128), not negative and of unit length, as bytes below 128; rounding costs 2 % of the length."""
    return np.minimum(np.rint(descriptors * QUANTISED_NORM), _MAX_BYTE).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Nearest:
    """For each of one set of descriptors the nearest of another set, and the way back.

    Scores are as recon/core/match.cpp defines them: the larger, the nearer.
    """

    nearest: Index32  # (M1,) of the second set
    score: Index32  # (M1,)
    second_score: Index32  # (M1,) of the second nearest
    back: Index32  # (M2,) of the first set
    back_score: Index32  # (M2,)


def match(descriptors1: Bytes, descriptors2: Bytes, config: Config) -> Index:
    """(M, 2) indices into both sets: each is the other's nearest neighbour, and clearly nearer than the second nearest.

    The most distinct match comes first: the one with the lowest ratio of distances. Raises ValueError unless both are
    (*, 128) bytes, as `quantise` makes them, of at most 65535 rows.
    """
    return distinct(nearest(descriptors1, descriptors2), descriptors1, config)


def nearest(descriptors1: Bytes, descriptors2: Bytes) -> Nearest:
    """Of all pairs of descriptors. Raises ValueError as `match`."""
    for descriptors in (descriptors1, descriptors2):
        if descriptors.dtype != np.uint8 or descriptors.ndim != 2 or descriptors.shape[1] != DESCRIPTOR_SIZE:
            raise ValueError(f"descriptors must be (M, 128) uint8, got {descriptors.shape} {descriptors.dtype}")
        if len(descriptors) > _MAX_DESCRIPTORS:
            raise ValueError(f"at most {_MAX_DESCRIPTORS} descriptors can be matched, got {len(descriptors)}")
    count1, count2 = len(descriptors1), len(descriptors2)
    of_first, of_second = [np.zeros(count1, np.int32) for _ in range(3)], [np.zeros(count2, np.int32) for _ in range(2)]
    if count1 and count2:
        first, second = np.ascontiguousarray(descriptors1), np.ascontiguousarray(descriptors2)
        results = map(pointer, (*of_first, *of_second))
        library().core_match(pointer(first), count1, pointer(second), count2, *results)
    return Nearest(*of_first, *of_second)


def extended(known: Nearest, descriptors1: Bytes, descriptors2: Bytes) -> Nearest:
    """`nearest` of both sets, of whose first descriptors it is known: only the other pairs are looked at."""
    count1, count2 = len(known.nearest), len(known.back)
    beside = nearest(descriptors1[:count1], descriptors2[count2:])
    below = nearest(descriptors1[count1:], descriptors2)
    # Scores of 0 are of empty sets; of equal ones the earlier counts, which is the known one.
    other = beside.score > known.score
    first_back = below.back_score[:count2] > known.back_score
    last_back = below.back_score[count2:] > beside.back_score
    loser = np.minimum(known.score, beside.score)
    second_score = np.maximum(loser, np.maximum(known.second_score, beside.second_score))
    return Nearest(
        np.concatenate([np.where(other, beside.nearest + count2, known.nearest), below.nearest]),
        np.concatenate([np.maximum(known.score, beside.score), below.score]),
        np.concatenate([second_score, below.second_score]),
        np.concatenate(
            [
                np.where(first_back, below.back[:count2] + count1, known.back),
                np.where(last_back, below.back[count2:] + count1, beside.back),
            ]
        ),
        np.maximum(np.concatenate([known.back_score, beside.back_score]), below.back_score),
    )


def distinct(found: Nearest, descriptors1: Bytes, config: Config) -> Index:
    """(M, 2) the mutual nearest neighbours that pass the ratio test; `descriptors1` are the first set."""
    if len(found.nearest) < 2 or len(found.back) < 2:
        return np.zeros((0, 2), np.int64)
    squared_norm = (descriptors1.astype(np.int32) ** 2).sum(1)
    nearest_squared, second_squared = (
        np.maximum(squared_norm + 2 * (_SCORE_OFFSET - value), 0) for value in (found.score, found.second_score)
    )
    mutual = found.back[found.nearest] == np.arange(len(found.nearest))
    (chosen,) = np.nonzero((nearest_squared < config.ratio**2 * second_squared) & mutual)
    chosen = chosen[np.argsort(nearest_squared[chosen] / np.maximum(second_squared[chosen], 1), kind="stable")]
    return np.stack([chosen, found.nearest[chosen]], 1).astype(np.int64)
