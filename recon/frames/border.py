"""The dark rim of undistorted photographs: pixels at the border that the lens has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

MAX_RIM_WIDTH = 0.03  # of the longer side: what is dark farther inwards from the border is a dark scene
MIN_RIM_LENGTH = 0.2  # of a side: what is dark along less of it is no rim
MAX_RIM_LEVEL = 80  # of 255: shrinking a photograph mixes the black of its rim with the scene beside it


def valid_masks(images: Sequence[Image]) -> list[Mask]:
    """For each photograph (h, w, 3) the mask (h, w) of the pixels that show the scene.

    A lens leaves the same rim in all its photographs, so the rim is where all photographs of one size are dark. Of a
    size that occurs only once, all pixels count as valid.
    """
    by_size: dict[tuple[int, ...], list[Image]] = {}
    for image in images:
        by_size.setdefault(image.shape, []).append(image)
    rims = {shape: _rim(alike) for shape, alike in by_size.items()}
    return [~rims[image.shape] for image in images]


def valid_rectangle(valid: Mask) -> tuple[slice, slice]:
    """Rows and columns of an upright rectangle of valid pixels only, as large as can be found greedily.

    The side with the smallest share of valid pixels is taken away until all sides are valid. `valid` is (h, w).
    """
    top, left = 0, 0
    bottom, right = valid.shape
    while not (inside := valid[top:bottom, left:right]).all():
        sides = inside[0], inside[-1], inside[:, 0], inside[:, -1]
        worst = int(np.argmin([side.mean() for side in sides]))
        top, bottom, left, right = top + (worst == 0), bottom - (worst == 1), left + (worst == 2), right - (worst == 3)
    return slice(top, bottom), slice(left, right)


def _rim(images: Sequence[Image]) -> Mask:
    """(h, w) runs of pixels from the border inwards that are dark in all `images`, dilated by a pixel."""
    dark = reduce(np.maximum, images).max(2) <= MAX_RIM_LEVEL
    if len(images) < 2:
        return np.zeros_like(dark)
    band = max(2, round(MAX_RIM_WIDTH * max(dark.shape)))
    upright = _top_runs(dark, band) | _top_runs(dark[::-1], band)[::-1]
    across = _top_runs(dark.T, band).T | _top_runs(dark.T[::-1], band)[::-1].T
    # In a corner, a run along one side lies in the other side's rim and is longer than `band`.
    corner = np.zeros_like(dark)
    for rows in (slice(0, band), slice(-band, None)):
        for columns in (slice(0, band), slice(-band, None)):
            corner[rows, columns] = upright[rows].any() and across[:, columns].any()
    rim = upright | across | (dark & corner)
    return cv2.dilate(rim.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _top_runs(dark: Mask, band: int) -> Mask:
    """(h, w) leading dark runs per column, if at most `band` long; none if in under MIN_RIM_LENGTH of the columns."""
    run = np.zeros_like(dark)
    run[: band + 1] = np.logical_and.accumulate(dark[: band + 1], axis=0)
    run &= ~run[min(band, len(run) - 1)]
    return run & (run[0].mean() >= MIN_RIM_LENGTH)
