"""Partitions an image into pieces, each of which one colour and one depth explain well enough."""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from splatnode.recon.core import library

CHANNELS = 4  # of a pixel's features: three of colour and one of depth (kChannels of recon/core/partition.cpp)


def partition(
    features: npt.NDArray[np.float32],  # (h, w, 4)
    weights: npt.NDArray[np.float32],  # (h, w), positive
    wanted: npt.NDArray[np.bool_],  # (h, w)
    *,
    tile_px: int,
    min_area_px: int,
    max_error: float,
    noise_variance: float,
) -> tuple[npt.NDArray[np.int32], int]:
    """(h, w) the label of the piece that each pixel belongs to, -1 where it is not wanted; and the number of pieces.

    A piece is cut in two by a straight line, again and again, until its error is at most `max_error` or its area at
    most `min_area_px` pixels. The error is the squared deviation from the piece's mean, less `noise_variance`, weighted
    and summed over pixels and channels. No piece crosses the lines of a grid of `tile_px`. A piece may be in several
    parts where unwanted pixels lie between them. Raises ValueError for arrays of other shapes, or sizes out of range.
    """
    if features.ndim != 3 or features.shape[2] != CHANNELS or not wanted.shape == weights.shape == features.shape[:2]:
        shapes = f"{features.shape}, {weights.shape} and {wanted.shape}"
        raise ValueError(f"features must be (h, w, {CHANNELS}), weights and wanted (h, w), got {shapes}")
    if not 1 <= tile_px < 2**14 or min_area_px < 1:  # the core keeps places in a tile as int16
        raise ValueError(f"tile_px must be from 1 to 16383 and min_area_px positive, got {tile_px} and {min_area_px}")
    values = np.ascontiguousarray(features, np.float32)
    counted = np.ascontiguousarray(weights, np.float32)
    mask = np.ascontiguousarray(wanted, np.uint8)
    labels = np.empty(wanted.shape, np.int32)
    height, width = wanted.shape
    task = _Partition(
        values.ctypes.data, counted.ctypes.data, mask.ctypes.data,
        width, height, tile_px, min_area_px, max_error, noise_variance,
    )  # fmt: skip
    count = library().core_partition(ctypes.byref(task), ctypes.c_void_p(labels.ctypes.data))
    return labels, count


class _Partition(ctypes.Structure):
    """The struct Partition of recon/core/partition.cpp."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("features", "weights", "wanted")),
        *((name, ctypes.c_int32) for name in ("width", "height", "tile", "smallest")),
        *((name, ctypes.c_float) for name in ("most_error", "noise")),
    ]
