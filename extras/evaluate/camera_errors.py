"""Estimated cameras against true ones, whose worlds differ by a similarity."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import align_cameras, angles_deg, compute_rms_radius, umeyama

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CameraErrors:
    """Errors of C estimated cameras. None where C, or the true motion, is too small to tell.

    `rotation_deg` is the largest angle of any camera once both sets share the best common rotation;
    `rotation_pair_deg` the largest error of any relative rotation, which needs no alignment. `centre_pct` is the RMS
    distance of the centres after Umeyama's similarity, in percent of the true centres' RMS distance from their mean.
    With C = 3 that similarity has 7 degrees of freedom against 9 numbers: read it with the rotations. `focal_pct` is
    the mean absolute relative error of the focal length.
    """

    rotation_deg: float | None
    rotation_pair_deg: float | None
    centre_pct: float | None
    focal_pct: float | None
    ate_instantsplat: float | None


def compare_cameras(Ts_estimated: Array, Ts_true: Array, Ks_estimated: Array, Ks_true: Array) -> CameraErrors:
    """Compares (C, 4, 4) T_world_camera and (C, 3, 3) K, in the same order and for the same image sizes."""
    if Ts_estimated.shape != Ts_true.shape or Ks_estimated.shape != Ks_true.shape:
        raise ValueError(
            f"cameras must come in pairs, got {Ts_estimated.shape} and {Ts_true.shape}, "
            f"{Ks_estimated.shape} and {Ks_true.shape}"
        )
    if len(Ts_true) == 0:
        return CameraErrors(None, None, None, None, None)
    focal = 100.0 * float(np.abs(_compute_focal(Ks_estimated) / _compute_focal(Ks_true) - 1.0).mean())
    if len(Ts_true) < 2:
        return CameraErrors(None, None, None, focal, None)
    rotations_estimated, rotations_true = Ts_estimated[:, :3, :3], Ts_true[:, :3, :3]
    common = align_cameras(Ts_estimated, Ts_true).rotation
    first, second = np.triu_indices(len(Ts_true), 1)
    return CameraErrors(
        rotation_deg=float(angles_deg(common @ rotations_estimated, rotations_true).max()),
        rotation_pair_deg=float(
            angles_deg(
                rotations_estimated[first].transpose(0, 2, 1) @ rotations_estimated[second],
                rotations_true[first].transpose(0, 2, 1) @ rotations_true[second],
            ).max()
        ),
        centre_pct=compute_centre_error_pct(Ts_estimated[:, :3, 3], Ts_true[:, :3, 3]),
        focal_pct=focal,
        ate_instantsplat=compute_ate_instantsplat(Ts_estimated, Ts_true),
    )


def compute_centre_error_pct(estimated: Array, true: Array) -> float | None:
    """RMS distance of centres (C, 3) after Umeyama's similarity, in percent of the true ones' RMS spread.

    None where the true camera does not move.
    """
    apart = compute_rms_radius(true)
    if apart <= 1e-9 * (1.0 + float(np.abs(true).max())):
        return None
    return 100.0 * _compute_rms_after_umeyama(estimated, true) / apart


def compute_ate_instantsplat(Ts_estimated: Array, Ts_true: Array) -> float | None:
    """The "ATE" of InstantSplat's released evaluation, only for comparison with published figures.

    It aligns the translation columns t = -R C of the world-to-camera matrices, each set centred and divided by its
    Frobenius norm. They do not transform by a similarity when the world moves, so a perfect reconstruction does not
    score 0 (0.008 to 0.02 on typical arcs), and the norm makes the figure shrink with the number of cameras. None where
    either set does not move.
    """
    columns = []
    for Ts in (Ts_estimated, Ts_true):
        t = np.linalg.inv(Ts)[:, :3, 3]
        centred = t - t.mean(0)
        norm = float(np.linalg.norm(centred))
        if norm <= 1e-9 * (1.0 + float(np.abs(t).max())):
            return None
        columns.append(centred / norm)
    return _compute_rms_after_umeyama(*columns)


def _compute_rms_after_umeyama(source: Array, target: Array) -> float:
    moved = umeyama(source, target)(source)
    return math.sqrt(float(((moved - target) ** 2).sum(1).mean()))


def _compute_focal(Ks: Array) -> Array:
    return np.sqrt(Ks[:, 0, 0] * Ks[:, 1, 1])
