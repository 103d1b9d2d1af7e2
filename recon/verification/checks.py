"""Checks of registered poses, each of one piece of evidence: a refusal, or None where nothing speaks against them.

A limit is asked so that NaN refuses: "not (value <= limit)", never "value > limit".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.register import Registration
from splatnode.recon.result.bounds import Bounds, find_widest
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.verification import refusals
from splatnode.recon.verification.claims import compute_travel_percent, predict_bounds
from splatnode.recon.verification.config import DecisionConfig
from splatnode.recon.verification.evidence import Evidence
from splatnode.recon.verification.lens import FreedLens
from splatnode.recon.verification.models import VerdictModel
from splatnode.recon.verification.refusals import refuse


@dataclass(frozen=True, eq=False)
class EvidenceCase:
    """The evidence of registered poses, and the numbers to judge it by."""

    evidence: Evidence
    config: DecisionConfig
    numbers: VerdictModel

    @cached_property
    def bounds(self) -> Mapping[str, Bounds]:
        """Returns the bounds of each camera's errors, by its name."""
        return predict_bounds(self.evidence, self.numbers.claims)

    @property
    def widest_bounds(self) -> Bounds:
        """The widest bound of each kind. Raises ValueError where there is no camera."""
        found = find_widest(self.bounds.values())
        if found is None:
            raise ValueError("there must be a camera to be judged")
        return found

    @property
    def travel_percent(self) -> float:
        """The widest bound of a centre, of how far the camera moved."""
        return compute_travel_percent(self.bounds, self.evidence)

    @property
    def is_exact(self) -> bool:
        """Whether what is known is as good as a right answer; else it is rough."""
        worst, config = self.widest_bounds, self.config
        return (
            worst.rotation_deg <= config.exact_rotation_deg
            and worst.focal_percent <= config.exact_focal_percent
            and self.travel_percent <= config.exact_travel_percent
        )

    @property
    def is_usable(self) -> bool:
        """Whether the bounds are narrow enough for anything to be done with the cameras."""
        worst, config = self.widest_bounds, self.config
        return (
            worst.rotation_deg <= config.max_rotation_deg
            and worst.centre_percent <= config.max_centre_percent
            and self.travel_percent <= config.max_travel_percent
        )

    @property
    def names(self) -> list[str]:
        """Returns the names of the frames that were placed."""
        return [camera.name for camera in self.evidence.cameras]


@dataclass(frozen=True, eq=False)
class VerificationCase(EvidenceCase):
    """Registered poses, and where they come from."""

    graph: ViewGraph
    registration: Registration


def check_given_lens(case: EvidenceCase) -> Verdict | None:
    """Most images refute the lens that was given for them: it is wrong, not they."""
    changes = [camera.refuted_focal for camera in case.evidence.cameras if camera.refuted_focal > 0]
    refuted = [change for change in changes if change != 1.0]
    if 2 * len(refuted) <= len(changes):
        return None
    change = 100 * (float(np.median(refuted)) - 1.0)
    return refuse(refusals.WRONG_LENS, case.names, refuted=len(refuted), count=len(changes), change=change)


def check_given_focal(case: EvidenceCase) -> Verdict | None:
    """The photographs contradict a focal length that came with them."""
    doubted = [freed for freed in case.evidence.freed if _is_contradicted(freed, case.config)]
    if not doubted:
        return None
    worst = max(doubted, key=lambda lens: abs(lens.found / lens.given - 1.0))
    change = 100 * (worst.found / worst.given - 1.0)
    return refuse(refusals.WRONG_FOCAL, case.names, given=worst.given, found=worst.found, change=change)


def _is_contradicted(freed: FreedLens, config: DecisionConfig) -> bool:
    change = abs(np.log(freed.found / freed.given))
    if freed.trusted:
        return not (change <= config.focal_change or freed.cost_ratio >= config.focal_gain)
    held_back = abs(np.log(freed.found / freed.registered))
    return not (change <= config.nominal_change or held_back <= config.held_back)


def check_distortion(case: EvidenceCase) -> Verdict | None:
    """The lens distorts the picture by more than registration found."""
    found, config = case.evidence.distortion, case.config
    if found.cost_ratio >= config.focal_gain or found.corner_shift <= config.corner_shift:
        return None
    return refuse(refusals.DISTORTED, case.names, further=100 * found.corner_shift)


def check_moving_plane(case: EvidenceCase) -> Verdict | None:
    """All that fits is one plane, and much does not fit with it: a flat thing that moves before what stands still."""
    evidence, config = case.evidence, case.config
    explained = evidence.inlier_ratio > config.moving_inlier_ratio
    if evidence.flatness < config.moving_flatness or (explained and np.isfinite(evidence.flatness)):
        return None
    return refuse(refusals.MOVING, case.names, inliers=100 * evidence.inlier_ratio)


def check_weakest_link(case: EvidenceCase) -> Verdict | None:
    """Two groups of frames share almost no points."""
    link = case.evidence.weakest_link
    if link.shared_points >= case.config.min_link_points:
        return None
    return _refuse_split(link.smaller_part)


def check_connectivity(case: EvidenceCase) -> Verdict | None:
    """Only contradicted matches join some frames to most of the others."""
    return _refuse_split(case.evidence.disconnected) if case.evidence.disconnected else None


def _refuse_split(frames: Sequence[str]) -> Verdict:
    return refuse(refusals.APART, frames, count=len(frames))


def check_mirrored_images(case: EvidenceCase) -> Verdict | None:
    """Some photographs match the others better when they are turned left to right."""
    found = case.evidence.reflection
    if found.gain <= case.config.max_reflection:
        return None
    return refuse(refusals.MIRRORED_PHOTOGRAPHS, found.frames, count=len(found.frames))


def check_required_precision(case: EvidenceCase) -> Verdict | None:
    """The centres are known less well than the user requires."""
    needed = case.config.require_percent
    if needed is None or case.widest_bounds.centre_percent <= needed:
        return None
    return refuse(refusals.ROUGHER, case.names, found=case.widest_bounds.centre_percent, needed=needed)
