"""What photographs show alike: pixels of one surface in two of them, by depth that both agree on, and their colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.priors import reprojection
from splatnode.recon.priors.confirmed import AGREEING, LEAST_CONFIDENCE, MOST_PARTNERS
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.verification.exposure import BRIGHT, DARK
from splatnode.recon.workers import map_parallel

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]

STEP = 3  # pixels between those that are compared
MIN_SAMPLES = 200  # pixels that two photographs must share
INDEPENDENT = 50.0  # samples that count as one: neighbours show one surface
LEAST_SIGMA = 0.01  # of the logarithm of a ratio: surfaces shine differently in different directions


@dataclass(frozen=True, eq=False)
class SharedPixels:
    """M pixels of one surface in two photographs."""

    pair: tuple[int, int]  # the photographs' numbers
    logs: Array  # (M, 3) logarithms of the colours in the first over those in the second
    radii: Array  # (M, 2) squared, of the pixels in the first and in the second


def compute_squared_radius(x: npt.ArrayLike, y: npt.ArrayLike, width: int, height: int) -> Array:
    """Returns the squared distance of pixels at x and y from an image's middle: 1 at its corners."""
    across, along = np.asarray(x) + 0.5 - width / 2.0, np.asarray(y) + 0.5 - height / 2.0
    return (across**2 + along**2) / ((width**2 + height**2) / 4.0)


def find_shared_pixels(pointmaps: Sequence[Pointmap], pictures: Sequence[Image]) -> list[SharedPixels]:
    """Finds pixels that each two images share; `pictures` (h, w, 3) are as large as their point maps."""
    known = [pointmap.apply_mask(pointmap.confidence >= LEAST_CONFIDENCE) for pointmap in pointmaps]
    partners = reprojection.find_overlapping(known, MOST_PARTNERS)
    seen = map_parallel(lambda view: _sample_view(*view), list(zip(known, pictures, strict=True)))
    pairs = sorted({(min(i, j), max(i, j)) for i, others in enumerate(partners) for j in others})
    found = map_parallel(lambda pair: _compare_views(pair, seen[pair[0]], seen[pair[1]]), pairs)
    return [shared for shared in found if shared is not None]


def median_log(logs: Array) -> tuple[Array, Array]:
    """Returns the median of log ratios (M, ...) and its standard deviation."""
    median = np.median(logs, axis=0)
    spread = 1.4826 * np.median(np.abs(logs - median), axis=0)
    return median, np.hypot(spread / np.sqrt(len(logs) / INDEPENDENT), LEAST_SIGMA)


@dataclass(frozen=True, eq=False)
class _SampledView:
    """A photograph with its depth, and M of its points."""

    picture: Float32  # (h, w, 3) without its noise, in grey levels
    depth: Float32  # (h, w) z in the camera's frame, 0 where unknown
    world_to_pixels: Array  # (3, 4)
    points: Float32  # (M, 3) world
    colours: Float32  # (M, 3)
    radii: Array  # (M,) squared


def _sample_view(pointmap: Pointmap, picture: Image) -> _SampledView:
    height, width = pointmap.depth.shape
    own = np.zeros((height, width), bool)
    own[::STEP, ::STEP] = pointmap.depth[::STEP, ::STEP] > 0
    smooth = np.asarray(cv2.blur(picture.astype(np.float32), (3, 3)), np.float32)
    to_pixels = pointmap.K @ np.linalg.inv(pointmap.T_world_camera)[:3]
    rows, columns = np.nonzero(own)
    radii = compute_squared_radius(columns, rows, width, height)
    return _SampledView(smooth, pointmap.depth, to_pixels, pointmap.points[own], smooth[own], radii)


def _compare_views(pair: tuple[int, int], source: _SampledView, target: _SampledView) -> SharedPixels | None:
    """None where the two share too little."""
    x, y, z = target.world_to_pixels[:, :3] @ source.points.T + target.world_to_pixels[:, 3:]
    height, width = target.depth.shape
    column, row = (np.floor(np.divide(each, z, out=np.full_like(z, -1.0), where=z > 0)).astype(int) for each in (x, y))
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row, z = column[inside], row[inside], z[inside]
    agree = np.abs(target.depth[row, column] - z) < AGREEING * z
    column, row = column[agree], row[agree]
    one, other = source.colours[inside][agree], target.picture[row, column]
    usable = ((np.minimum(one, other) > DARK) & (np.maximum(one, other) < BRIGHT)).all(axis=1)
    if usable.sum() < MIN_SAMPLES:
        return None
    logs = np.log(one[usable] / other[usable]).astype(np.float64)
    radii = np.column_stack([source.radii[inside][agree], compute_squared_radius(column, row, width, height)])
    return SharedPixels(pair, logs, radii[usable])
