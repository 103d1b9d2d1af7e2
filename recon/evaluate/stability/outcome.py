"""Whether an answer was right: the published cameras against the truth, and the verdict against what was asked."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatnode.recon.evaluate.camera_errors import camera_errors
from splatnode.recon.evaluate.stability.case import Demand, World
from splatnode.recon.result.snapshot import CameraEstimate

RIGHT_ROTATION_DEG = 2.0  # of every relative rotation
RIGHT_CENTRE_PCT = 1.5  # of the spread of the centres


class Outcome(enum.Enum):
    ACCEPTED = "accepted"  # published, and right
    FALSE_ACCEPT = "false_accept"  # published, and wrong
    REFUSED = "refused"  # for a reason that fits
    REFUSED_OTHERWISE = "refused_otherwise"  # for another reason
    FALSE_REFUSE = "false_refuse"  # though the photographs are enough
    FAILED = "failed"  # no answer: an exception, a crash, or out of time

    @property
    def right(self) -> bool:
        return self in (Outcome.ACCEPTED, Outcome.REFUSED, Outcome.REFUSED_OTHERWISE)


@dataclass(frozen=True)
class Score:
    """How cameras compare with the truth; errors are None where the truth does not tell."""

    right: bool
    rotation_error_deg: float | None  # the largest of any relative rotation
    centre_error_pct: float | None


def compare(cameras: Sequence[CameraEstimate], worlds: Sequence[World]) -> Score:
    """Right if all `cameras` are of one world, at least two of them apart, and within both limits."""
    here = max(worlds, key=lambda w: sum(c.name in w for c in cameras), default={})
    known = [camera for camera in cameras if camera.name in here]
    if len(known) < 2:
        return Score(False, None, None)
    true = [here[camera.name] for camera in known]
    errors = camera_errors(
        np.stack([camera.T_world_camera for camera in known]),
        np.stack([camera.T_world_camera for camera in true]),
        np.stack([camera.K for camera in known]),
        np.stack([t.K_for(camera.width, camera.height) for t, camera in zip(true, known, strict=True)]),
    )
    rotation, centre = errors.rotation_pair_deg, errors.centre_pct
    right = (
        len(known) == len(cameras)
        and rotation is not None
        and centre is not None
        and rotation < RIGHT_ROTATION_DEG
        and centre < RIGHT_CENTRE_PCT
    )
    return Score(right, rotation, centre)


def outcome(demand: Demand, published: bool, published_right: bool, code_fits: bool) -> Outcome:
    """A wrong scene that is published is a false accept whatever was asked."""
    if published:
        return Outcome.ACCEPTED if published_right else Outcome.FALSE_ACCEPT
    if demand is Demand.ACCEPT:
        return Outcome.FALSE_REFUSE
    return Outcome.REFUSED if code_fits else Outcome.REFUSED_OTHERWISE
