"""What is claimed of verified cameras: 95 % bounds of their errors, from what the evidence says of their size.

A bound is a product of powers (a line between logarithms) of what three sources say (refit.py), and of the share of a
camera's matches that its pose explains: each source sees what another is blind to, none is in the unit of a standard
error, and errors of real cameras grow more slowly than any of them. The number of cameras counts, too: the more there
are, the more each source takes errors for independent that are not. `fitted.py` has the powers, which
`python -m tests.bench fit` finds from registrations of real photographs with known cameras.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from splatnode.recon.result.verdict import Array, Bounds, compute_axes, make_ball
from splatnode.recon.verification.evidence import CameraEvidence, Evidence
from splatnode.recon.verification.refit import Errors

MIN_INLIER_RATIO = 0.05  # a camera with fewer counts as this: a logarithm is taken
# At least so many times what the focal length leaves open within one standard error: two standard errors.
OF_PROFILE = 2.0
# At least so many standard errors of the bundle adjustment, in which each image's lens may differ a little from the
# common one. Of the first 240 sets that break what is assumed of lenses 14 were beyond their claim, and 25 with 1
OF_SIGMA = 2.5
# At least so many times how far the camera would move if each image had a lens of its own. Of 251 published sets that
# break what is assumed of lenses 42 were beyond 2.5 bounds without it
OF_LENSES = 0.6

MAX_LOG_FOCAL = math.log(10.0)  # a factor of ten: who knows the focal length no better knows nothing


@dataclass(frozen=True)
class BoundModel:
    """The powers of one kind of bound, and what is added (in quadrature) to each source before it counts."""

    factor: float
    floor: float
    sigma: float
    regions: float
    profile: float
    inlier_ratio: float
    link: float  # of the share of matches explained across the weakest link: parts may lean against each other
    count: float  # of the number of cameras
    own_lens: float = 1.0  # times, where an image has a lens of its own: which images have one is not certain

    def predict_bound(
        self, errors: Errors, count: int, inlier_ratio: float = 1.0, link: float = 1.0, own_lens: bool = False
    ) -> float:
        """The bound in the unit of `errors`: never less than a source says. NaN and infinity stay what they are."""
        sources = {"sigma": errors.sigma, "regions": errors.regions, "profile": errors.profile}
        product = self.factor * count**self.count * (self.own_lens if own_lens else 1.0)
        product *= max(inlier_ratio, MIN_INLIER_RATIO) ** self.inlier_ratio * max(link, MIN_INLIER_RATIO) ** self.link
        for name, value in sources.items():
            product *= math.hypot(value, self.floor) ** getattr(self, name)
        parts = (
            product,
            OF_SIGMA * errors.sigma,
            errors.regions,
            OF_PROFILE * errors.profile,
            OF_LENSES * errors.lenses,
        )
        return math.nan if any(math.isnan(part) for part in parts) else max(parts)


@dataclass(frozen=True)
class ErrorModel:
    """The models of the bounds. A length counts in the distance to the scene, a focal length in its logarithm."""

    rotation: BoundModel  # degrees
    centre: BoundModel
    focal: BoundModel


def predict_bounds(evidence: Evidence, model: ErrorModel) -> dict[str, Bounds]:
    """The bounds of each camera, by its name, with balls for ellipsoids; the distance to the scene is 1."""
    count, link = len(evidence.cameras), evidence.weakest_link.inlier_ratio
    own, found = any(camera.own_lens for camera in evidence.cameras), {}
    for camera in evidence.cameras:
        focal = model.focal.predict_bound(camera.focal, count, own_lens=own)
        centre = model.centre.predict_bound(camera.errors.centre, count, camera.inlier_ratio, link, own)
        found[camera.name] = Bounds(
            rotation_deg=model.rotation.predict_bound(camera.errors.rotation, count, camera.inlier_ratio, link, own),
            centre=centre,
            centre_percent=100.0 * centre,
            focal_percent=100.0 * math.expm1(min(focal, MAX_LOG_FOCAL)),
            axes=make_ball(centre),
        )
    return found


def shape_bounds(bounds: Mapping[str, Bounds], covariances: Mapping[str, Array]) -> dict[str, Bounds]:
    """The bounds with ellipsoids of the shape of each centre's covariance (3, 3), by the cameras' names."""
    return {name: replace(each, axes=compute_axes(covariances[name], each.centre)) for name, each in bounds.items()}


def compute_travel_percent(bounds: Mapping[str, Bounds], evidence: Evidence) -> float:
    """How far off a centre may be, in percent of how far the camera moved: of the RMS distance from their mean."""
    farthest = max((each.centre for each in bounds.values()), default=math.nan)
    return 100.0 * farthest / evidence.travel if evidence.travel > 0 else math.inf


# What the evidence amounts to: log odds that the poses are right, as a sum of terms (logistic regression).
#
# Wrong are poses whose errors are beyond their bounds. Each term is linear in one measure of
# all cameras together, counted from its value in right registrations; where one camera is worse than the others, the
# worst one counts. A measure is clipped where more of it says nothing more, so that none decides by its extremes.
# `fitted.py` has the slopes, which `python -m tests.bench fit` finds from registrations of real photographs: right
# ones, and wrong ones as they come, or made on purpose (frames that pose as others, mirrored frames, posters, moving
# things, crops).

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


# The models of the verdict, with the numbers that a fitting found for them.


@dataclass(frozen=True)
class VerdictModel:
    claims: ErrorModel
    odds: OddsModel


@dataclass(frozen=True)
class VerdictModels:
    """Two cameras have numbers of their own: no third one sees their points, and no similarity takes out an error."""

    many: VerdictModel
    pair: VerdictModel

    def select_model(self, evidence: Evidence) -> VerdictModel:
        return self.pair if len(evidence.cameras) == 2 else self.many
