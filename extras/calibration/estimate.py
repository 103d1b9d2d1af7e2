"""The lens of one model from views of the board, with what is known of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.capture import lenses
from splatnode.capture.frame import Intrinsics
from splatnode.extras.calibration.board import LEAST_CORNERS, Board, BoardView

# Pixels of points, and how they change with the point and with the numbers of the lens.
#
# The models are those of `capture.lenses`, which a test compares them with. Their derivatives are worked out by hand.

Array = npt.NDArray[np.float64]

_NEAREST = 1e-6  # to the camera's axis, as a share of the depth: nearer, 0 / 0
_AHEAD = 1e-3  # of the distance: what a radial lens sees is at least so far before it


@dataclass(frozen=True, eq=False)
class Projection:
    """M points through a lens of P numbers; not a number where the lens cannot see a point."""

    pixels: Array  # (M, 2)
    by_point: Array  # (M, 2, 3)
    by_lens: Array  # (M, 2, P): fx fy cx cy and the terms


def project_points(points: Array, numbers: Array, kind: str) -> Projection:
    """Points (M, 3) of the camera's frame through the lens fx fy cx cy and terms, which is "opencv" or "fisheye"."""
    bent = _fisheye if kind == "fisheye" else _opencv
    flat, by_point, by_terms = bent(points, numbers[4:])
    focal = numbers[:2]
    by_lens = np.zeros((len(points), 2, len(numbers)))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = flat[:, 0], flat[:, 1]
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    by_lens[:, :, 4:] = by_terms * focal[:, None]
    return Projection(flat * focal + numbers[2:4], by_point * focal[:, None], by_lens)


def _fisheye(points: Array, terms: Array) -> tuple[Array, Array, Array]:
    """Projects points in focal lengths (M, 2), with derivatives by point (M, 2, 3) and by term (M, 2, T)."""
    x, y, z = points.T
    across = np.maximum(np.hypot(x, y), _NEAREST * np.abs(z) + 1e-12)
    angle = np.arctan2(across, z)
    powers = angle[:, None] ** np.arange(3, 2 * len(terms) + 2, 2)  # of k1, k2, ...
    radius = angle + powers @ terms
    growth = 1 + (powers * np.arange(3, 2 * len(terms) + 2, 2) / angle[:, None]) @ terms  # of the radius, by the angle
    squared = across**2 + z**2
    scale = radius / across
    aside = (growth * z / squared - scale) / across**2  # of the scale, by x or y, divided by that
    along = -growth / squared  # of the scale, by z
    side = points[:, :2]
    by_point = np.empty((len(points), 2, 3))
    by_point[:, :, :2] = side[:, :, None] * side[:, None, :] * aside[:, None, None]
    by_point[:, 0, 0] += scale
    by_point[:, 1, 1] += scale
    by_point[:, :, 2] = side * along[:, None]
    return side * scale[:, None], by_point, side[:, :, None] * (powers / across[:, None])[:, None, :]


def _opencv(points: Array, terms: Array) -> tuple[Array, Array, Array]:
    """As `_fisheye`, of k1 k2 p1 p2 k3 k4 k5 k6, or as many of them as there are."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.concatenate([terms, np.zeros(8 - len(terms))])
    depth = np.where(points[:, 2] > _AHEAD * np.linalg.norm(points, axis=1), points[:, 2], np.nan)
    x, y = points[:, 0] / depth, points[:, 1] / depth
    r2 = x * x + y * y
    above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    below = np.where(below > 0, below, np.nan)  # beyond the pole there is no picture
    radial = above / below
    growth = (k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / below  # by r2
    flat = np.column_stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
    )
    mixed = 2 * x * y * growth + 2 * p1 * x + 2 * p2 * y
    by_x = np.column_stack([radial + 2 * x * x * growth + 2 * p1 * y + 6 * p2 * x, mixed])
    by_y = np.column_stack([mixed, radial + 2 * y * y * growth + 6 * p1 * y + 2 * p2 * x])
    by_point = np.stack([by_x, by_y, -(by_x * x[:, None] + by_y * y[:, None])], axis=-1) / depth[:, None, None]
    side = np.column_stack([x, y])
    above_terms = side[:, :, None] * (r2[:, None] ** [1, 2, 3] / below[:, None])[:, None, :]
    below_terms = -above_terms * radial[:, None, None]
    tangential = np.stack(
        [np.column_stack([2 * x * y, r2 + 2 * y * y]), np.column_stack([r2 + 2 * x * x, 2 * x * y])], axis=-1
    )
    by_terms = np.concatenate([above_terms[:, :, :2], tangential, above_terms[:, :, 2:], below_terms], axis=-1)
    return flat, by_point, by_terms[:, :, : len(terms)]


# Rotations of many things at once.


def cross_matrices(vectors: Array) -> Array:
    """(N, 3, 3): the matrices that take the cross product with each of `vectors` (N, 3)."""
    x, y, z = vectors.T
    none = np.zeros_like(x)
    return np.stack([none, -z, y, z, none, -x, -y, x, none], axis=-1).reshape(-1, 3, 3)


def rotations(vectors: Array) -> Array:
    """(N, 3, 3) of rotation vectors (N, 3) in radians, by the formula of Rodrigues."""
    angles = np.linalg.norm(vectors, axis=1)[:, None, None]
    cross = cross_matrices(vectors)
    return np.eye(3) + np.sinc(angles / np.pi) * cross + 0.5 * np.sinc(angles / (2 * np.pi)) ** 2 * cross @ cross


# The lens and all poses of the board that explain the corners best: least squares by Levenberg and Marquardt.
#
# The poses are eliminated from the normal equations (Schur complement), so that a step costs a matrix of the lens's
# own size and six numbers a view. Source: Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, section 6.


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


# The lens models that can be calibrated, those with fewer terms first.


@dataclass(frozen=True)
class Model:
    """A lens as a vector of numbers: fx fy cx cy, then the first `num_terms` coefficients of its kind."""

    name: str
    kind: str  # Intrinsics.model
    num_terms: int
    description: str

    @property
    def num_numbers(self) -> int:
        return 4 + self.num_terms

    def lens(self, numbers: Array, width: int, height: int) -> Intrinsics:
        """`numbers` (P,) as a lens. Raises ValueError where they are none."""
        terms = tuple(float(term) for term in numbers[4:])
        if self.kind == "opencv" and 0 < len(terms) < 4:
            terms = (*terms, *[0.0] * (4 - len(terms)))  # p1 p2, without which k1 k2 cannot be told
        fx, fy, cx, cy = map(float, numbers[:4])
        return Intrinsics(width, height, fx, fy, cx, cy, "calibration", terms, self.kind)


MODELS = {
    model.name: model
    for model in (
        Model("pinhole", "opencv", 0, "a pinhole"),
        Model("opencv2", "opencv", 2, "OpenCV's radial terms k1 k2"),
        Model("opencv4", "opencv", 4, "OpenCV's k1 k2 p1 p2"),
        Model("fisheye", "fisheye", 4, "an equidistant fisheye, k1 k2 k3 k4"),
        Model("opencv5", "opencv", 5, "OpenCV's k1 k2 p1 p2 k3"),
        Model("opencv8", "opencv", 8, "OpenCV's k1 k2 p1 p2 k3 k4 k5 k6"),
    )
}


# Where the board was, from the rays that meet its corners: a start for the estimate.


def board_pose(rays: Array, corners: Array) -> Array | None:
    """T_camera_board (4, 4) from unit rays (N, 3) that meet the board's corners (N, 2); None where they fix none.

    The homography from the board to the rays by the direct linear transform, which takes rays of every direction, also
    from behind the camera's plane (Hartley and Zisserman, Multiple View Geometry, chapter 4).
    """
    middle = corners.mean(axis=0)
    size = np.abs(corners - middle).max()
    flat = np.column_stack([(corners - middle) / size, np.ones(len(corners))])
    rows = np.einsum("nij,nk->nijk", cross_matrices(rays), flat).reshape(-1, 9)
    _, singular, right = np.linalg.svd(rows, full_matrices=False)
    if len(singular) < 9 or singular[7] < 1e-6 * singular[0]:
        return None
    homography = right[8].reshape(3, 3)
    if np.median(np.einsum("ni,ni->n", rays, flat @ homography.T)) < 0:
        homography = -homography
    homography /= np.sqrt(np.linalg.norm(homography[:, 0]) * np.linalg.norm(homography[:, 1])) + 1e-300
    left, _, turned = np.linalg.svd(np.column_stack([homography[:, :2], np.cross(homography[:, 0], homography[:, 1])]))
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ turned)]) @ turned
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = size * homography[:, 2] - rotation[:, :2] @ middle
    return T


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


# Which lens model to take: the one with the fewest terms that predicts views it was not fitted to as well as any.


FOLDS = 5
_NOISE = 2.0  # standard errors: so much better in the mean over views is better
_SLIGHT = 0.01  # of the mean square error: so little is worth no term, however sure


@dataclass(frozen=True, eq=False)
class Trial:
    """A model fitted to all views, and how it predicts each from the others."""

    estimate: Estimate
    errors: Array  # (V,) mean square distance of a view's corners from where they are predicted, square pixels

    @property
    def validation_rms_px(self) -> float:
        """Root mean square over the views."""
        return float(np.sqrt(self.errors.mean()))


@dataclass(frozen=True)
class Choice:
    taken: Trial
    trials: tuple[Trial, ...]  # of all models that explain the views


def choose(
    views: Sequence[BoardView],
    board: Board,
    width: int,
    height: int,
    models: Sequence[Model] = tuple(MODELS.values()),
) -> Choice | None:
    """The choice among `models`, which have more terms one after the other; None where none explains the views."""
    fitted = [estimate_lens(views, board, model, width, height) for model in models]
    found = [each for each in fitted if each is not None and len(each.names) >= FOLDS]
    if not found:
        return None
    closest = min(found, key=lambda each: float(np.median(np.abs(each.solution.residuals))))
    again = [refit_lens(each, closest) for each in found]  # what was not seen right is of the pictures, not of a model
    trials = tuple(Trial(each, _cross_validate(each)) for each in again if each is not None)
    best = min(trials, key=lambda trial: trial.validation_rms_px)
    if not np.isfinite(best.validation_rms_px):
        return None
    return Choice(next(trial for trial in trials if not _is_worse(trial, best)), trials)


def _is_worse(trial: Trial, best: Trial) -> bool:
    """Whether `best` predicts better by more than chance: the views are paired, and differ by the model alone."""
    gains = trial.errors - best.errors
    if not np.isfinite(gains).all():
        return True
    mean, noise = gains.mean(), gains.std() / np.sqrt(len(gains) - 1)
    return bool(mean > _NOISE * noise and mean > _SLIGHT * best.errors.mean())


def _cross_validate(whole: Estimate) -> Array:
    """(V,) of its views; of a view that is left out, only the pose is found. Infinite where a fit fails."""
    corners, numbers = whole.corners, np.arange(len(whole.names))
    start, Ts, kind = whole.solution.numbers, whole.solution.Ts_camera_board, whole.model.kind
    errors = np.full(len(numbers), np.inf)
    for fold in range(FOLDS):
        out = numbers % FOLDS == fold
        fitted = solve(corners.select_corners(~out[corners.view]), start, Ts[~out], kind)
        rest = corners.select_corners(out[corners.view])
        posed = solve(rest, fitted.numbers, Ts[out], kind, fixed=True)
        if np.isfinite(posed.cost):
            counts = np.diff([*rest.starts, len(rest.view)])
            errors[out] = np.add.reduceat((posed.residuals**2).sum(axis=1), rest.starts) / counts
    return errors


# How well it is known where the lens shows a ray.


_SAME_PX = 0.01  # a ray is a pixel's if the lens sees it so near: a lens that folds the picture has none for some


def pixel_sigmas(estimate: Estimate, pixels: Array) -> Array:
    """(K,) standard deviations, in pixels, of where the rays of `pixels` (K, 2) are seen: both directions together.

    The lens's covariance, carried to the picture. Not a number where the lens shows no ray.
    """
    sigmas = np.full(len(pixels), np.nan)
    rays = lenses.unproject(pixels, estimate.lens)
    there = np.flatnonzero(np.isfinite(rays).all(axis=1))
    apart = np.linalg.norm(lenses.project(rays[there], estimate.lens) - pixels[there], axis=1)
    seen = there[apart < _SAME_PX]
    by_lens = project_points(rays[seen], estimate.solution.numbers, estimate.model.kind).by_lens
    variances = np.einsum("kip,pq,kiq->k", by_lens, estimate.covariance, by_lens)
    sigmas[seen] = np.sqrt(np.maximum(variances, 0.0))
    return sigmas
