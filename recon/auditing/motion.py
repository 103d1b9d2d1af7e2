"""How a camera moved between two photographs, by the landmarks that both show.

Each photograph by itself is placed as well as the landmarks are known. What is wrong with a landmark moves it alike in
both pictures, so that the difference tells of a move far smaller than that: here the shift in the picture, of each
landmark that both show, is explained by a turn and a shift of the camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.recon.geometry import angles_deg
from splatnode.recon.locating.camera_model import POSE
from splatnode.recon.locating.locate import Localization
from splatnode.recon.locating.refinement import optimize_camera, pose_covariance
from splatnode.recon.registration.cross_product import cross_matrix

Array = npt.NDArray[np.float64]

# Chi-squared with 6 degrees of freedom that chance exceeds once in a million: the move is no chance beyond it.
UNLIKELY = 38.26
MIN_COMMON = 30  # landmarks that both photographs must show; with fewer, what is known of each by itself decides
_LEAST_NOISE = 2.5e-4  # of the longer side: no shift of a feature is known better than an eighth of 512 pixels' one


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """The motion of a camera between two images, in the frame of the first: x right, y down, z forward."""

    T_before_after: Array  # (4, 4): p_before = T_before_after @ p_after
    covariance: Array  # (6, 6) of a small motion in that frame: shift (result's unit), then turn (radians)
    common: int  # landmarks that both show and that it was measured by; 0: each photograph was placed by itself

    @property
    def degrees(self) -> float:
        """The angle of the rotation."""
        return float(angles_deg(self.T_before_after[None, :3, :3], np.eye(3)[None])[0])

    @property
    def distance(self) -> float:
        """The length of the shift, in the result's unit."""
        return float(np.linalg.norm(self.T_before_after[:3, 3]))

    @property
    def degrees_sigma(self) -> float:
        """The standard deviation of the turn along the axis about which it is known worst."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1])))

    @property
    def distance_sigma(self) -> float:
        """The standard deviation of the shift in the direction in which it is known worst."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    def format_motion(self, unit: float, metric: bool) -> str:
        """How far, with two standard deviations: in centimetres if the result is `metric`, else over its `unit`."""
        turn = f"{self.degrees:.2g} degrees (± {2 * self.degrees_sigma:.1g})"
        distance, sigma = self.distance, 2 * self.distance_sigma
        if metric:
            return f"{turn} and {100 * distance:.2g} cm (± {100 * sigma:.1g})"
        return f"{turn} and {100 * distance / unit:.2g} % of the distance (± {100 * sigma / unit:.1g})"

    @property
    def is_significant(self) -> bool:
        """Whether the motion exceeds chance."""
        step = twist(self.T_before_after)
        return float(step @ np.linalg.solve(self.covariance, step)) > UNLIKELY

    @property
    def least_turn_deg(self) -> float:
        """The smallest turn alone that would be significant, about the axis about which the least is known."""
        information = np.linalg.inv(self.covariance)[3:, 3:]
        return float(np.degrees(np.sqrt(UNLIKELY / np.linalg.eigvalsh(information)[0])))

    @property
    def least_shift(self) -> float:
        """The smallest shift alone that would be significant, in the direction in which the least is known."""
        information = np.linalg.inv(self.covariance)[:3, :3]
        return float(np.sqrt(UNLIKELY / np.linalg.eigvalsh(information)[0]))


def measure_motion(before: Localization, after: Localization) -> MeasuredMotion:
    """How the camera of the photograph `before` moved until `after`; both are of one camera.

    Where it has another lens since, as once it zoomed, what each photograph says by itself is compared.
    """
    own, other = _find_common(before, after)
    T = np.linalg.inv(before.camera.T_world_camera) @ after.camera.T_world_camera
    apart = before.located.covariance + _rotate_covariance(after.located.covariance, T)
    if len(own) >= MIN_COMMON and before.size == after.size and _has_same_lens(before, after):
        measured = _fit_motion(before, own, after.seen.pixels[other] - before.seen.pixels[own])
        if measured is not None:
            depth = float(np.median(before.camera.project(before.seen.points[own])[1]))
            otherwise = _compute_unshared_error(measured, min(depth, before.spread))
            return replace(measured, covariance=measured.covariance + otherwise**2 * apart)
    return MeasuredMotion(T, apart, 0)


def _has_same_lens(before: Localization, after: Localization) -> bool:
    """Whether the focal lengths differ by no more than their bounds allow."""
    first, second = (np.diag(each.located.K)[:2] for each in (before, after))
    bounds = [math.log1p(each.located.claim.focal_percent / 100.0) for each in (before, after)]
    return bool(np.abs(np.log(second / first)).max() <= math.hypot(*bounds))


def _compute_unshared_error(motion: MeasuredMotion, reach: float) -> float:
    """The share of what is wrong with the scene that is not the same for both cameras, in [0, 1].

    A scene that is bent turns its cameras against each other, those that are farther apart by more: it is all for two
    that are `reach` apart, which is how far the scene's cameras stand from each other, or from the scene, if that is
    less. It grows with the angle between the directions in which the two look, too.
    """
    if motion.distance >= reach:
        return 1.0
    return min(1.0, motion.distance / reach + np.radians(motion.degrees))


def _find_common(before: Localization, after: Localization) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The places of the landmarks that both show, among those that each shows."""
    _, own, other = np.intersect1d(before.seen.landmark_of, after.seen.landmark_of, return_indices=True)
    return own, other


def _fit_motion(before: Localization, own: npt.NDArray[np.int64], shifts: Array) -> MeasuredMotion | None:
    """The motion that explains the `shifts` (M, 2) of the landmarks in the picture; None where they do not tell it.

    The landmarks, and the lens, count as exact: what is wrong with them is so in both photographs.
    """
    start, seen = before.camera, before.seen.select(own)
    pixels = start.project(seen.points)[0] + shifts
    exact = replace(seen, pixels=pixels, covariances=np.zeros_like(seen.covariances))
    lens = replace(start.lens, log_focal_sigma=0.0, radial_sigma=0.0, shift_sigma=0.0, log_aspect_sigma=0.0)
    fit = optimize_camera(start, lens, exact, _LEAST_NOISE * max(before.size))
    if not np.isfinite(fit.covariance).all():
        return None
    T = np.linalg.inv(start.T_world_camera) @ fit.camera.T_world_camera
    return MeasuredMotion(T, _rotate_covariance(pose_covariance(fit.camera, fit.covariance), T), len(own))


def adjoint(T: Array) -> Array:
    """(6, 6) what makes of a small motion, shift then turn, the same in the frame that T (4, 4) leads to."""
    result = np.zeros((POSE, POSE))
    result[:3, :3] = result[3:, 3:] = T[:3, :3]
    result[:3, 3:] = cross_matrix(T[None, :3, 3])[0] @ T[:3, :3]
    return result


def twist(T: Array) -> Array:
    """(6,) the shift and the rotation vector of a motion (4, 4)."""
    return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()])


def _rotate_covariance(covariance: Array, T_before_after: Array) -> Array:
    """The covariance (6, 6) of a small motion in the frame of the second photograph, along the axes of the first."""
    turn = np.kron(np.eye(2), T_before_after[:3, :3])
    return turn @ covariance @ turn.T
