"""The verdicts with which a scene is published, in words: which frames it has, and what is to be said of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification.causes import explain_wide_bounds
from splatnode.recon.verification.checks import VerificationCase


def accept(case: VerificationCase) -> Verdict:
    """OK where all photographs were placed, exactly; else what the others show, or how roughly they are placed."""
    left_out = _find_unplaced_frames(case)
    rough = _describe_roughness(case)
    if rough:
        message = f"{_summarize_placement(case)}, roughly: {rough}."
        found = Verdict(Code.OK_ROUGH, message, _advise_remedy(case), left_out, publishable=True)
    else:
        found = _accept_partial(case, left_out) if left_out else _accept_all(case)
    lenses = _describe_own_lenses(case)
    return replace(found, message=f"{found.message} {lenses}") if lenses else found


def _describe_own_lenses(case: VerificationCase) -> str:
    """A sentence about images whose lens is not the one that they were taken to share, or that was given."""
    names = case.graph.names
    own = {names[camera.index]: camera.focal for camera in case.registration.cameras if camera.own_lens}
    if not own:
        return ""
    others = [camera.focal for camera in case.registration.cameras if not camera.own_lens]
    beside = f"; the others have {np.median(others):.0f}" if others else ""
    if len(own) == 1:
        ((name, focal),) = own.items()
        return f"{name} has a lens of its own, with a focal length of {focal:.0f} pixels{beside}."
    least, most = min(own.values()), max(own.values())
    return (
        f"{len(own)} images have lenses of their own, with focal lengths of {least:.0f} to {most:.0f} pixels{beside}."
    )


def _find_unplaced_frames(case: VerificationCase) -> tuple[str, ...]:
    placed = {camera.index for camera in case.registration.cameras}
    return tuple(name for index, name in enumerate(case.graph.names) if index not in placed)


def _summarize_placement(case: VerificationCase) -> str:
    placed, count = len(case.registration.cameras), len(case.graph.keyframes)
    return f"{'All' if placed == count else f'{placed} of'} {count} photographs were placed"


def _describe_roughness(case: VerificationCase) -> str:
    """Describes what is known less well than in an exact scene; empty where nothing is."""
    if case.is_exact:
        return ""
    worst = case.widest_bounds
    return (
        f"positions are known to {worst.centre_percent:.2g} % of the distance to the scene "
        f"({case.travel_percent:.2g} % of how far the camera moved), directions to {worst.rotation_deg:.2g} degrees, "
        f"the focal length to {worst.focal_percent:.2g} %"
    )


def _advise_remedy(case: VerificationCase) -> str:
    """Returns the remedy for the cause that made the scene rough."""
    return explain_wide_bounds(case).advice


def _accept_partial(case: VerificationCase, left_out: tuple[str, ...]) -> Verdict:
    graph, summary = case.graph, _summarize_placement(case)
    names, placed = graph.names, {camera.index for camera in case.registration.cameras}
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
    if len(apart) == len(left_out) == 1 and len(placed) > 3:
        return Verdict(
            Code.OUTLIER_VIEW,
            f"{summary}; {left_out[0]} shows nothing of what the others show.",
            "Leave it out, or add a photograph between it and the others.",
            left_out,
            publishable=True,
        )
    return Verdict(
        Code.OK_PARTIAL,
        f"{summary}; {len(left_out)} share too little with them.",
        f"Add a photograph between the others and {left_out[0]}.",
        left_out,
        publishable=True,
    )


def _accept_all(case: VerificationCase) -> Verdict:
    exposure_ratio, cameras = case.config.exposure_ratio, case.evidence.cameras
    gains = {camera.name: camera.gain for camera in cameras}  # finite, for `check_finite` let them pass
    ratio = max(gains.values()) / min(gains.values())
    if ratio <= exposure_ratio:
        return Verdict(Code.OK, f"{_summarize_placement(case)}.", "", (), publishable=True)
    limit = exposure_ratio**0.5
    return Verdict(
        Code.EXPOSURE_SHIFT,
        f"{_summarize_placement(case)}; the brightest is exposed {ratio:.1f} times as much as the darkest.",
        "Lock exposure and white balance.",
        tuple(name for name, gain in gains.items() if not 1 / limit < gain < limit),
        publishable=True,
    )


def make_overfit_verdict(names: Sequence[str], iterations: int, kept: int, before: float, after: float) -> Verdict:
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
