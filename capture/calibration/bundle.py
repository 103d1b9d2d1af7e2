"""The lens and all poses of the board that explain the corners best: least squares by Levenberg and Marquardt.

The poses are eliminated from the normal equations (Schur complement), so that a step costs a matrix of the lens's own
size and six numbers a view. Source: Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, section 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.capture.calibration.projection import project_points
from splatnode.capture.calibration.rotations import cross_matrices, rotations

Array = npt.NDArray[np.float64]

_TERM_SIGMA = 3.0  # prior of a term of distortion, about 0: what the corners do not determine stays small
_CORNER_SIGMA_PX = 0.05  # of a corner, against which the prior is weighed
_STEPS = 60
_SMALLEST_GAIN = 1e-9  # of the cost: below, the search ends
_LARGEST_DAMPING = 1e8


@dataclass(frozen=True, eq=False)
class Corners:
    """M corners of V views, those of a view one after the other."""

    pixels: Array  # (M, 2)
    points: Array  # (M, 3) on the board, millimetres
    view: npt.NDArray[np.intp]  # (M,) from 0 to V - 1, each of which occurs

    @property
    def starts(self) -> npt.NDArray[np.intp]:  # (V,)
        return np.flatnonzero(np.diff(self.view, prepend=-1))

    def select_corners(self, kept: npt.NDArray[np.bool_]) -> Corners:
        """Those of `kept` (M,), with their views renumbered."""
        return Corners(self.pixels[kept], self.points[kept], np.unique(self.view[kept], return_inverse=True)[1])


@dataclass(frozen=True, eq=False)
class Solution:
    numbers: Array  # (P,) of the lens
    Ts_camera_board: Array  # (V, 4, 4)
    residuals: Array  # (M, 2) pixels: seen minus expected
    cost: float  # their sum of squares, with the prior's share; infinite where a point cannot be seen
    information: Array  # (P, P) of the lens, the poses being unknown: per squared pixel
    pulls: Array  # (V, P) how each view's residuals pull at the lens; their sum is 0


@dataclass(frozen=True, eq=False)
class _Normal:
    """The normal equations at one place."""

    residuals: Array
    cost: float
    lens: Array  # (P, P)
    mixed: Array  # (V, P, 6)
    pose: Array  # (V, 6, 6)
    lens_pull: Array  # (V, P)
    pose_pull: Array  # (V, 6)
    prior_pull: Array  # (P,)


def solve(corners: Corners, numbers: Array, Ts: Array, kind: str, fixed: bool = False, steps: int = _STEPS) -> Solution:
    """The best lens and poses near a start; with `fixed` the lens stays as it is, and each pose is solved by itself."""
    here, damping = _normal(corners, numbers, Ts, kind), 1e-3
    for _ in range(steps):
        if not np.isfinite(here.cost):
            break
        step, turns = _step(here, damping, fixed)
        moved = numbers + step, _update_poses(Ts, turns)
        there = _normal(corners, *moved, kind)
        if not there.cost < here.cost:
            damping *= 8.0
            if damping > _LARGEST_DAMPING:
                break
            continue
        gained = here.cost - there.cost
        (numbers, Ts), here, damping = moved, there, max(damping / 5.0, 1e-9)
        if gained < _SMALLEST_GAIN * here.cost + 1e-15:
            break
    return Solution(numbers, Ts, here.residuals, here.cost, *_eliminate_poses(here))


def _normal(corners: Corners, numbers: Array, Ts: Array, kind: str) -> _Normal:
    turned = np.einsum("mij,mj->mi", Ts[corners.view, :3, :3], corners.points)
    seen = project_points(turned + Ts[corners.view, :3, 3], numbers, kind)
    residuals = corners.pixels - seen.pixels
    by_pose = np.concatenate([-seen.by_point @ cross_matrices(turned), seen.by_point], axis=-1)  # (M, 2, 6)
    starts = corners.starts
    lens = np.einsum("mip,miq->pq", seen.by_lens, seen.by_lens)
    prior = np.concatenate([np.zeros(4), np.full(len(numbers) - 4, (_CORNER_SIGMA_PX / _TERM_SIGMA) ** 2)])
    mixed = np.add.reduceat(np.einsum("mip,miq->mpq", seen.by_lens, by_pose), starts)
    pose = np.add.reduceat(np.einsum("mip,miq->mpq", by_pose, by_pose), starts)
    lens_pull = np.add.reduceat(np.einsum("mip,mi->mp", seen.by_lens, residuals), starts)
    pose_pull = np.add.reduceat(np.einsum("mip,mi->mp", by_pose, residuals), starts)
    cost = float((residuals**2).sum() + prior @ numbers**2)
    good = np.isfinite(cost) and min(numbers[:2]) > 0
    return _Normal(
        residuals,
        cost if good else np.inf,
        lens + np.diag(prior),
        mixed,
        pose,
        lens_pull,
        pose_pull,
        -prior * numbers,
    )


def _step(here: _Normal, damping: float, fixed: bool) -> tuple[Array, Array]:
    """How to change the lens (P,) and the poses (V, 6)."""
    pose = here.pose * (1 + damping * np.eye(6)) + 1e-12 * np.eye(6)
    if fixed:
        alone = np.linalg.solve(pose, here.pose_pull[..., None])[..., 0]
        return np.zeros(len(here.lens)), np.asarray(alone, np.float64)
    lens = here.lens * (1 + damping * np.eye(len(here.lens)))
    solved = np.linalg.solve(pose, np.concatenate([here.mixed.transpose(0, 2, 1), here.pose_pull[..., None]], axis=-1))
    reduced = lens - np.einsum("vpi,viq->pq", here.mixed, solved[..., :-1])
    pull = here.lens_pull.sum(axis=0) + here.prior_pull - np.einsum("vpi,vi->p", here.mixed, solved[..., -1])
    scale = 1 / np.sqrt(np.diag(lens))  # the numbers are of many sizes
    found, *_ = np.linalg.lstsq(reduced * np.outer(scale, scale), pull * scale, rcond=1e-14)
    step = np.asarray(scale * found, np.float64)
    return step, np.asarray(solved[..., -1] - solved[..., :-1] @ step, np.float64)


def _eliminate_poses(here: _Normal) -> tuple[Array, Array]:
    """Eliminates the poses: returns the lens's information, and the right-hand side, of the reduced system."""
    if not np.isfinite(here.cost):
        return np.zeros_like(here.lens), np.zeros_like(here.lens_pull)
    pose = here.pose + 1e-9 * np.eye(6)
    solved = np.linalg.solve(pose, np.concatenate([here.mixed.transpose(0, 2, 1), here.pose_pull[..., None]], axis=-1))
    information = here.lens - np.einsum("vpi,viq->pq", here.mixed, solved[..., :-1])
    return information, here.lens_pull - np.einsum("vpi,vi->vp", here.mixed, solved[..., -1])


def _update_poses(Ts: Array, turns: Array) -> Array:
    """Poses (V, 4, 4), turned by the first and shifted by the last three of `turns` (V, 6), in the camera's frame."""
    moved = Ts.copy()
    moved[:, :3, :3] = rotations(turns[:, :3]) @ Ts[:, :3, :3]
    moved[:, :3, 3] += turns[:, 3:]
    return moved
