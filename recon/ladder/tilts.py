"""A rung: simulated tilts in both directions, and stronger ones, as affine SIFT has them (Morel and Yu, 2009)."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from splatnode.recon.ladder.rung import Means, Rung, with_matches

# Of the width, and below 1 of the height. The first matching has 1.6 of the width.
_TILTS = (1.0 / 1.6, 2.5)


def _climb(means: Means, doubtful: Collection[str]) -> Iterator[Means]:
    return with_matches(means, doubtful, _TILTS, matcher=None)


RUNG = Rung("stronger tilts", _climb)
