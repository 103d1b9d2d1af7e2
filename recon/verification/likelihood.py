"""What the evidence amounts to: log odds that the poses are right, as a sum of terms (logistic regression).

Wrong are poses whose errors are beyond what is claimed of them (claims.py). Each term is linear in one measure of all
cameras together, counted from its value in right registrations; where one camera is worse than the others, the worst
one counts. A measure is clipped where more of it says nothing more, so that none decides by its extremes. `fitted.py`
has the slopes, which `python -m tests.bench fit` finds from registrations of real photographs: right ones, and wrong
ones as they come, or made on purpose (frames that pose as others, mirrored frames, posters, moving things, crops).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from splatnode.recon.verification.claims import ErrorModel, compute_travel_percent, predict_bounds
from splatnode.recon.verification.evidence import CameraEvidence, Evidence

# A camera whose matches lie on one plane that fills little of its picture may see a poster, a screen or a thing that
# moves: from this share of the matches on, and fully from the other.
FLAT_FROM, FLAT_FULLY = 0.8, 0.95
SMALL = 0.35  # share of the picture that the plane fills, below which it counts; half of it counts as much again
MIN_SHARE = 0.02  # a smaller one counts as this: a logarithm is taken


@dataclass(frozen=True)
class Term:
    """`slope` times how far a measure is from what it is in right registrations, in nats (natural log odds)."""

    typical: float
    slope: float

    def evaluate(self, measure: float) -> float:
        return self.slope * (measure - self.typical)


@dataclass(frozen=True)
class OddsModel:
    prior: float  # nats: where all measures are typical
    terms: Mapping[str, Term]  # by what `compute_measures` calls them


@dataclass(frozen=True)
class Odds:
    """In nats; NaN where a number behind them could not be computed."""

    prior: float
    terms: Mapping[str, float]  # by the measure that they rest on

    @property
    def total(self) -> float:
        return self.prior + sum(self.terms.values())

    @property
    def strongest_rejection(self) -> str:
        """The term that speaks most against the poses."""
        return min(self.terms, key=lambda name: self.terms[name])


def compute_measures(evidence: Evidence, model: ErrorModel) -> dict[str, float]:
    """Computes the measures that the terms rest on; NaN where a number behind one is not finite."""
    bounds, cameras = predict_bounds(evidence, model), evidence.cameras
    link = evidence.weakest_link
    return {
        "inlier_ratio": _clip(evidence.inlier_ratio, 0.0, 0.95),
        "camera_inlier_ratio": _clip(min(camera.inlier_ratio for camera in cameras), 0.0, 0.95),
        "link_inlier_ratio": _clip(link.inlier_ratio, 0.0, 1.0),
        "coverage": _clip_log(min(camera.coverage for camera in cameras), 0.05, 0.5),
        "flat_patch": max(_measure_flat_patch(camera) for camera in cameras),
        "mirrored_cost": _clip_log(evidence.mirrored_cost, 0.8, 10.0),
        "reflection": _clip(evidence.reflection.gain, 0.1, 1.0),
        "directions": _clip_log(evidence.cycles.direction_sigmas, 1.0, 30.0),
        "own_lens": float(any(camera.own_lens for camera in cameras)),
        "rotation_bound": _clip_log(max(each.rotation_deg for each in bounds.values()), 0.3, 30.0),
        "travel_bound": _clip_log(compute_travel_percent(bounds, evidence), 0.5, 100.0),
    }


def compute_log_odds(evidence: Evidence, claim_model: ErrorModel, model: OddsModel) -> Odds:
    """NaN for every term that rests on a number that is not finite."""
    with np.errstate(divide="ignore", invalid="ignore"):  # what comes of it is told as NaN
        found = compute_measures(evidence, claim_model)
    return Odds(model.prior, {name: term.evaluate(found[name]) for name, term in model.terms.items()})


def make_evidence_record(evidence: Evidence, odds: Odds) -> dict[str, object]:
    """The evidence and what it amounts to, for report.json: None stands for a number that could not be computed."""
    log_odds = {"total": odds.total, "terms": dict(odds.terms)}
    return {name: _replace_non_finite(value) for name, value in {**asdict(evidence), "log_odds": log_odds}.items()}


def _measure_flat_patch(camera: CameraEvidence) -> float:
    """0 where a camera's points fill much of its picture, or do not lie on a plane; else how small the plane is."""
    flat = _clip((camera.flat_share - FLAT_FROM) / (FLAT_FULLY - FLAT_FROM), 0.0, 1.0)
    return flat * max(0.0, _clip_log(SMALL / max(camera.coverage, MIN_SHARE), MIN_SHARE, 1.0 / MIN_SHARE))


def _replace_non_finite(value: Any) -> Any:
    """The value of dictionaries, lists and tuples with None for every number that is not finite."""
    if isinstance(value, dict):
        return {key: _replace_non_finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_replace_non_finite(each) for each in value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _clip_log(value: float, least: float, most: float) -> float:
    return math.log(clipped) if math.isfinite(clipped := _clip(value, least, most)) else math.nan


def _clip(value: float, least: float, most: float) -> float:
    """NaN where the value is not finite: clipping must not hide that something could not be computed."""
    return float(np.clip(value, least, most)) if math.isfinite(value) else math.nan
