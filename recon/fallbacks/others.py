"""What the others show: where a refusal is about a few photographs, the rest is judged by itself.

A photograph that shows little of what the others show, or only something that may have been moved, says nothing against
these. They are judged as if it had never been taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction, estimate_cameras
from splatnode.recon.frames.screening import Rejected
from splatnode.recon.result.verdict import Code

MIN_LEFT = 3  # photographs with cameras: of fewer, nothing tells whether one of them is wrong


def estimate_without_doubtful(
    estimate: Reconstruction, rejected: Sequence[Rejected], config: ReconstructionConfig, pause: Callable[[], None]
) -> Reconstruction:
    """The estimate of the others, where they are most photographs, and are published exactly; else `estimate`.

    The photographs that are left out stay in its view graph, without pairs. `pause` may raise.
    """
    other, left_out = estimate, frozenset[str]()
    while not other.verdict.publishable:
        doubtful = frozenset(other.verdict.frames) - left_out
        left_out |= doubtful
        few = 2 * len(left_out) < len(estimate.graph.keyframes)
        if not doubtful or not few or len(other.camera_names - left_out) < MIN_LEFT:
            return estimate
        other = estimate_cameras(estimate.graph.forget_pairs(left_out), rejected, config, pause)
    if other is estimate or other.verdict.code is Code.OK_ROUGH:
        return estimate
    return _explain_left_out(other, estimate, left_out)


def _explain_left_out(other: Reconstruction, refused: Reconstruction, left_out: frozenset[str]) -> Reconstruction:
    """Explains in the verdict why the other images were left out."""
    found, count = len(other.publishable_camera_names), len(other.graph.keyframes)
    names = ", ".join(name for name in other.graph.names if name in left_out)
    gone = f"{names} {'was' if len(left_out) == 1 else 'were'} left out"
    message = f"{found} of {count} photographs were placed, after {gone}: {refused.verdict.message}"
    verdict = replace(other.verdict, code=Code.OK_PARTIAL, message=message, advice=refused.verdict.advice)
    return replace(other, verdict=verdict)
