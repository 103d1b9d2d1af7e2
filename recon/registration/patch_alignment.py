"""Affine alignment of image patches to parts of a pixel (Baker and Matthews, 2004)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.core import library

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Grey = npt.NDArray[np.float32]

MAX_RADIUS = 12  # pixels; `kMaxRadius` of recon/core/align.cpp


class PatchAlignmentConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    radius: int = 8  # of a patch, pixels; at most 12
    max_iterations: int = 20  # of Gauss-Newton, at most


@dataclass(frozen=True, eq=False)
class Patches:
    """M patches of reference images, with a first guess of their positions in target images.

    Pixels are those of the images given to `align`, the top-left pixel's centre at (0.5, 0.5).
    """

    reference_image: Index  # (M,)
    reference: Array  # (M, 2) pixels
    target_image: Index  # (M,)
    target: Array  # (M, 2) pixels
    affine: Array  # (M, 2, 2) from offsets in the reference to offsets in the target


@dataclass(frozen=True, eq=False)
class AlignedPatches:
    """The M patches after alignment."""

    target: Array  # (M, 2) pixels
    affine: Array  # (M, 2, 2)
    correlation: Array  # (M,) normalised, of grey levels after the warp; -1 where a patch could not be aligned
    sigma: Array  # (M,) standard deviation of the position along its worst direction, pixels; infinite where it failed


def align(images: Sequence[Grey], patches: Patches, config: PatchAlignmentConfig) -> AlignedPatches:
    """Aligns the patches with their targets, by an affine warp and a gain and offset of the grey levels.

    `images` are (H, W) float32, grey levels of 0 to 255. With `max_iterations` 0 nothing moves: the result has the
    correlations of the first guess. Raises ValueError for a radius or an image number out of range.
    """
    count = len(patches.reference)
    if not 1 <= config.radius <= MAX_RADIUS:
        raise ValueError(f"the radius of a patch must be 1 to {MAX_RADIUS} pixels, got {config.radius}")
    for name, index in (("reference", patches.reference_image), ("target", patches.target_image)):
        if count and not 0 <= index.min() <= index.max() < len(images):
            raise ValueError(f"{name} images must be in [0, {len(images)}), got {index.min()} to {index.max()}")
    contiguous = [np.ascontiguousarray(image, dtype=np.float32) for image in images]
    pixels = (ctypes.c_void_p * len(images))(*(image.ctypes.data for image in contiguous))
    heights, widths = (np.array([image.shape[axis] for image in images], np.int32) for axis in (0, 1))
    indices = [np.ascontiguousarray(index, np.int32) for index in (patches.reference_image, patches.target_image)]
    reference = np.ascontiguousarray(patches.reference, np.float32)
    target, affine = (np.array(values, np.float32, order="C") for values in (patches.target, patches.affine))
    correlation, sigma = np.empty(count, np.float32), np.empty(count, np.float32)
    native_images = _Images(ctypes.cast(pixels, ctypes.c_void_p), widths.ctypes.data, heights.ctypes.data)
    arrays = (*indices, reference, target, affine, correlation, sigma)
    native = _Patches(*(array.ctypes.data for array in arrays), count, config.radius, config.max_iterations)
    library().core_align(ctypes.byref(native_images), ctypes.byref(native))
    return AlignedPatches(*(result.astype(np.float64) for result in (target, affine, correlation, sigma)))


class _Images(ctypes.Structure):
    """`Images` of recon/core/align.cpp."""

    _fields_ = tuple((name, ctypes.c_void_p) for name in ("pixels", "widths", "heights"))


class _Patches(ctypes.Structure):
    """`Patches` of recon/core/align.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("reference_image", "target_image", "reference", "target", "affine")),
        *((name, ctypes.c_void_p) for name in ("correlation", "sigma")),
        *((name, ctypes.c_int32) for name in ("count", "radius", "max_iterations")),
    )
