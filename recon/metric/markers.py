"""The unit by printed markers of known size: a square that several cameras see is so large in the scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from splatnode.capture.process.lengths import format_length
from splatnode.recon.frames.keyframe import REFERENCE_SIDE
from splatnode.recon.metric.marker_detection import MarkerDetection
from splatnode.recon.metric.measurement import Measurement, combine_measurements
from splatnode.recon.metric.views import MetricView, compute_scale_sigma
from splatnode.recon.registration.triangulation import largest_angles, triangulate

Array = npt.NDArray[np.float64]

_SQUARE = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])  # as corners are named
_LEAST_PARALLAX_DEG = 1.0  # between the cameras, seen from the marker
_CAMERA_PX = 0.3  # standard deviation, at REFERENCE_SIDE, of where a registered camera sees a known point
_MOST_PX = 4.0  # of the corners' error at REFERENCE_SIDE: beyond, the marker was moved, or is another one


@dataclass(frozen=True, eq=False)
class _MarkerView:
    """A marker in the photograph of a camera."""

    view: MetricView
    rays: Array  # (4, 2) at depth 1
    whitening: Array  # (8, 8): times the rays' error, independent errors of standard deviation 1
    px: float  # of the reference size, in rays


def estimate_scale_from_markers(
    views: Mapping[str, MetricView], sightings: Sequence[MarkerDetection], side_m: float, sigma_m: float
) -> list[Measurement | str]:
    """The unit by all markers together, and a sentence for each that says nothing.

    `side_m` is the side of the black square and `sigma_m` its standard deviation, metres: all markers have both alike.
    Where two markers contradict each other, each is a measurement of its own, as sure as it is but for the side: an
    error that all of them share cannot explain what they differ by. Raises ValueError for a side of 0.
    """
    if side_m <= 0:
        raise ValueError(f"the side of a marker must be above 0, got {side_m}")
    if not sightings:
        return [f"no marker of {format_length(side_m)} was found in the photographs"]
    numbers = sorted({each.marker for each in sightings})
    told = [
        _estimate_scale_from_marker(number, views, [each for each in sightings if each.marker == number], side_m)
        for number in numbers
    ]
    single = [each for each in told if isinstance(each, Measurement)]
    silent = [each for each in told if isinstance(each, str)]
    agreed = combine_measurements(single) if single else ""
    if not isinstance(agreed, Measurement):
        return [*single, *silent]
    return [replace(agreed, sigma=math.hypot(agreed.sigma, sigma_m / side_m)), *silent]


def _estimate_scale_from_marker(
    number: int, views: Mapping[str, MetricView], sightings: Sequence[MarkerDetection], side_m: float
) -> Measurement | str:
    seen = [_make_marker_view(views[each.photograph], each) for each in sightings if each.photograph in views]
    name = f"marker {number} of {format_length(side_m)}"
    if not seen:
        return f"{name} is in no photograph that has a camera in the scene"
    if len(seen) == 1:
        where = next(each.photograph for each in sightings if each.photograph in views)
        return f"{name} is in one photograph of the scene alone, {where}; two are needed"
    found = _fit_square(seen)
    if found is None:
        return f"{name} is in {len(seen)} photographs, from one and the same side; step to the side between them"
    side, sigma, error_px = found
    if error_px > _MOST_PX:
        return f"{name} does not lie still, or there are two of it: its corners are off by {error_px:.1f} pixels"
    source = f"{name} in {len(seen)} photographs"
    return Measurement(side_m / side, math.hypot(sigma, compute_scale_sigma([each.view for each in seen])), source)


def _make_marker_view(view: MetricView, sighting: MarkerDetection) -> _MarkerView:
    """Makes the view of a marker; its corners have errors of their own, and share the camera's error."""
    pixels, size = sighting.corners.pixels, (sighting.width, sighting.height)
    px = max(size) / REFERENCE_SIDE
    alike = np.kron(np.ones((4, 4)), np.eye(2))
    per_ray = 1.0 / (view.focal * max(size))  # rays a pixel; what the lens bends of it is no matter
    covariance = (sighting.corners.covariance + (_CAMERA_PX * px) ** 2 * alike) * per_ray**2
    whitening = np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), np.float64)
    return _MarkerView(view, view.unproject(pixels, *size), whitening, px * per_ray)


def _fit_square(seen: Sequence[_MarkerView]) -> tuple[float, float, float] | None:
    """Side in the scene's unit, standard deviation of its logarithm, and the corners' rms error in reference pixels.

    The pose and the side of a square whose corners are seen where they are. None without parallax.
    """
    count = len(seen)
    matrices = np.asarray([np.linalg.inv(each.view.T_world_camera)[:3] for each in seen], np.float64)
    cameras, rays = np.repeat(np.arange(count), 4), np.concatenate([each.rays for each in seen])
    corners = triangulate(matrices, rays, cameras, np.tile(np.arange(4), count), 4)
    middle = corners.mean(0)
    centres = np.stack([each.view.centre for each in seen])
    if not np.isfinite(corners).all() or _parallax_deg(middle, centres) < _LEAST_PARALLAX_DEG:
        return None
    side = float(np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).mean())
    u, _, vt = np.linalg.svd((corners - middle).T @ _SQUARE)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    unit = float(np.median([np.linalg.norm(middle - each.view.centre) for each in seen]))

    def errors(values: Array) -> Array:
        square = _move_square(values, turn, middle, side, unit)
        return np.concatenate([each.whitening @ _compute_ray_errors(each, square) for each in seen])

    found = least_squares(errors, np.zeros(7), method="lm", x_scale=np.full(7, 0.01))
    square = _move_square(found.x, turn, middle, side, unit)
    per_px = np.concatenate([_compute_ray_errors(each, square) / each.px for each in seen])
    covariance = np.linalg.pinv(found.jac.T @ found.jac)
    freedom = 8 * len(seen) - 7
    wider = max(1.0, math.sqrt(2.0 * found.cost / freedom))  # where the errors are larger than they should be
    return side * math.exp(found.x[6]), wider * math.sqrt(covariance[6, 6]), float(np.sqrt((per_px**2).mean() * 2.0))


def _move_square(values: Array, turn: Array, middle: Array, side: float, unit: float) -> Array:
    """(4, 3) corners of the square after a small turn (3), a move (3) in `unit`, and a change of its log side."""
    rotation = Rotation.from_rotvec(values[:3]).as_matrix() @ turn
    return side * math.exp(values[6]) * _SQUARE @ rotation.T + middle + unit * values[3:6]


def _compute_ray_errors(seen: _MarkerView, corners: Array) -> Array:
    """(8,) rays at which the corners (4, 3) are seen, less those at which they should be."""
    in_camera = (corners - seen.view.centre) @ seen.view.T_world_camera[:3, :3]
    depth = np.where(np.abs(in_camera[:, 2:]) < 1e-9, 1e-9, in_camera[:, 2:])
    return (in_camera[:, :2] / depth - seen.rays).ravel()


def _parallax_deg(point: Array, centres: Array) -> float:
    """The largest angle between two of the cameras at `centres` (C, 3), seen from the point."""
    cameras = np.arange(len(centres))
    return float(largest_angles(centres, point[None], cameras, np.zeros_like(cameras))[0])
