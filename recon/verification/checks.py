"""Checks of registered poses, each of one piece of evidence: a refusal, or None where nothing speaks against them.

A limit is asked so that NaN refuses: "not (value <= limit)", never "value > limit".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.register import Registration
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.verification import refusals
from splatnode.recon.verification.config import Config
from splatnode.recon.verification.evidence import Evidence
from splatnode.recon.verification.lens import FreedLens
from splatnode.recon.verification.refusals import refuse


@dataclass(frozen=True, eq=False)
class Case:
    """Registered poses, and what there is to decide about them with."""

    graph: ViewGraph
    registration: Registration
    evidence: Evidence
    config: Config

    @property
    def names(self) -> list[str]:
        """Of the frames that were placed."""
        return [camera.name for camera in self.evidence.cameras]


def given_focal(case: Case) -> Verdict | None:
    """The photographs contradict a focal length that came with them."""
    doubted = [freed for freed in case.evidence.freed if _contradicted(freed, case.config)]
    if not doubted:
        return None
    worst = max(doubted, key=lambda lens: abs(lens.found / lens.given - 1.0))
    change = 100 * (worst.found / worst.given - 1.0)
    return refuse(refusals.WRONG_FOCAL, case.names, given=worst.given, found=worst.found, change=change)


def _contradicted(freed: FreedLens, config: Config) -> bool:
    change = abs(np.log(freed.found / freed.given))
    if freed.trusted:
        return not (change <= config.focal_change or freed.cost_ratio >= config.focal_gain)
    held_back = abs(np.log(freed.found / freed.registered))
    return not (change <= config.nominal_change or held_back <= config.held_back)


def distortion(case: Case) -> Verdict | None:
    """The lens distorts the picture by more than registration found."""
    found, config = case.evidence.distortion, case.config
    if found.cost_ratio >= config.focal_gain or found.corner_shift <= config.corner_shift:
        return None
    return refuse(refusals.DISTORTED, case.names, further=100 * found.corner_shift)


def weakest_link(case: Case) -> Verdict | None:
    """Two groups of frames share almost no points."""
    link = case.evidence.weakest_link
    if link.shared_points >= case.config.min_link_points:
        return None
    return _apart([case.graph.keyframes[index].name for index in link.smaller_part])


def disconnected(case: Case) -> Verdict | None:
    """Only contradicted matches join some frames to most of the others."""
    return _apart(case.evidence.disconnected) if case.evidence.disconnected else None


def _apart(frames: Sequence[str]) -> Verdict:
    return refuse(refusals.APART, frames, count=len(frames))


def mirrored_photographs(case: Case) -> Verdict | None:
    """Some photographs match the others better when they are turned left to right."""
    found = case.evidence.reflection
    if found.gain <= case.config.max_reflection:
        return None
    return refuse(refusals.MIRRORED_PHOTOGRAPHS, found.frames, count=len(found.frames))


def viewing_angle(case: Case) -> Verdict | None:
    """Points are seen from almost the same direction by all frames."""
    return None if case.evidence.median_angle_deg >= case.config.min_angle_deg else too_close(case)


def focal_sigma(case: Case) -> Verdict | None:
    """The observations leave a focal length open."""
    sigma = case.evidence.focal_sigma
    if sigma <= case.config.max_focal_sigma:
        return None
    return refuse(refusals.UNCERTAIN_FOCAL, case.names, sigma=100 * sigma)


def too_close(case: Case) -> Verdict:
    """The positions are too uncertain: because the camera turned instead of moving, or moved too little."""
    evidence, config, pairs = case.evidence, case.config, case.graph.pairs.values()
    matches = sum(len(view.matches) for view in pairs)
    turned = sum(view.num_rotation for view in pairs) / max(1, matches)
    if not turned <= config.explained_by_turning:
        found = f"a turn explains {100 * turned:.0f} % of all matches"
        return refuse(refusals.NO_PARALLAX, case.names, found=found)
    if sum(view.num_homography for view in pairs) > config.explained_by_plane * matches:
        return refuse(refusals.PLANAR, case.names)
    return refuse(
        refusals.TOO_CLOSE,
        case.names,
        centre=100 * evidence.centre_rel,
        rotation_deg=evidence.rotation_deg,
        angle_deg=evidence.median_angle_deg,
    )
