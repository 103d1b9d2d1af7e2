"""A rung: matches by networks that were trained on wide baselines (XFeat, LighterGlue), where their weights are."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from functools import partial

from splatnode.recon.fallbacks.fallback import Fallback, FallbackState, match_weak_pairs
from splatnode.recon.learned_parts import LearnedPart, find_unavailable_reason
from splatnode.recon.priors import xfeat

PAIR = 0.48  # work, with its share of finding the photographs' points: the networks take pictures of one size only
_PART = LearnedPart("xfeat", "matches of wide baselines", xfeat.WEIGHTS, xfeat.PACKAGE)


def _match_learned(means: FallbackState, doubtful: Collection[str]) -> Iterator[FallbackState]:
    if means.config.prior.kind != "classical":  # another prior has been asked for matches
        return iter(())
    return match_weak_pairs(means, doubtful, lambda graph, pair: PAIR, matcher=xfeat.load(xfeat.Config()).matcher)


RUNG = Fallback("learned matches", _match_learned, partial(find_unavailable_reason, _PART))
