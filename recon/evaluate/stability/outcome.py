"""Whether an answer was right: the published cameras against the truth, and the verdict against what was asked."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass

from splatnode.recon.evaluate.stability.case import Demand, World
from splatnode.recon.evaluate.stability.claim import (
    CameraError,
    has_only_right_cameras,
    measure_camera_errors,
    measure_set_errors,
)
from splatnode.recon.result.snapshot import CameraEstimate


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

    right: bool  # of one world, and none of them wrong
    rotation_error_deg: float | None  # the largest of any relative rotation
    centre_error_pct: float | None  # RMS, of the true centres' spread
    exact: bool = False  # of one world, and each camera within 2 degrees and 5 % of the spread
    errors: tuple[CameraError, ...] = ()  # of the cameras of the world that has most of them


def score_cameras(cameras: Sequence[CameraEstimate], worlds: Sequence[World], rough: bool = False) -> Score:
    """Right if all `cameras` are of one world, at least two of them apart, and none is wrong.

    Wrong is a camera beyond 2.5 times one of its 95 % bounds; or, unless the verdict says that the cameras are known
    roughly (`rough`), one beyond 5 degrees or 10 % of the distance to the scene. Other methods claim nothing: there a
    camera is wrong beyond 5 degrees or 10 % of the centres' spread, which is more lenient than 2 degrees and 1.5 %,
    by which all methods were judged as long as a verdict had limits instead of bounds.
    """
    here = max(worlds, key=lambda w: sum(c.name in w for c in cameras), default={})
    known = [camera for camera in cameras if camera.name in here]
    if len(known) < 2:
        return Score(False, None, None)
    whole, errors = measure_set_errors(known, here), measure_camera_errors(known, here)
    together = len(known) == len(cameras)
    right = together and not any(error.is_wrong(rough) for error in errors)
    return Score(right, whole.rotation_pair_deg, whole.centre_pct, together and has_only_right_cameras(errors), errors)


def classify_outcome(demand: Demand, published: bool, published_right: bool, code_fits: bool) -> Outcome:
    """A wrong scene that is published is a false accept whatever was asked."""
    if published:
        return Outcome.ACCEPTED if published_right else Outcome.FALSE_ACCEPT
    if demand is Demand.ACCEPT:
        return Outcome.FALSE_REFUSE
    return Outcome.REFUSED if code_fits else Outcome.REFUSED_OTHERWISE
