"""The verdicts with which a scene is published, in words: which frames it has, and what is to be said of them."""

from __future__ import annotations

from collections.abc import Sequence

from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.register import Registration
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification.evidence import Evidence


def accepted(graph: ViewGraph, registration: Registration, evidence: Evidence, exposure_ratio: float) -> Verdict:
    """OK where all frames were placed; else what the others show. From `exposure_ratio` on, a change of light is noted.

    The ratio is between the brightest and the darkest exposure.
    """
    names = [keyframe.name for keyframe in graph.keyframes]
    placed = {camera.index for camera in registration.cameras}
    missing = [i for i in range(len(names)) if i not in placed]
    if not missing:
        return _all_placed(evidence, exposure_ratio)
    left_out = tuple(names[i] for i in missing)
    summary = f"{len(placed)} of {len(names)} frames were placed"
    apart = [part for part in graph.components() if not placed & set(part)]
    if any(len(part) > 1 for part in apart):
        return Verdict(
            Code.SPLIT,
            f"{summary}; others show a place of their own: "
            + "; ".join(", ".join(names[i] for i in part) for part in apart)
            + ".",
            "Add photographs that connect the places, or take them one after the other.",
            left_out,
            publishable=True,
        )
    if len(apart) == len(missing) == 1 and len(placed) > 3:
        return Verdict(
            Code.OUTLIER_VIEW,
            f"{summary}; {left_out[0]} shows nothing of what the others show.",
            "Leave it out, or add a photograph between it and the others.",
            left_out,
            publishable=True,
        )
    return Verdict(
        Code.OK_PARTIAL,
        f"{summary}; {len(missing)} share too little with them.",
        f"Add a photograph between the others and {left_out[0]}.",
        left_out,
        publishable=True,
    )


def _all_placed(evidence: Evidence, exposure_ratio: float) -> Verdict:
    count = len(evidence.cameras)
    gains = {camera.name: camera.gain for camera in evidence.cameras}  # finite, for `undetermined` let them pass
    ratio = max(gains.values()) / min(gains.values())
    if ratio <= exposure_ratio:
        return Verdict(Code.OK, f"All {count} frames were placed.", "", (), publishable=True)
    limit = exposure_ratio**0.5
    return Verdict(
        Code.EXPOSURE_SHIFT,
        f"All {count} frames were placed; the brightest is exposed {ratio:.1f} times as much as the darkest.",
        "Lock exposure and white balance.",
        tuple(name for name, gain in gains.items() if not 1 / limit < gain < limit),
        publishable=True,
    )


def overfitted(names: Sequence[str], iterations: int, kept: int, before: float, after: float) -> Verdict:
    """OVERFIT: the scene after `kept` iterations is published in place of the one after `iterations`.

    `before` and `after` are their misfits between the photographs.
    """
    return Verdict(
        Code.OVERFIT,
        f"The refinement overfitted the photographs: between them the scene misses what stereo shows by {after:.2g} "
        f"after {iterations} iterations, and by {before:.2g} after {kept}, which is the scene that is given.",
        "Take smaller steps (optimize.rates) or fewer (optimize.iterations), or a preset as it is.",
        tuple(names),
        publishable=True,
    )
