"""What the evidence amounts to: log odds that the poses are right, as sums of independent terms.

Each term is a log likelihood ratio, right against wrong, as registrations of real photographs show it: right ones, and
wrong ones made on purpose (a frame that poses as another, mirrored frames, thinned matches, wrong focal lengths, bad
first pairs). Each is linear in its measure, or in the logarithm of it, and clipped, so that none decides by its
extremes. The terms are asymmetric: a good value is weak evidence for the poses, for wrong poses often have one, too; a
bad value is strong evidence against them. Where a term is 0 lies between what right and what wrong registrations
showed; slopes and bounds were set by hand so that both kinds come out right together, not fitted one by one. Beside
each term stands the value at which it outweighs the prior by itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from splatnode.recon.verification.evidence import CameraEvidence, Evidence


@dataclass(frozen=True)
class Term:
    """`slope` times how far a measure is on the good side of the point where it says nothing, clipped.

    In nats (natural log odds). Slopes are per unit of the measure, or per factor e where its logarithm counts.
    """

    slope: float
    least: float  # against the poses at most
    most: float  # for the poses at most

    def of(self, distance: float) -> float:
        """NaN where the distance is not finite: clipping must not hide that something could not be computed."""
        return _clipped(self.slope * distance, self.least, self.most)


PRIOR = 1.5  # nats: a registration that got so far is mostly right, about 4.5 to 1
CAMERA_PRIOR = 2.5  # nats: and so is a single camera of it, about 12 to 1

# Of all cameras together: where a term is 0, and the term.
NEUTRAL_INLIER_RATIO = 0.72  # of all matches
INLIER_RATIO = Term(slope=15.0, least=-5.0, most=0.3)  # outweighs the prior below a ratio of 0.62
NEUTRAL_ROTATION_DEG = 1.0  # error to be expected
ROTATIONS = Term(slope=3.0, least=-6.0, most=0.3)  # above 1.65 degrees
MIN_ROTATION_DEG = 1e-3  # smaller errors count as this: the term has been clipped long before
NEUTRAL_CENTRE_REL = 0.0103  # error to be expected, relative to the spread of the centres
# Steep: right answers are expected to be 1.16 % wrong and less, wrong ones (by 1.5 % and more) 1.35 % and more.
CENTRES = Term(slope=12.0, least=-6.0, most=0.3)  # above 1.17 %
MIN_CENTRE_REL = 1e-4  # as MIN_ROTATION_DEG
NEUTRAL_MIRRORED_COST = 1.3  # of the answer mirrored in depth over this one's: at 1 nothing tells them apart
MIRRORED_COST = Term(slope=12.0, least=-4.0, most=0.2)  # below 1.15

# One plane that moves before a scene that stands still: flat, and matches that do not fit. It only speaks against.
FLAT = 0.985  # share of the points on one plane where suspicion begins; facades, and meadows from afar, reach 0.98
FLAT_RANGE = 0.01  # from there to full suspicion
FLAT_INLIER_RATIO = 0.87  # of all matches where it ends: a bare facade reaches 0.85, a flat thing that moves 0.81
MOVING_PLANE = Term(slope=60.0, least=0.0, most=6.0)  # at full suspicion below 0.845, between the two

# Of one camera:
NEUTRAL_CAMERA_INLIER_RATIO = 0.8  # of its matches
CAMERA_INLIER_RATIO = Term(slope=10.0, least=-4.0, most=2.0)  # below 0.55, unless patches are found
NEUTRAL_PATCHES = 2.0  # patches found on the predicted lines, in standard errors beyond chance
PATCHES = Term(slope=0.6, least=-2.0, most=3.0)  # never: a right camera may stand too far aside to be compared
NEUTRAL_CONFIRMED = 5.0  # points of the camera that two others see
CONFIRMED = Term(slope=4.0, least=-8.0, most=0.0)  # below 2.7 points
MIN_CONFIRMED = 0.5  # none counts as half a point: a logarithm is taken


@dataclass(frozen=True)
class Odds:
    """In nats; NaN where a number behind them could not be computed."""

    whole: Mapping[str, float]  # terms that concern all cameras together, by the evidence that they rest on
    cameras: Mapping[str, float]  # log odds of each camera for itself, by name

    @property
    def total(self) -> float:
        """Of all cameras together."""
        return PRIOR + sum(self.whole.values())

    @property
    def against(self) -> str:
        """The term that speaks most against the whole."""
        return min(self.whole, key=lambda name: self.whole[name])

    @property
    def doubtful(self) -> tuple[str, ...]:
        """Cameras that are more likely wrong than right, or of which nobody can say."""
        return tuple(name for name, odds in self.cameras.items() if not odds >= 0.0)


def record(evidence: Evidence) -> dict[str, object]:
    """The evidence and what it amounts to, for report.json: None stands for a number that could not be computed."""
    odds = weigh(evidence)
    log_odds = {"total": odds.total, "whole": dict(odds.whole), "cameras": dict(odds.cameras)}
    return {name: _with_none(value) for name, value in {**asdict(evidence), "log_odds": log_odds}.items()}


def _with_none(value: Any) -> Any:
    """The value of dictionaries, lists and tuples with None for every number that is not finite."""
    if isinstance(value, dict):
        return {key: _with_none(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_with_none(each) for each in value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def weigh(evidence: Evidence) -> Odds:
    """NaN for every term that rests on a number that is not finite, and for all that it is a part of."""
    with np.errstate(divide="ignore", invalid="ignore"):  # what comes of it is told as NaN
        return Odds(_whole(evidence), {camera.name: CAMERA_PRIOR + _camera(camera) for camera in evidence.cameras})


def _whole(evidence: Evidence) -> dict[str, float]:
    rotation_deg = np.maximum(evidence.rotation_deg, MIN_ROTATION_DEG)
    centre_rel = np.maximum(evidence.centre_rel, MIN_CENTRE_REL)
    suspicion = _clipped((evidence.flatness - FLAT) / FLAT_RANGE, 0.0, 1.0)
    return {
        "inlier_ratio": INLIER_RATIO.of(evidence.inlier_ratio - NEUTRAL_INLIER_RATIO),
        "rotations": ROTATIONS.of(np.log(NEUTRAL_ROTATION_DEG / rotation_deg)),
        "centres": CENTRES.of(np.log(NEUTRAL_CENTRE_REL / centre_rel)),
        "plane": -MOVING_PLANE.of(FLAT_INLIER_RATIO - evidence.inlier_ratio) * suspicion,
        "mirror": MIRRORED_COST.of(np.log(evidence.mirrored_cost / NEUTRAL_MIRRORED_COST)),
    }


def _camera(camera: CameraEvidence) -> float:
    """Matches that contradict a camera are outweighed where its pixels are found where it says, and only there.

    What two frames share fixes the direction from one to the other, and no distance: that takes points of a third.
    """
    matches = CAMERA_INLIER_RATIO.of(camera.inlier_ratio - NEUTRAL_CAMERA_INLIER_RATIO)
    patches = PATCHES.of(camera.patches.sigmas - NEUTRAL_PATCHES)
    confirmed = CONFIRMED.of(np.log(np.maximum(camera.confirmed, MIN_CONFIRMED) / NEUTRAL_CONFIRMED))
    return matches + patches + confirmed


def _clipped(value: float, least: float, most: float) -> float:
    return float(np.clip(value, least, most)) if math.isfinite(value) else math.nan
