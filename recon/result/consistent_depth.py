"""Multi-view consistent depth: how much of a scene was measured by several views, in words of a verdict.

Cameras can be right, and most of the scene a guess all the same: where only one view knows a depth, or none, the scene
is like the photographs from their cameras, and like nothing in particular from elsewhere.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import msgspec

from splatnode.recon.result.verdict import Verdict

ADVICE = "Add photographs between these, a short step apart, so that each shows most of what the next one shows."


class ConsistentDepthConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    # Share of the pixels with multi-view consistent depth below which the verdict calls views away from the cameras
    # guesses. Of 22 sets of real photographs the ten below it reach 18.1 dB on held-out views, at most 21.7, and the
    # twelve above it 22.8 dB (tests/bench/results/consistent_depth.json). 0: never
    min_share: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.45


def format_percent(share: float) -> str:
    """A share in percent, rounded down: what is not measured is not claimed."""
    return f"{int(100 * share + 1e-9)} %"


def is_guess(share: float, config: ConsistentDepthConfig) -> bool:
    """Whether views away from the cameras show guesses, by the `share` of pixels with multi-view consistent depth."""
    return share < config.min_share


def append_consistent_depth(verdict: Verdict, share: float | None, config: ConsistentDepthConfig) -> Verdict:
    """The verdict with a sentence on the share of multi-view consistent depth, and advice where it is too small."""
    if share is None or not verdict.publishable:
        return verdict
    if not is_guess(share, config):
        return replace(
            verdict,
            message=f"{verdict.message} Other views confirm the depth of {format_percent(share)} of the pixels.",
        )
    told = f"Other views confirm the depth of only {format_percent(share)} of the pixels"
    return replace(
        verdict,
        message=f"{verdict.message} {told}: views away from the cameras are guesses.",
        advice=f"{verdict.advice} {ADVICE}".strip(),
    )
