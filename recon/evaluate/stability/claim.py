"""How wrong each camera is, and whether that is within what was claimed of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.evaluate.camera_errors import CameraErrors, compare_cameras
from splatnode.recon.evaluate.truth import TrueCamera
from splatnode.recon.geometry import Similarity, align_cameras, angles_deg, compute_rms_radius, umeyama
from splatnode.recon.result.bounds import Bounds
from splatnode.recon.result.snapshot import CameraEstimate

Array = npt.NDArray[np.float64]

RIGHT_ROTATION_DEG, RIGHT_SPREAD_PCT = 2.0, 5.0
BOUNDS_WIDENED = 2.5  # times a 95 % bound: beyond, the claim was false
GROSS_ROTATION_DEG, GROSS_CENTRE_PCT = 5.0, 10.0
ROUGH = "OK_ROUGH"  # the verdict that says that the cameras are known roughly
_HUGE = 1e9  # stands for what is not finite: JSON has no infinity
_ROUNDING = 1e-6  # degrees and percent: cameras that are given exactly are found with this error


@dataclass(frozen=True)
class FiniteBounds:
    """The 95 % bounds of a camera, as recon/result/bounds.py has them; what is not finite is very large."""

    rotation_deg: float
    centre_percent: float  # of the distance to the scene
    focal_percent: float


def make_finite_bounds(bounds: Bounds) -> FiniteBounds:
    values = bounds.rotation_deg, bounds.centre_percent, bounds.focal_percent
    return FiniteBounds(*(value if math.isfinite(value) else _HUGE for value in values))


@dataclass(frozen=True)
class CameraError:
    """The errors of one camera after alignment. Centres are None where no true camera moves."""

    name: str
    rotation_deg: float  # after the best common rotation
    centre_pct: float | None  # of the distance to the scene, which is the unit of the estimated world
    spread_pct: float | None  # of the true centres' RMS distance from their mean
    focal_pct: float
    bounds: FiniteBounds | None = None  # what was claimed; None: nothing

    @property
    def right(self) -> bool:
        return (
            self.rotation_deg < RIGHT_ROTATION_DEG
            and self.spread_pct is not None
            and self.spread_pct < RIGHT_SPREAD_PCT
        )

    @property
    def is_far(self) -> bool:
        """Beyond 5 degrees or 10 % of the distance."""
        return self.rotation_deg > GROSS_ROTATION_DEG or (self.centre_pct or 0.0) > GROSS_CENTRE_PCT

    def is_wrong(self, rough: bool) -> bool:
        """Beyond 2.5 times a bound; or beyond 5 degrees or 10 % of the distance without a word that it is rough.

        A camera of which nothing was claimed is wrong beyond 5 degrees or 10 % of the centres' spread.
        """
        if self.centre_pct is None or self.spread_pct is None:
            return True
        if self.bounds is None:
            return self.rotation_deg > GROSS_ROTATION_DEG or self.spread_pct > GROSS_CENTRE_PCT
        if not rough and self.is_far:
            return True
        return any(error > BOUNDS_WIDENED * bound + _ROUNDING for error, bound in self.pair_with_bounds().values())

    def pair_with_bounds(self) -> dict[str, tuple[float, float]]:
        """Error and 95 % bound of the rotation (degrees), the centre and the focal length (%), where claimed."""
        if self.bounds is None or self.centre_pct is None:
            return {}
        return {
            "rotation": (self.rotation_deg, self.bounds.rotation_deg),
            "centre": (self.centre_pct, self.bounds.centre_percent),
            "focal": (self.focal_pct, self.bounds.focal_percent),
        }


def has_only_right_cameras(errors: Sequence[CameraError]) -> bool:
    """Whether there are at least two cameras, and each is within 2 degrees and 5 % of the centres' spread."""
    return len(errors) >= 2 and all(error.right for error in errors)


def measure_camera_errors(
    cameras: Sequence[CameraEstimate], truth: Mapping[str, TrueCamera]
) -> tuple[CameraError, ...]:
    """The errors of cameras that all have a true one; none for fewer than two, which nothing can be aligned by.

    Rotations are compared after the best common rotation, centres after Umeyama's similarity. Of two cameras the
    centres always fit that, so they are compared after the similarity that turns the cameras onto each other. Where
    one camera is not finite, nothing can be aligned, and all errors are as large as can be.
    """
    if len(cameras) < 2:
        return ()
    if not _is_finite(cameras):
        return tuple(CameraError(camera.name, 180.0, _HUGE, _HUGE, _HUGE) for camera in cameras)
    true = [truth[camera.name] for camera in cameras]
    Ts = np.stack([camera.T_world_camera for camera in cameras])
    Ts_true = np.stack([camera.T_world_camera for camera in true])
    turned = align_cameras(Ts, Ts_true)
    rotations = angles_deg(turned.rotation @ Ts[:, :3, :3], Ts_true[:, :3, :3])
    apart = compute_rms_radius(Ts_true[:, :3, 3])
    moves = apart > 1e-9 * (1.0 + float(np.abs(Ts_true[:, :3, 3]).max()))
    common = turned if len(cameras) == 2 or not moves else umeyama(Ts[:, :3, 3], Ts_true[:, :3, 3])
    distances = np.linalg.norm(common(Ts[:, :3, 3]) - Ts_true[:, :3, 3], axis=1)
    return tuple(
        CameraError(
            name=camera.name,
            rotation_deg=float(rotation),
            centre_pct=_compute_percent_of_distance(float(distance), common) if moves else None,
            spread_pct=100.0 * float(distance) / apart if moves else None,
            focal_pct=_compute_focal_pct(camera, one),
            bounds=None if camera.bounds is None else make_finite_bounds(camera.bounds),
        )
        for camera, one, rotation, distance in zip(cameras, true, rotations, distances, strict=True)
    )


def measure_set_errors(cameras: Sequence[CameraEstimate], truth: Mapping[str, TrueCamera]) -> CameraErrors:
    """The errors of all cameras together, each of which has a true one; None each where a camera is not finite."""
    if not _is_finite(cameras):
        return CameraErrors(None, None, None, None, None)
    true = [truth[camera.name] for camera in cameras]
    Ks = [each.K_for(camera.width, camera.height) for each, camera in zip(true, cameras, strict=True)]
    return compare_cameras(
        np.array([camera.T_world_camera for camera in cameras]).reshape(-1, 4, 4),
        np.array([each.T_world_camera for each in true]).reshape(-1, 4, 4),
        np.array([camera.K_photographed for camera in cameras]).reshape(-1, 3, 3),
        np.array(Ks).reshape(-1, 3, 3),
    )


def _is_finite(cameras: Sequence[CameraEstimate]) -> bool:
    return all(np.isfinite(camera.T_world_camera).all() and np.isfinite(camera.K).all() for camera in cameras)


def _compute_percent_of_distance(distance: float, similarity: Similarity) -> float:
    """A distance in the true world, in percent of the unit of the estimated one."""
    return min(100.0 * distance / similarity.scale, _HUGE) if similarity.scale > 0 else _HUGE


def _compute_focal_pct(camera: CameraEstimate, true: TrueCamera) -> float:
    K, K_true = camera.K_photographed, true.K_for(camera.width, camera.height)
    return 100.0 * abs(math.sqrt(K[0, 0] * K[1, 1] / (K_true[0, 0] * K_true[1, 1])) - 1.0)
