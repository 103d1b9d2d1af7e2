"""Inlier ratios: the share of a pair's matches that agree with the poses of a map, used or not in making it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from splatnode.recon.registration import epipolar
from splatnode.recon.registration.mapping_problem import MapperInput, Pair, Pairs, PartialMap

Array = npt.NDArray[np.float64]


def pair_errors(problem: MapperInput, partial: PartialMap) -> dict[Pair, Array]:
    """Sampson errors of the matches of all pairs of registered views, pixels at REFERENCE_SIDE."""
    return {
        (i, j): epipolar.sampson_errors(partial.estimate, (i, j), pair) / problem.scale[i]
        for (i, j), pair in problem.pairs.items()
        if i in partial.registered and j in partial.registered
    }


def inlier_ratios(problem: MapperInput, partial: PartialMap, max_error_px: float) -> dict[Pair, float]:
    """The share of each pair's matches with Sampson errors below `max_error_px`, pixels at REFERENCE_SIDE."""
    return {pair: float((errors < max_error_px).mean()) for pair, errors in pair_errors(problem, partial).items()}


def compute_pooled_ratio(ratios: Mapping[Pair, float], pairs: Pairs, view: int | None = None) -> float:
    """The share of inliers among all matches of the pairs with `ratios`, or of those with `view`; 0 without any."""
    chosen = {pair: ratio for pair, ratio in ratios.items() if view is None or view in pair}
    num_matches = sum(len(pairs[pair].matches) for pair in chosen)
    return sum(ratio * len(pairs[pair].matches) for pair, ratio in chosen.items()) / max(1, num_matches)
