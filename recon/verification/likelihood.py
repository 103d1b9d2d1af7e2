"""What the evidence amounts to: log odds that the poses are right, as sums of independent pieces.

Each piece is a log likelihood ratio, right against wrong, as registrations of real photographs show it: right ones, and
wrong ones made on purpose (a frame that poses as another, mirrored frames, thinned matches, wrong focal lengths, bad
first pairs). None counts without bound, so that none decides by its extremes. What hardly ever differs between right
and wrong when it is good counts little for an answer, and much against it when it is bad.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from splatnode.recon.verification.evidence import CameraEvidence, Evidence

PRIOR = 1.5  # a registration that got so far is mostly right
CAMERA_PRIOR = 2.5  # and so is a single camera of it

# Where a piece speaks neither for nor against:
PARTLY_EXPLAINED = 0.8  # of one camera's matches
MOSTLY_EXPLAINED = 0.72  # of all matches
SOME_PATCHES = 2.0  # found, in standard errors beyond chance
FEW_CONFIRMED = 5.0  # points of a camera that two others see
UNCERTAIN_DEG, UNCERTAIN_REL = 1.0, 0.0103  # errors to be expected of rotations and centres
FLAT = 0.985  # share of the points on one plane; facades, and meadows from afar, reach 0.98
FLAT_AND_EXPLAINED = 0.87  # of all matches: a bare facade reaches 0.85, a flat thing that moves 0.81
MIRRORED = 1.3  # cost of the mirrored answer over that of this one


@dataclass(frozen=True)
class Odds:
    whole: Mapping[str, float]  # pieces that concern all cameras together
    cameras: Mapping[str, float]  # log odds of each camera for itself, by name

    @property
    def total(self) -> float:
        """Of all cameras together."""
        return PRIOR + sum(self.whole.values())

    @property
    def against(self) -> str:
        """The piece that speaks most against the whole."""
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
    """NaN for every piece that rests on a number that is not finite, and for all that it is a part of."""
    with np.errstate(divide="ignore", invalid="ignore"):  # what comes of it is told as NaN
        return Odds(_whole(evidence), {camera.name: CAMERA_PRIOR + _camera(camera) for camera in evidence.cameras})


def _whole(evidence: Evidence) -> dict[str, float]:
    return {
        "agreement": _bounded(15.0 * (evidence.agreement - MOSTLY_EXPLAINED), -5.0, 0.3),
        "rotations": _bounded(3.0 * np.log(UNCERTAIN_DEG / max(evidence.rotation_deg, 1e-3)), -6.0, 0.3),
        # Right answers are expected to be 1.16 % wrong and less, wrong ones (by 1.5 % and more) 1.35 % and more.
        "centres": _bounded(12.0 * np.log(UNCERTAIN_REL / max(evidence.centre_rel, 1e-4)), -6.0, 0.3),
        "plane": -_bounded(60.0 * (FLAT_AND_EXPLAINED - evidence.agreement), 0.0, 6.0)
        * _bounded((evidence.flatness - FLAT) / 0.01, 0.0, 1.0),
        "mirror": _bounded(12.0 * np.log(evidence.mirrored_cost / MIRRORED), -4.0, 0.2),
    }


def _camera(camera: CameraEvidence) -> float:
    """Matches that contradict a camera are outweighed where its pixels are found where it says, and only there.

    What two frames share fixes the direction from one to the other, and no distance: that takes points of a third.
    """
    matches = _bounded(10.0 * (camera.agreement - PARTLY_EXPLAINED), -4.0, 2.0)
    patches = _bounded(0.6 * (camera.patches.sigmas - SOME_PATCHES), -2.0, 3.0)
    confirmed = _bounded(4.0 * np.log(max(camera.confirmed, 0.5) / FEW_CONFIRMED), -8.0, 0.0)
    return matches + patches + confirmed


def _bounded(value: float, least: float, most: float) -> float:
    return float(np.clip(value, least, most)) if math.isfinite(value) else math.nan
