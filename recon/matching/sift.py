"""SIFT features (Lowe, 2004) with RootSIFT descriptors (Arandjelovic and Zisserman, 2012), by the native core."""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from splatnode.recon.core import library, pointer
from splatnode.recon.matching.nearest_neighbours import DESCRIPTOR_SIZE, QUANTISED_NORM

Bytes = npt.NDArray[np.uint8]


def detect(grey: Bytes, most: int, contrast: float) -> tuple[npt.NDArray[np.float32], Bytes]:
    """The `most` strongest features of `grey` (H, W), the strongest first.

    Their points (M, 2) are pixels whose centres are whole numbers, their descriptors (M, 128) bytes of length
    `QUANTISED_NORM`. The image is enlarged to twice its size first; `contrast` is the least contrast of a feature,
    images being in [0, 1]. Raises ValueError where `grey` is not (H, W) bytes, or is empty.
    """
    if grey.dtype != np.uint8 or grey.ndim != 2 or not grey.size:
        raise ValueError(f"the image must be (H, W) uint8, got {grey.shape} {grey.dtype}")
    grey = np.ascontiguousarray(grey)
    points, descriptors = np.empty((most, 2), np.float32), np.empty((most, DESCRIPTOR_SIZE), np.uint8)
    height, width = grey.shape
    limits = most, ctypes.c_float(contrast), ctypes.c_float(QUANTISED_NORM)
    count = library().core_sift(pointer(grey), width, height, *limits, pointer(points), pointer(descriptors))
    return points[:count].copy(), descriptors[:count].copy()
