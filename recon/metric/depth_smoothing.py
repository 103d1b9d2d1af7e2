"""Depth images without their noise where they show planes: what many neighbours measured together is known better."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import DepthImage

Map = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_RADII = (8, 4, 2)  # of the windows in which a plane is looked for, pixels of 640 across, the largest first
_PLANE_SIGMAS = 1.5  # rms distance from a plane, over the noise
_OUTLIER_SIGMAS = 3.0  # of a pixel from the plane of its neighbours
_LEAST_WINDOW = 0.35  # share of a window's pixels that have a depth
_PIXELS_AS_ONE = 25.0  # neighbours are wrong alike: stereo compares windows


def smooth_depth(depth: DepthImage) -> tuple[Map, Map]:
    """(H, W) z and its standard deviation, metres: of the plane of the neighbours where there is one, else as it is.

    The nearness 1 / z of a plane is linear in the image. The largest window that is a plane within the noise counts.
    Pixels that are far from the plane of their neighbours are left out.
    """
    z = depth.metres.astype(np.float64)
    known = z > 0
    nearness = np.where(known, 1.0 / np.maximum(z, 1e-9), 0.0)
    noise = np.where(known, depth.noise.compute_sigma(z) * nearness**2, 0.0)  # of the nearness
    if depth.confidence is not None:  # what is half believed is twice as unsure
        noise *= 255.0 / np.maximum(depth.confidence, 1)
    best, sigma, open_yet = nearness.copy(), noise.copy(), known.copy()
    for radius in _RADII:
        side = 2 * max(1, round(radius * max(z.shape) / 640)) + 1
        value, rms, count = _fit_planes(nearness, known, side)
        plane = (count >= _LEAST_WINDOW * side**2) & (rms < _PLANE_SIGMAS * noise) & open_yet & (value > 0)
        outlier = plane & (np.abs(nearness - value) > _OUTLIER_SIGMAS * noise)
        best[plane], best[outlier] = value[plane], 0.0
        sigma[plane] = noise[plane] / np.sqrt(np.maximum(count[plane] / _PIXELS_AS_ONE, 1.0))
        open_yet &= ~plane
    smooth = np.where(best > 0, 1.0 / np.maximum(best, 1e-9), 0.0)
    return smooth, sigma * smooth**2


def _fit_planes(values: Map, known: Mask, side: int) -> tuple[Map, Map, Map]:
    """The plane of the known values in the window around each pixel: its value there, rms distance, how many are known.

    Planes are fitted by least squares, from sums over windows.
    """
    height, width = values.shape
    x, y = np.meshgrid(np.arange(width) - width / 2.0, np.arange(height) - height / 2.0)
    weight = known.astype(np.float64)

    def total(each: Map) -> Map:
        window, kind = (side, side), cv2.CV_64F
        summed = cv2.boxFilter(each * weight, kind, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed, np.float64)

    count = total(np.ones_like(values))
    many = np.maximum(count, 1.0)
    mean_x, mean_y, mean = total(x) / many, total(y) / many, total(values) / many
    xx, xy, yy = total(x * x) / many - mean_x**2, total(x * y) / many - mean_x * mean_y, total(y * y) / many - mean_y**2
    xv, yv = total(x * values) / many - mean_x * mean, total(y * values) / many - mean_y * mean
    vv = total(values**2) / many - mean**2
    determinant = xx * yy - xy**2
    sound = determinant > 1e-3
    safe = np.where(sound, determinant, 1.0)
    slope_x, slope_y = (yy * xv - xy * yv) / safe, (xx * yv - xy * xv) / safe
    value = mean + slope_x * (x - mean_x) + slope_y * (y - mean_y)
    rms = np.sqrt(np.maximum(vv - slope_x * xv - slope_y * yv, 0.0))
    return value, np.where(sound, rms, np.inf), count
