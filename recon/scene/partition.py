"""An image cut into pieces that one colour and one depth explain each."""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from splatnode.recon.core import library

CHANNELS = 4


def partition(
    features: npt.NDArray[np.float32],  # (h, w, 4)
    weights: npt.NDArray[np.float32],  # (h, w), positive
    wanted: npt.NDArray[np.bool_],  # (h, w)
    *,
    tile_px: int,
    smallest_px: int,
    most_error: float,
    noise: float,
) -> tuple[npt.NDArray[np.int32], int]:
    """(h, w) the number of the piece that each pixel belongs to, -1 where it is not wanted, and how many there are.

    A piece is cut by straight lines until its squared deviation from its mean, less `noise`, weighted and summed over
    pixels and channels, is at most `most_error`, or it has at most `smallest_px` pixels. No piece reaches across the
    lines of a grid of `tile_px`. Pieces need not hang together where unwanted pixels lie between.
    """
    if features.ndim != 3 or features.shape[2] != CHANNELS or not wanted.shape == weights.shape == features.shape[:2]:
        shapes = f"{features.shape}, {weights.shape} and {wanted.shape}"
        raise ValueError(f"features must be (h, w, {CHANNELS}), weights and wanted (h, w), got {shapes}")
    if not 1 <= tile_px < 2**14 or smallest_px < 1:
        raise ValueError(f"tile_px must be from 1 to 16383 and smallest_px positive, got {tile_px} and {smallest_px}")
    values = np.ascontiguousarray(features, np.float32)
    counted = np.ascontiguousarray(weights, np.float32)
    mask = np.ascontiguousarray(wanted, np.uint8)
    labels = np.empty(wanted.shape, np.int32)
    height, width = wanted.shape
    task = _Partition(
        values.ctypes.data, counted.ctypes.data, mask.ctypes.data,
        width, height, tile_px, smallest_px, most_error, noise,
    )  # fmt: skip
    count = library().core_partition(ctypes.byref(task), ctypes.c_void_p(labels.ctypes.data))
    return labels, count


class _Partition(ctypes.Structure):
    """Partition of recon/core/partition.cpp."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("features", "weights", "wanted")),
        *((name, ctypes.c_int32) for name in ("width", "height", "tile", "smallest")),
        *((name, ctypes.c_float) for name in ("most_error", "noise")),
    ]
