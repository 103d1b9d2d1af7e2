"""What the others show: where a refusal is about a few photographs, the rest is judged by itself.

A photograph that shows little of what the others show, or only something that may have been moved, says nothing against
these. They are judged as if it had never been taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from splatnode.recon.config import Config
from splatnode.recon.estimation import Estimate, estimate_cameras
from splatnode.recon.frames.screening import Rejected
from splatnode.recon.result.verdict import Code

MIN_LEFT = 3  # photographs with cameras: of fewer, nothing tells whether one of them is wrong


def without_the_doubtful(
    estimate: Estimate, rejected: Sequence[Rejected], config: Config, pause: Callable[[], None]
) -> Estimate:
    """The estimate of the others, where they are most photographs, and are published exactly; else `estimate`.

    The photographs that are left out stay in its view graph, without pairs. `pause` may raise.
    """
    other, left_out = estimate, frozenset[str]()
    while not other.verdict.publishable:
        doubtful = frozenset(other.verdict.frames) - left_out
        left_out |= doubtful
        few = 2 * len(left_out) < len(estimate.graph.keyframes)
        if not doubtful or not few or len(other.registered - left_out) < MIN_LEFT:
            return estimate
        other = estimate_cameras(estimate.graph.without_pairs_of(left_out), rejected, config, pause)
    if other is estimate or other.verdict.code is Code.OK_ROUGH:
        return estimate
    return _telling(other, estimate, left_out)


def _telling(other: Estimate, refused: Estimate, left_out: frozenset[str]) -> Estimate:
    """With the reason for which the first photographs were left out."""
    found, count = len(other.placed), len(other.graph.keyframes)
    names = ", ".join(name for name in other.graph.names if name in left_out)
    gone = f"{names} {'was' if len(left_out) == 1 else 'were'} left out"
    message = f"{found} of {count} photographs were placed, after {gone}: {refused.verdict.message}"
    verdict = replace(other.verdict, code=Code.OK_PARTIAL, message=message, advice=refused.verdict.advice)
    return replace(other, verdict=verdict)
