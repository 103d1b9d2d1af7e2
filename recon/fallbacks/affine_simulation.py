"""A rung: simulated tilts in both directions, and stronger ones, as affine SIFT has them (Morel and Yu, 2009)."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np

from splatnode.recon.fallbacks.fallback import Fallback, FallbackState, match_weak_pairs
from splatnode.recon.frames.keyframe import PLAIN
from splatnode.recon.matching.features import count_search_pixels
from splatnode.recon.matching.view_graph import Pair, ViewGraph

# Of the width, and below 1 of the height. The first matching has 1.6 of the width.
_TILTS = (1.0 / 1.6, 2.5)
_PIXEL = 2.3e-7  # work of finding features of both tilts, for each pixel that plain ones are looked for in
_COMPARISON = 2.8e-9  # work, for each two plain features: about 2.8 times as many of other tilts are compared


def _match_affine(means: FallbackState, doubtful: Collection[str]) -> Iterator[FallbackState]:
    return match_weak_pairs(means, doubtful, _estimate_work, _TILTS)


def _estimate_work(graph: ViewGraph, pair: Pair) -> float:
    """Estimates the work of simulating tilts of the pair's images, and of comparing their features."""
    both = [graph.keyframes[index] for index in pair]
    untilted = [each for each in both if not np.isin(_TILTS, each.features.tilt).all()]
    searched = sum(count_search_pixels(each.frame.image, graph.config.features) for each in untilted)
    compared = np.prod([(each.features.tilt == PLAIN).sum() for each in both], dtype=float)
    return _PIXEL * searched + _COMPARISON * float(compared)


RUNG = Fallback("stronger tilts", _match_affine)
