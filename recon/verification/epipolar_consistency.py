"""Dense photometric evidence: do the poses say where the pixels of one picture are in another?

A right pose predicts the epipolar line on which each patch of a picture is found again in another one. Its rivals are
lines beside it, with the same depths searched along them: on those, only chance and repetition help. The share of
patches that look most alike on the predicted line is compared with the share that chance gives, so that neither
texture nor exposure nor the size of the search decides.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.registration.register import Registration

BESIDE_SIDE = 512.0  # longer side at which `beside_px` holds
CORNER_BLOCK = 5  # pixels across in which a corner is measured
PLANE_ROUNDS = 4  # of iteratively reweighted least squares: points on other surfaces lose their weight
SLOPE_PRIOR = 0.3  # points' worth of weight for a slope of zero, which holds back where points do not define it
PLANE_RESIDUAL = 0.02  # of the median inverse depth, at which a point's weight is half
SLOPE_RANGE = 0.5, 2.0  # of the inverse depth at a patch's middle: what its plane may reach within the patch
MIN_DEPTH = 1e-6  # in median depths; what is nearer is behind the camera
MIN_EPIPOLAR_PX = 0.5  # length of the searched line; of a shorter one the direction is not known, and x is taken
MIN_LENGTH = 1e-9  # pixels: a division that is not used needs one
MIN_PATCH_NORM = 1e-3  # grey levels: a patch without any contrast correlates with nothing

Array = npt.NDArray[np.float64]
Grey = npt.NDArray[np.float32]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    cells: int = 20  # patches along the longer side of a picture
    partners: int = 2  # pictures in which the patches of one are looked for
    depths: int = 12  # depths that are tried for each patch
    # They reach by this factor about the depth of the plane through the points around the patch
    depth_range: float = 1.15
    neighbours: int = 12  # points that define that plane
    # Distances of the rival lines from the predicted one, pixels at a longer side of 512
    beside_px: tuple[float, ...] = (-14.0, -7.0, 7.0, 14.0)
    patch: int = 7  # side of a patch, pixels
    min_contrast: float = 4.0  # least standard deviation of a patch, grey levels
    # Least likeness on one of the lines; a patch that is like nothing is hidden or seen too differently
    min_likeness: float = 0.7


@dataclass(frozen=True, eq=False)
class Picture:
    """A registered view at modelled size, with the patches that are looked for in others."""

    grey: Grey  # (h, w)
    K: Array  # (3, 3)
    T_world_camera: Array  # (4, 4)
    pixels: Array  # (M, 2) middles of the patches
    planes: Array  # (M, 3) inverse depth there, and its change by a pixel right and down

    def hidden(self, mask: npt.NDArray[np.bool_]) -> Picture:
        """With nothing known where `mask` (h, w) is False: what is looked for there, or from there, is not tried."""
        return replace(self, grey=np.where(mask, self.grey, np.float32(np.nan)))


def picture(grey: Grey, K: Array, T_world_camera: Array, points: Array, depths: Array, config: Config) -> Picture:
    """The view that observes sparse points at the pixels `points` (P, 2), in depths (P,)."""
    pixels = _patches(grey, config) if len(points) >= config.neighbours else np.zeros((0, 2))
    return Picture(grey, K, T_world_camera, pixels, _planes(pixels, points, depths, config))


@dataclass(frozen=True)
class Score:
    """Of a picture's patches that are found in the other picture, be it on the predicted line or on its rivals."""

    tried: int
    share: float  # that is most alike on the predicted line
    chance: float  # share that chance would give

    @property
    def sigmas(self) -> float:
        """How far beyond chance the share is, in standard errors of a binomial share; 0 where nothing was tried."""
        if self.tried == 0:
            return 0.0
        error = np.sqrt(self.chance * (1.0 - self.chance) / self.tried)
        return float((self.share - self.chance) / error)


def in_partners(index: int, pictures: Mapping[int, Picture], registration: Registration, config: Config) -> Score:
    """Patches of the picture `index` in the pictures that share most points with it."""
    found_in = partners(index, pictures, registration, config.partners)
    return pooled([score(pictures[index], pictures[other], config) for other in found_in], config)


def partners(index: int, among: Collection[int], registration: Registration, count: int) -> list[int]:
    """The `count` views of `among` that share most points with the view `index`."""
    mine = registration.observed_point[registration.observed_by == index]
    shared = np.bincount(registration.observed_by[np.isin(registration.observed_point, mine)], minlength=max(among) + 1)
    return sorted((other for other in among if other != index), key=lambda other: (-shared[other], other))[:count]


def pooled(scores: Sequence[Score], config: Config) -> Score:
    tried = sum(each.tried for each in scores)
    return Score(tried, sum(each.tried * each.share for each in scores) / max(1, tried), _chance(config))


def score(picture: Picture, other: Picture, config: Config) -> Score:
    """Patches of one picture in another one."""
    if len(picture.pixels) == 0:
        return Score(0, 0.0, _chance(config))
    best = _best_likeness(picture, other, config)
    best = best[np.isfinite(best).all(1) & (best.max(1) > config.min_likeness)]
    return Score(len(best), float((best.argmax(1) == 0).mean()) if len(best) else 0.0, _chance(config))


def _chance(config: Config) -> float:
    return 1.0 / (1 + len(config.beside_px))


def _patches(grey: Grey, config: Config) -> Array:
    """(M, 2) pixels: the best corner of each cell of a grid, where it has contrast."""
    size = max(grey.shape) / config.cells
    rows, columns = (max(1, round(side / size)) for side in grey.shape)
    corner, contrast = cv2.cornerMinEigenVal(grey, CORNER_BLOCK), _contrast(grey, config.patch)
    margin = config.patch
    found = []
    for row in range(rows):
        top, bottom = (max(margin, min(grey.shape[0] - margin, round(k * size))) for k in (row, row + 1))
        for column in range(columns):
            left, right = (max(margin, min(grey.shape[1] - margin, round(k * size))) for k in (column, column + 1))
            if bottom <= top or right <= left:
                continue
            cell = corner[top:bottom, left:right]
            y, x = np.unravel_index(int(cell.argmax()), cell.shape)
            if contrast[top + y, left + x] >= config.min_contrast:
                found.append((left + x + 0.5, top + y + 0.5))
    return np.array(found).reshape(-1, 2)


def _contrast(grey: Grey, side: int) -> Array:
    """(h, w) the standard deviation of the square of `side` pixels around each pixel."""
    mean, squares = (box(grey, cv2.CV_64F, (side, side)) for box in (cv2.boxFilter, cv2.sqrBoxFilter))
    return np.sqrt(np.maximum(squares - mean**2, 0.0))


def _planes(pixels: Array, points: Array, depths: Array, config: Config) -> Array:
    """(M, 3) inverse depth at each of `pixels` (M, 2) and its change by a pixel right and down, from the points around.

    The inverse depth of a plane is linear in the pixels. Slopes are held back where the points do not define them.
    """
    if len(pixels) == 0:
        return np.zeros((0, 3))
    distance = np.linalg.norm(pixels[:, None] - points[None], axis=2)
    nearest = np.argpartition(distance, config.neighbours - 1, axis=1)[:, : config.neighbours]
    offset = points[nearest] - pixels[:, None]  # (M, N, 2)
    reach = np.maximum(np.take_along_axis(distance, nearest, 1).max(1), 1.0)[:, None, None]
    design = np.concatenate([np.ones((*nearest.shape, 1)), offset / reach], 2)
    inverse = 1.0 / depths[nearest]
    middle = np.median(inverse, axis=1)
    weight = np.ones_like(inverse)
    planes = np.zeros((len(pixels), 3))
    for _ in range(PLANE_ROUNDS):
        weighted = design * weight[..., None]
        normal = np.einsum("mni,mnj->mij", weighted, design) + SLOPE_PRIOR * np.diag([0.0, 1.0, 1.0])
        planes = np.linalg.solve(normal, np.einsum("mni,mn->mi", weighted, inverse)[..., None])[..., 0]
        residual = np.abs(np.einsum("mni,mi->mn", design, planes) - inverse) / middle[:, None]
        weight = 1.0 / (1.0 + (residual / PLANE_RESIDUAL) ** 2)
    planes[:, 1:] /= reach[:, 0]
    return planes


def _best_likeness(picture: Picture, other: Picture, config: Config) -> Array:
    """(M, L) highest correlation of each patch along the predicted line and along its rivals."""
    pixels, planes = picture.pixels, picture.planes
    beside = np.array([0.0, *config.beside_px]) * max(other.grey.shape) / BESIDE_SIDE
    half = config.patch // 2
    dy, dx = np.mgrid[-half : half + 1, -half : half + 1]
    window = np.stack([dx.ravel(), dy.ravel()], 1).astype(np.float64)  # (W, 2)
    around = pixels[:, None] + window  # (M, W, 2)
    rays = np.concatenate([around, np.ones((*around.shape[:2], 1))], 2) @ np.linalg.inv(picture.K).T
    T = np.linalg.inv(other.T_world_camera) @ picture.T_world_camera
    turned = rays @ (other.K @ T[:3, :3]).T  # (M, W, 3)
    moved = other.K @ T[:3, 3]
    factor = np.geomspace(1.0 / config.depth_range, config.depth_range, config.depths)
    inverse = planes[:, :1] + np.einsum("wk,mk->mw", window, planes[:, 1:])  # (M, W)
    inverse = np.clip(inverse, SLOPE_RANGE[0] * planes[:, :1], SLOPE_RANGE[1] * planes[:, :1])
    target = turned[:, None] + (factor[:, None] * inverse[:, None])[..., None] * moved  # (M, D, W, 3)
    behind = (target[..., 2] < MIN_DEPTH).any(2)
    seen = target[..., :2] / np.maximum(target[..., 2:], MIN_DEPTH)
    middle = seen[:, :, window.shape[0] // 2]  # (M, D, 2)
    along = middle[:, -1] - middle[:, 0]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(length > MIN_EPIPOLAR_PX, along / np.maximum(length, MIN_LENGTH), np.array([1.0, 0.0]))
    across = np.stack([-along[:, 1], along[:, 0]], 1)
    wanted = _normalised(_sample(picture.grey, around))
    result = np.full((len(pixels), len(beside)), np.nan)
    height, width = other.grey.shape
    for line, distance in enumerate(beside):
        places = seen + distance * across[:, None, None]
        inside = (
            (places[..., 0] >= 1).all(2)
            & (places[..., 1] >= 1).all(2)
            & (places[..., 0] <= width - 1).all(2)
            & (places[..., 1] <= height - 1).all(2)
            & ~behind
        )
        found = _normalised(_sample(other.grey, places))
        likeness = np.where(inside, (found * wanted[:, None]).sum(2), -np.inf)
        result[:, line] = likeness.max(1)
    return result


def _sample(grey: Grey, places: Array) -> Grey:
    """Grey levels (..., W) at pixels `places` (..., W, 2), bilinear."""
    shape = places.shape[:-1]
    flat = (places.reshape(-1, shape[-1], 2) - 0.5).astype(np.float32)
    return cv2.remap(grey, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR).reshape(shape).astype(np.float32)


def _normalised(patches: Grey) -> Grey:
    """Patches (..., W) with a mean of 0 and a length of 1."""
    centred = patches - patches.mean(-1, keepdims=True)
    return centred / np.maximum(np.linalg.norm(centred, axis=-1, keepdims=True), MIN_PATCH_NORM)
