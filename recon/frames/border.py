"""The dark rim of undistorted photographs: pixels at the border that the lens has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

WIDEST = 0.03  # of the longer side: what is dark for longer, inwards from the border, is a dark scene
SHORTEST = 0.2  # of a side: dark along less of it is no rim
BRIGHTEST = 80  # grey level of a pixel of the rim, into which shrinking the photograph mixes its neighbours


def shown(images: Sequence[Image]) -> list[Mask]:
    """For each photograph (h, w, 3) the pixels (h, w) that show the scene.

    A lens leaves the same rim in all its photographs, so it is where all those of a size are dark; of a size that
    there is only once, all pixels are taken to show the scene.
    """
    by_size: dict[tuple[int, ...], list[Image]] = {}
    for image in images:
        by_size.setdefault(image.shape, []).append(image)
    rims = {shape: _rim(alike) for shape, alike in by_size.items()}
    return [~rims[image.shape] for image in images]


def rectangle(shown: Mask) -> tuple[slice, slice]:
    """Rows and columns of an upright rectangle, as large as can be, all of which a photograph shows.

    The side that shows least is taken away until all sides show everything.
    """
    top, left = 0, 0
    bottom, right = shown.shape
    while not (inside := shown[top:bottom, left:right]).all():
        sides = inside[0], inside[-1], inside[:, 0], inside[:, -1]
        worst = int(np.argmin([side.mean() for side in sides]))
        top, bottom, left, right = top + (worst == 0), bottom - (worst == 1), left + (worst == 2), right - (worst == 3)
    return slice(top, bottom), slice(left, right)


def _rim(images: Sequence[Image]) -> Mask:
    """(h, w) what is dark in all of several images, from the border inwards, and a pixel more."""
    dark = reduce(np.maximum, images).max(2) <= BRIGHTEST
    if len(images) < 2:
        return np.zeros_like(dark)
    band = max(2, round(WIDEST * max(dark.shape)))
    upright = _from_top(dark, band) | _from_top(dark[::-1], band)[::-1]
    across = _from_top(dark.T, band).T | _from_top(dark.T[::-1], band)[::-1].T
    # Along one side's rim a corner is dark for longer than another side's rim is wide.
    corner = np.zeros_like(dark)
    for rows in (slice(0, band), slice(-band, None)):
        for columns in (slice(0, band), slice(-band, None)):
            corner[rows, columns] = upright[rows].any() and across[:, columns].any()
    rim = upright | across | (dark & corner)
    return cv2.dilate(rim.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _from_top(dark: Mask, band: int) -> Mask:
    """What is dark from the first row downwards, in the columns in which that ends within `band` rows, if many."""
    run = np.zeros_like(dark)
    run[: band + 1] = np.logical_and.accumulate(dark[: band + 1], axis=0)
    run &= ~run[min(band, len(run) - 1)]
    return run & (run[0].mean() >= SHORTEST)
