"""One call of the compiled PatchMatch (recon/core/patchmatch.h): planes in, better planes out."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.core import library, pointer

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
MAX_SOURCES = 16  # kMaxSources of recon/core/patchmatch.h


@dataclass(frozen=True)
class Matching:
    """How planes are compared. Pixels are those of the level at hand."""

    best_weight_ratio: float = 0.5  # weight of the next-best source relative to the better one
    sigma_grey: float = 16.0  # bilateral weight of the window, grey levels
    sigma_space: float = 5.0  # bilateral weight of the window, pixels
    noise_variance: float = 2.0  # grey levels squared: patches flatter than this give no evidence
    smoothness: float = 0.01  # cost per neighbour and pixel of parallax between a plane and the neighbour's point
    smoothness_limit: float = 2.0  # most that counts of that parallax, pixels
    geometric: float = 0.1  # cost per pixel of forward-backward reprojection error
    geometric_limit: float = 2.0  # most that counts of that error, pixels


@dataclass(frozen=True)
class Search:
    """Which planes are tried."""

    iterations: int  # each visits every pixel once
    perturbation: float  # size of random changes in the first iteration, pixels of parallax; halved in each
    active_sources: int = 3  # per pixel: those that explain its plane best; new planes are compared in these alone
    random_starts: int = 0  # planes tried per pixel over the whole depth range before the first iteration


@dataclass(frozen=True, eq=False)
class PyramidLevel:
    """A view at one resolution. The centre of the top-left pixel is (0.5, 0.5)."""

    grey: npt.NDArray[np.uint8]  # (h, w)
    packed: npt.NDArray[np.int32]  # (h, w) each pixel with its right, lower and lower right neighbours
    K: Float64  # (3, 3)
    T_world_camera: Float64  # (4, 4)
    depth_range: tuple[float, float]

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w)."""
        return self.grey.shape[0], self.grey.shape[1]


@dataclass(frozen=True, eq=False)
class Planes:
    """A plane for every pixel: inverse depth at the pixel's centre and its change per pixel to the right and down."""

    values: Float32  # (h, w, 3); (0, 0, 0) is "unknown"
    costs: Float32  # (h, w) matching and geometric cost, 0 is perfect

    @property
    def inverse_depth(self) -> Float32:
        """(h, w) at the pixels' centres, 0 where unknown."""
        return self.values[..., 0]


class Transfer(ctypes.Structure):
    """Pixel (u, v) at inverse depth w lies at A (u, v, 1) + t w of the other camera, in homogeneous pixels."""

    _fields_ = (("A", ctypes.c_float * 9), ("t", ctypes.c_float * 3))


class _Source(ctypes.Structure):
    _fields_ = (
        ("packed", ctypes.c_void_p),
        ("inverse_depth", ctypes.c_void_p),
        ("width", ctypes.c_int32),
        ("height", ctypes.c_int32),
        ("from_reference", Transfer),
        ("to_reference", Transfer),
    )


class _Problem(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("grey", "planes", "costs")),
        *((name, ctypes.c_int32) for name in ("width", "height")),
        *((name, ctypes.c_float) for name in ("fx", "fy", "cx", "cy", "min_inverse_depth", "max_inverse_depth")),
        ("sources", ctypes.c_void_p),
        *((name, ctypes.c_int32) for name in ("num_sources", "active_sources", "random_starts", "iterations")),
        *((name, ctypes.c_uint32) for name in ("stream", "seed")),
        *((name, ctypes.c_float) for name in ("perturbation", *Matching.__dataclass_fields__)),
    )


def make_level(
    image: npt.NDArray[np.uint8],  # (H, W, 3) RGB
    K: Float64,  # (3, 3)
    T_world_camera: Float64,  # (4, 4)
    depth_range: tuple[float, float],
    level: int,
) -> PyramidLevel:
    """The view at 1 / 2**level of its resolution."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    size = max(1, round(width / 2**level)), max(1, round(height / 2**level))
    if level:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    grey = np.ascontiguousarray(grey, np.uint8)
    packed = np.empty(grey.shape, np.int32)
    library().patchmatch_pack(pointer(grey), *size, pointer(packed))
    scale = np.diag([size[0] / width, size[1] / height, 1.0])
    return PyramidLevel(grey, packed, scale @ K, T_world_camera, depth_range)


def improve_planes(
    view: PyramidLevel,
    sources: Sequence[PyramidLevel],
    planes: Planes,
    search: Search,
    matching: Matching,
    *,
    known: Mapping[int, Float32],
    seed: int,
    stream: int,
) -> Planes:
    """Planes of `view` that explain `sources` better than `planes`, which is left as it was.

    `known` gives inverse depths (h, w), 0 where unknown, of the sources with these positions in `sources`.
    `seed` and `stream` choose the random numbers. Raises ValueError for no or too many sources, or a wrong shape.
    """
    if not 1 <= len(sources) <= MAX_SOURCES:
        raise ValueError(f"between 1 and {MAX_SOURCES} sources are needed, got {len(sources)}")
    if planes.values.shape != (*view.shape, 3):
        raise ValueError(f"planes must be {(*view.shape, 3)}, got {planes.values.shape}")
    values, costs = planes.values.copy(), planes.costs.copy()
    depths = [
        np.ascontiguousarray(known[i], np.float32) if i in known else np.zeros(source.shape, np.float32)
        for i, source in enumerate(sources)
    ]
    if any(depth.shape != source.shape for depth, source in zip(depths, sources, strict=True)):
        raise ValueError(f"known must be as large as the sources, got {[depth.shape for depth in depths]}")
    matching = matching if known else replace(matching, geometric=0.0)
    array = (_Source * len(sources))(
        *(
            _Source(
                pointer(source.packed), pointer(depth), source.shape[1], source.shape[0],
                compute_transfer(view, source), compute_transfer(source, view),
            )
            for source, depth in zip(sources, depths, strict=True)
        )
    )  # fmt: skip
    near, far = view.depth_range
    problem = _Problem(
        pointer(view.grey), pointer(values), pointer(costs), view.shape[1], view.shape[0],
        view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2], 1 / far, 1 / near,
        ctypes.cast(array, ctypes.c_void_p), len(sources),
        search.active_sources, search.random_starts, search.iterations,
        stream, seed & 0xFFFFFFFF, search.perturbation,
        *(getattr(matching, name) for name in Matching.__dataclass_fields__),
    )  # fmt: skip
    library().patchmatch_run(ctypes.byref(problem))
    return Planes(values, costs)


def compute_transfer(reference: PyramidLevel, other: PyramidLevel) -> Transfer:
    """The map from pixels and inverse depths of `reference` to pixels of `other`."""
    T_other_reference = np.linalg.inv(other.T_world_camera) @ reference.T_world_camera
    A = other.K @ T_other_reference[:3, :3] @ np.linalg.inv(reference.K)
    t = other.K @ T_other_reference[:3, 3]
    return Transfer((ctypes.c_float * 9)(*A.ravel()), (ctypes.c_float * 3)(*t))


def resize_planes(planes: Planes, view: PyramidLevel) -> Planes:
    """The planes for the pixels of another resolution: each pixel takes the plane that its centre falls into."""
    height, width = planes.inverse_depth.shape
    if (height, width) == view.shape:
        return planes
    rows, down, per_row = _find_nearest(height, view.shape[0])
    columns, right, per_column = _find_nearest(width, view.shape[1])
    values = planes.values[rows[:, None], columns[None, :]]
    inverse_depth = values[..., 0] + values[..., 1] * right[None, :] + values[..., 2] * down[:, None]
    resized_values = np.stack([inverse_depth, values[..., 1] * per_column, values[..., 2] * per_row], -1)
    return Planes(resized_values.astype(np.float32), planes.costs[rows[:, None], columns[None, :]])


def _find_nearest(size: int, new_size: int) -> tuple[npt.NDArray[np.intp], Float32, float]:
    """For each new pixel: the old pixel, the distance from its centre in old pixels; and old pixels per new pixel."""
    step = size / new_size
    centres = (np.arange(new_size) + 0.5) * step
    index = np.minimum(centres.astype(np.intp), size - 1)
    return index, (centres - index - 0.5).astype(np.float32), step
