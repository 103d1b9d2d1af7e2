"""Where up is in a scene, by what an IMU says of gravity in the frames of its cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from splatnode.capture.gravity import Gravity
from splatnode.recon.metric.views import MetricView
from splatnode.recon.result.up import Up

Array = npt.NDArray[np.float64]

_FARTHEST = 3.44  # standard deviations in two dimensions: what one has within 3 in one dimension, 99.7 %
_LEAST_FITTING = 0.6  # of the photographs
_SHARED_DEG = 0.5  # standard deviation of an error that all have alike: how the IMU is mounted
_ROUNDS = 10


def estimate_up(views: Mapping[str, MetricView], gravities: Mapping[str, Gravity]) -> Up | None:
    """Up in the world of the cameras; None where nothing was said, or less than 60 % of it agrees.

    The source names the photographs whose gravity was left out because it does not fit the others.
    """
    names = [name for name in views if name in gravities]
    if not names:
        return None
    ups = np.stack([-views[name].T_world_camera[:3, :3] @ gravities[name].direction for name in names])
    sigmas = np.array([gravities[name].sigma_deg for name in names])
    up = ups[np.argmin([_compute_truncated_cost(ups, sigmas, each) for each in ups])]
    kept = np.zeros(len(names), bool)
    for _ in range(_ROUNDS):
        fits = _compute_angles_deg(ups, up) < _FARTHEST * np.hypot(sigmas, _SHARED_DEG)
        if not fits.any() or (fits == kept).all():
            break
        kept = fits
        mean = (ups[kept] / sigmas[kept, None] ** 2).sum(0)
        up = mean / np.linalg.norm(mean)
    if kept.sum() < math.ceil(_LEAST_FITTING * len(names)):
        return None
    wider = max(
        1.0, float(((_compute_angles_deg(ups[kept], up) / sigmas[kept]) ** 2).sum()) / max(2 * int(kept.sum()) - 2, 1)
    )
    sigma = math.hypot(math.sqrt(wider / float((sigmas[kept] ** -2.0).sum())), _SHARED_DEG)
    x, y, z = up.tolist()
    return Up((x, y, z), sigma, _source(names, kept))


def _source(names: list[str], kept: npt.NDArray[np.bool_]) -> str:
    left_out = [name for name, fits in zip(names, kept, strict=True) if not fits]
    said = f"gravity in {kept.sum()} photographs"
    return f"{said}; that of {', '.join(left_out)} was left out: it does not fit the others" if left_out else said


def _compute_truncated_cost(ups: Array, sigmas: Array, up: Array) -> float:
    return float(np.minimum((_compute_angles_deg(ups, up) / sigmas) ** 2, _FARTHEST**2).sum())


def _compute_angles_deg(ups: Array, up: Array) -> Array:
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(ups, up), axis=1), ups @ up))
