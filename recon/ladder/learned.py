"""A rung: matches by networks that were trained on wide baselines (XFeat, LighterGlue), where their weights are."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from functools import partial

from splatnode.recon.ladder.rung import Means, Rung, with_matches
from splatnode.recon.learned_parts import LearnedPart, obstacle
from splatnode.recon.priors import xfeat

PAIR = 0.48  # work, with its share of finding the photographs' points: the networks take pictures of one size only
_PART = LearnedPart("xfeat", "matches of wide baselines", xfeat.WEIGHTS, xfeat.PACKAGE)


def _climb(means: Means, doubtful: Collection[str]) -> Iterator[Means]:
    if means.config.prior.kind != "classical":  # another prior has been asked for matches
        return iter(())
    return with_matches(means, doubtful, lambda graph, pair: PAIR, matcher=xfeat.load(xfeat.Config()).matcher)


RUNG = Rung("learned matches", _climb, partial(obstacle, _PART))
