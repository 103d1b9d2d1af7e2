"""The lens of one model from views of the board, with what is known of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.capture.calibration.board import Board
from splatnode.capture.calibration.bundle import Corners, Solution, solve
from splatnode.capture.calibration.corners import LEAST_CORNERS, BoardView
from splatnode.capture.calibration.models import Model
from splatnode.capture.calibration.poses import board_pose
from splatnode.capture.frame import Intrinsics
from splatnode.capture.lenses import lens as lenses

Array = npt.NDArray[np.float64]

_FIELDS_DEG = {"opencv": (25.0, 45.0, 65.0, 85.0, 110.0), "fisheye": (50.0, 80.0, 110.0, 140.0, 170.0, 200.0)}
_FIRST_STEPS = 12  # of each start; the best goes on
_OUTLIER = 4.5  # robust standard deviations: corners that are farther off were not seen right
_LEAST_SIGMA_PX = 0.02  # what a corner is never better than, so that a perfect fit throws nothing away


@dataclass(frozen=True, eq=False)
class Estimate:
    model: Model
    lens: Intrinsics
    corners: Corners
    solution: Solution
    names: tuple[str, ...]  # (V,) of the views
    left_out: int  # corners that were not seen right
    covariance: Array  # (P, P) of the lens's numbers

    @property
    def rms_px(self) -> float:
        """Returns the root mean square of the distance between a corner and its projection."""
        return float(np.sqrt((self.solution.residuals**2).sum(axis=1).mean()))

    @property
    def focal_sigma(self) -> float:
        """Standard deviation of the focal length, relative, of the axis that is known less."""
        return float(max(np.sqrt(np.diag(self.covariance)[:2]) / (self.lens.fx, self.lens.fy)))

    @property
    def tilts_deg(self) -> Array:  # (V,)
        """How far the board was from parallel to the picture in each view."""
        return np.degrees(np.arccos(np.clip(np.abs(self.solution.Ts_camera_board[:, 2, 2]), 0.0, 1.0)))

    @property
    def distances_mm(self) -> Array:  # (V,)
        """From the camera to the corners' middle."""
        starts = self.corners.starts
        middle = np.add.reduceat(self.corners.points, starts) / np.diff([*starts, len(self.corners.view)])[:, None]
        Ts = self.solution.Ts_camera_board
        return np.linalg.norm(np.einsum("vij,vj->vi", Ts[:, :3, :3], middle) + Ts[:, :3, 3], axis=1)


def _stack_corners(views: Sequence[BoardView], board: Board) -> Corners:
    """The corners of all views."""
    of_board = board.corners
    return Corners(
        np.concatenate([view.pixels for view in views]),
        np.concatenate([of_board[view.ids] for view in views]),
        np.repeat(np.arange(len(views)), [len(view.ids) for view in views]),
    )


def estimate_lens(views: Sequence[BoardView], board: Board, model: Model, width: int, height: int) -> Estimate | None:
    """The lens of pictures `width` x `height` that explains the views best; None where none explains them."""
    corners, names = _stack_corners(views, board), tuple(view.name for view in views)
    solution = _search_lens(corners, model, width, height)
    if solution is None or not np.isfinite(solution.cost):
        return None
    kept = _select_inliers(corners, solution)
    if not kept.all():
        present = np.unique(corners.view[kept])
        corners, names = corners.select_corners(kept), tuple(names[view] for view in present)
        solution = solve(corners, solution.numbers, solution.Ts_camera_board[present], model.kind)
    return _estimate(model, corners, solution, names, int((~kept).sum()), width, height)


def refit_lens(estimate: Estimate, to: Estimate) -> Estimate | None:
    """The same model fitted to the corners that `to` is of; None where it was not seen in all of its views."""
    known = {name: number for number, name in enumerate(estimate.names)}
    if not set(to.names) <= set(known):
        return None
    Ts = estimate.solution.Ts_camera_board[[known[name] for name in to.names]]
    lens, solution = estimate.lens, solve(to.corners, estimate.solution.numbers, Ts, estimate.model.kind)
    return _estimate(estimate.model, to.corners, solution, to.names, to.left_out, lens.width, lens.height)


def _estimate(
    model: Model, corners: Corners, solution: Solution, names: tuple[str, ...], left_out: int, width: int, height: int
) -> Estimate | None:
    if not np.isfinite(solution.cost):
        return None
    try:
        lens = model.lens(solution.numbers, width, height)
    except ValueError:  # numbers that are no lens
        return None
    return Estimate(model, lens, corners, solution, names, left_out, _covariance(corners, solution))


def _covariance(corners: Corners, solution: Solution) -> Array:
    """(P, P) of independent corners, times how much more the views contradict one another than such corners would.

    What a view has in common, a bend of the board or a shadow, pulls at all its corners: the variance of the views'
    pulls (the middle of Liang and Zeger's sandwich) is compared with what is expected, in the mean over all numbers.
    """
    views, numbers = solution.pulls.shape
    free = max(1, corners.pixels.size - 6 * views - numbers)
    covariance = _inverse(solution.information) * float((solution.residuals**2).sum()) / free
    pulls = solution.pulls - solution.pulls.mean(axis=0)
    expected = max(float((solution.residuals**2).sum()) / free, 1e-12) * solution.information
    contradiction = np.trace(np.linalg.pinv(expected, hermitian=True) @ (pulls.T @ pulls)) / numbers
    return covariance * max(1.0, float(contradiction))


def _inverse(information: Array) -> Array:
    """Inverts the information matrix: what is not determined has a very large variance instead of an infinite one."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    return (vectors / np.maximum(values, 1e-14)) @ vectors.T * np.outer(scale, scale)


def _select_inliers(corners: Corners, solution: Solution) -> npt.NDArray[np.bool_]:
    """(M,) all corners but those far off; a view that keeps too few keeps none."""
    off = np.linalg.norm(solution.residuals, axis=1)
    sigma = max(float(np.median(off)) / 1.177, _LEAST_SIGMA_PX)  # of a Rayleigh distribution
    kept = off < _OUTLIER * sigma
    enough = np.add.reduceat(kept.astype(int), corners.starts) >= LEAST_CORNERS
    return kept & enough[corners.view]


def _search_lens(corners: Corners, model: Model, width: int, height: int) -> Solution | None:
    """The best of several searches, which begin at different angles of view."""
    best: Solution | None = None
    for field_deg in _FIELDS_DEG[model.kind]:
        numbers = np.zeros(model.num_numbers)
        numbers[:2], numbers[2:4] = _focal(field_deg, max(width, height), model.kind), (width / 2, height / 2)
        Ts = _first_poses(corners, model.lens(numbers, width, height))
        if Ts is None:
            continue
        tried = solve(corners, numbers, Ts, model.kind, steps=_FIRST_STEPS)
        if best is None or tried.cost < best.cost:
            best = tried
    if best is None or not np.isfinite(best.cost):
        return None
    return solve(corners, best.numbers, best.Ts_camera_board, model.kind)


def _focal(field_deg: float, longer: int, kind: str) -> float:
    half = np.radians(field_deg) / 2
    return float(longer / 2 / (half if kind == "fisheye" else np.tan(half)))


def _first_poses(corners: Corners, lens: Intrinsics) -> Array | None:
    rays = lenses.unproject(corners.pixels, lens)
    Ts = []
    for view in range(len(corners.starts)):
        mine = (corners.view == view) & np.isfinite(rays).all(axis=1)
        T = board_pose(rays[mine], corners.points[mine, :2]) if mine.sum() >= 4 else None
        if T is None:
            return None
        Ts.append(T)
    return np.array(Ts)
