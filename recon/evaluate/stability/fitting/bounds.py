"""The models of the 95 % bounds: a line between the logarithms of what the sources say and of the errors found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import lsq_linear

from splatnode.recon.evaluate.stability.fitting.samples import Sample
from splatnode.recon.verification.claims import MIN_INLIER_RATIO, BoundModel, ErrorModel
from splatnode.recon.verification.errors import Errors

Array = npt.NDArray[np.float64]

# Of the errors that are fitted: more than the 95 % that are claimed, so that bounds hold scene by scene, on others, too
QUANTILE = 0.96
RIDGE = 1e-3  # penalty of squared powers, for each camera: where two sources say the same, both count alike
MIN_OWN_LENSES = 50  # cameras of sets with own lenses, from which on they have a factor of their own
# Largest such factor: with more, all of these sets would be called rough for the few in which one more lens went unseen
MAX_OWN_LENS = 4.0
NEGLIGIBLE = 1e-6  # a smaller power is 0
# Errors are not told from these: true cameras are no better known. Degrees, of the distance, of log focal.
FLOORS = {"rotation": 0.1, "centre": 2e-4, "focal": 2e-3}


@dataclass(frozen=True)
class _ErrorSample:
    """One camera's error and what was said of it."""

    scene: str
    error: float
    errors: Errors
    inlier_ratio: float
    link: float
    count: int
    own_lens: bool  # of any camera of its set
    broken: bool  # what its set takes for granted of lenses, on purpose


def fit(samples: Sequence[Sample]) -> ErrorModel:
    """From registrations that are not grossly wrong, each scene with the square root of its number of cameras.

    Sets that break what is assumed of lenses say how much wider bounds are where an image has a lens of its own, and
    nothing else: where nothing tells that they do, they look like any other.
    """
    usable = [sample for sample in samples if not sample.is_gross and (sample.own_lens or not sample.broken)]
    return ErrorModel(
        rotation=_fit_bound_model(_collect_samples(usable, "rotation"), FLOORS["rotation"]),
        centre=_fit_bound_model(_collect_samples(usable, "centre"), FLOORS["centre"], link=True),
        focal=_fit_bound_model(_collect_samples(usable, "focal"), FLOORS["focal"], profile=True),
    )


def _collect_samples(samples: Sequence[Sample], kind: str) -> list[_ErrorSample]:
    lines = []
    for sample in samples:
        count, link = len(sample.evidence.cameras), sample.evidence.weakest_link.inlier_ratio
        of_set = link, count, sample.own_lens, sample.broken
        for camera in sample.evidence.cameras:
            found = sample.errors[camera.name]
            if kind == "rotation":
                sizes = found.rotation_deg, camera.errors.rotation
                lines.append(_ErrorSample(sample.scene, *sizes, camera.inlier_ratio, *of_set))
            elif kind == "centre":
                centre = (found.centre_pct or 0.0) / 100.0
                lines.append(_ErrorSample(sample.scene, centre, camera.errors.centre, camera.inlier_ratio, *of_set))
            else:
                focal = float(np.abs(np.log1p(max(found.focal_pct, -99.0) / 100.0)))
                lines.append(_ErrorSample(sample.scene, focal, camera.focal, 1.0, 1.0, *of_set[1:]))
    return lines


def _fit_bound_model(
    lines: Sequence[_ErrorSample], floor: float, profile: bool = False, link: bool = False
) -> BoundModel:
    """The powers, then the quantile of what is left.

    More of a source never narrows a bound, and more explained matches never widen it. The profile counts if `profile`
    (it bounds rotations and centres from below as it is), the weakest link if `link`.
    """
    whole = lines
    lines = [line for line in whole if not line.broken]
    scenes = np.array([line.scene for line in lines])
    weights = np.array([1.0 / np.sqrt((scenes == scene).sum()) for scene in scenes])
    wanted = np.log(np.hypot([line.error for line in lines], floor / 3.0))
    varies = len({line.count for line in lines}) > 1
    used = {"sigma": True, "regions": True, "profile": profile, "inlier_ratio": True, "link": link, "count": varies}
    columns = np.array([_compute_logarithms(line, floor) for line in lines])
    columns = columns * np.array([float(each) for each in used.values()])
    design = np.column_stack([np.ones(len(lines)), columns])
    least = np.array([-np.inf, 0.0, 0.0, 0.0, -np.inf, -np.inf, -np.inf])
    most = np.array([np.inf, np.inf, np.inf, np.inf, 0.0, 0.0, np.inf])
    root = np.sqrt(weights)
    ridge = np.sqrt(RIDGE * weights.sum()) * np.eye(design.shape[1])
    ridge[0] = 0.0  # of the powers, not of the factor
    powers = lsq_linear(
        np.vstack([design * root[:, None], ridge]), np.concatenate([wanted * root, np.zeros(len(ridge))]), (least, most)
    ).x
    powers[1:][~np.array(list(used.values()))] = 0.0
    powers = np.where(np.abs(powers) < NEGLIGIBLE, 0.0, powers)
    left, own = wanted - design @ powers, np.array([line.own_lens for line in lines])
    of_common = _quantile(left[~own], weights[~own], QUANTILE)
    found = dict(zip(used, powers[1:], strict=True))
    found |= {"factor": np.exp(powers[0] + of_common), "floor": floor}
    mixed = [line for line in whole if line.own_lens]
    if len(mixed) >= MIN_OWN_LENSES:
        columns = np.array([_compute_logarithms(line, floor) for line in mixed]) * np.array(
            [float(each) for each in used.values()]
        )
        errors = np.log(np.hypot([line.error for line in mixed], floor / 3.0))
        beyond = errors - np.column_stack([np.ones(len(mixed)), columns]) @ powers
        wider = np.exp(_quantile(beyond, np.ones(len(mixed)), QUANTILE) - of_common)
        found["own_lens"] = float(np.clip(wider, 1.0, MAX_OWN_LENS))
    return BoundModel(**{name: float(f"{number:.3g}") for name, number in found.items()})


def _compute_logarithms(line: _ErrorSample, floor: float) -> list[float]:
    sources = (line.errors.sigma, line.errors.regions, line.errors.profile)
    shares = (_log_share(line.inlier_ratio), _log_share(line.link))
    return [*(float(np.log(np.hypot(each, floor))) for each in sources), *shares, float(np.log(line.count))]


def _log_share(inlier_ratio: float) -> float:
    return float(np.log(max(inlier_ratio, MIN_INLIER_RATIO)))


def _quantile(values: Array, weights: Array, share: float) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order]) / weights.sum()
    return float(values[order][min(int(np.searchsorted(below, share)), len(values) - 1)])
