"""An image cut into pieces that one colour and one depth explain each."""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from recon.core import library

CHANNELS = 4


def partition(
    features: npt.NDArray[np.float32],  # (h, w, 4)
    wanted: npt.NDArray[np.bool_],  # (h, w)
    *,
    tile_px: int,
    smallest_px: int,
    most_error: float,
    noise: float,
) -> tuple[npt.NDArray[np.int32], int]:
    """(h, w) the number of the piece that each pixel belongs to, -1 where it is not wanted, and how many there are.

    A piece is cut by straight lines until its squared deviation from its mean, summed over pixels and channels and
    less `noise` for every pixel, is at most `most_error`, or it has at most `smallest_px` pixels. No piece reaches
    across the lines of a grid of `tile_px`. Pieces need not hang together where unwanted pixels lie between.
    """
    if features.ndim != 3 or features.shape[2] != CHANNELS or wanted.shape != features.shape[:2]:
        raise ValueError(
            f"features must be (h, w, {CHANNELS}) and wanted (h, w), got {features.shape} and {wanted.shape}"
        )
    if not 1 <= tile_px < 2**14 or smallest_px < 1:
        raise ValueError(f"tile_px must be from 1 to 16383 and smallest_px positive, got {tile_px} and {smallest_px}")
    values = np.ascontiguousarray(features, np.float32)
    mask = np.ascontiguousarray(wanted, np.uint8)
    labels = np.empty(wanted.shape, np.int32)
    height, width = wanted.shape
    task = _Partition(
        values.ctypes.data, mask.ctypes.data, width, height, tile_px, smallest_px, most_error, noise
    )  # fmt: skip
    count = library().core_partition(ctypes.byref(task), ctypes.c_void_p(labels.ctypes.data))
    return labels, count


class _Partition(ctypes.Structure):
    """Partition of recon/core/partition.cpp."""

    _fields_ = [
        ("features", ctypes.c_void_p),
        ("wanted", ctypes.c_void_p),
        *((name, ctypes.c_int32) for name in ("width", "height", "tile", "smallest")),
        *((name, ctypes.c_float) for name in ("most_error", "noise")),
    ]
