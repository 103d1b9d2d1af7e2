"""Reprojection of one view's point map into another: which point is nearest at a pixel, and what it would hide."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.core import library, pointer
from splatnode.recon.priors.pointmap import Pointmap

Float32 = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

OVERLAP_STEP = 8  # pixels between the points that tell how much two maps share


def find_overlapping(pointmaps: Sequence[Pointmap], most: int) -> list[list[int]]:
    """For each point map the others that share most with it, at most so many, in order.

    Two maps share the points of either that fall into the other's image; a point of OVERLAP_STEP squared is asked.
    """
    if len(pointmaps) <= most + 1:
        return [[i for i in range(len(pointmaps)) if i != j] for j in range(len(pointmaps))]
    thinned = [
        pointmap.points[::OVERLAP_STEP, ::OVERLAP_STEP][pointmap.depth[::OVERLAP_STEP, ::OVERLAP_STEP] > 0]
        for pointmap in pointmaps
    ]
    inside = np.array([[_count_inside(points, pointmap) for pointmap in pointmaps] for points in thinned])
    shared = inside + inside.T
    np.fill_diagonal(shared, -1)
    return [sorted(np.argsort(-row, kind="stable")[:most].tolist()) for row in shared]


def _count_inside(points: Float32, pointmap: Pointmap) -> int:
    """How many of the world's points (M, 3) fall into the point map's image."""
    height, width = pointmap.depth.shape
    T_camera_world = np.linalg.inv(pointmap.T_world_camera)
    x, y, z = pointmap.K @ (T_camera_world[:3, :3] @ points.T + T_camera_world[:3, 3:])
    return int(((z > 0) & (x >= 0) & (y >= 0) & (x < width * z) & (y < height * z)).sum())


def project_nearest(source: Pointmap, target: Pointmap) -> tuple[Float32, Float32]:
    """(h, w) depth in the target of the nearest source point that falls into each target pixel; (h, w) its footprint.

    The footprint is the point's depth in the source over the focal length: how much of the surface a pixel covers.
    Both are infinite where no point falls.
    """
    depth, footprint = (np.full(target.depth.shape, np.inf, np.float32) for _ in range(2))
    call = _reprojection(source, target)
    focal = ctypes.c_float(source.K[0, 0])
    library().core_reproject_nearest(ctypes.byref(call.native), focal, pointer(depth), pointer(footprint))
    return depth, footprint


def find_explained(
    source: Pointmap, source_image: Image, target: Pointmap, target_image: Image, colour_tolerance: float
) -> tuple[Mask, Mask]:
    """(h, w) target pixels on which source points fall; (h, w) those of which one has the pixel's colour.

    Colours are alike when no channel differs by more than `colour_tolerance`, in [0, 1]. Images are (h, w, 3).
    """
    falls, alike = np.zeros(target.depth.shape, np.uint8), np.zeros(target.depth.shape, np.uint8)
    call = _reprojection(source, target)
    images = [np.ascontiguousarray(image) for image in (source_image, target_image)]
    library().core_reproject_explained(
        ctypes.byref(call.native), *map(pointer, images), int(255 * colour_tolerance), pointer(falls), pointer(alike)
    )
    return falls > 0, alike > 0


def find_hiding(source: Pointmap, target: Pointmap, tolerance: float) -> Mask:
    """(h, w) source pixels whose point lies before the target's surface by more than `tolerance` of its depth."""
    marks = np.zeros(source.depth.shape, np.uint8)
    call = _reprojection(source, target)
    surface = np.ascontiguousarray(target.depth, np.float32)
    library().core_reproject_hiding(
        ctypes.byref(call.native), pointer(surface), ctypes.c_float(tolerance), pointer(marks)
    )
    return marks > 0


class _Native(ctypes.Structure):
    """The struct Reprojection of recon/core/reproject.cpp."""

    _fields_ = [
        ("depth", ctypes.c_void_p),
        *((name, ctypes.c_int32) for name in ("width", "height", "target_width", "target_height")),
        ("A", ctypes.c_float * 9),
        ("t", ctypes.c_float * 3),
    ]


class _Call:
    """The struct for one call, and the array that it points to, which must live as long."""

    def __init__(self, depth: Float32, target: Pointmap, A: npt.NDArray[np.float64], t: npt.NDArray[np.float64]):
        self.depth = depth
        height, width = depth.shape
        target_height, target_width = target.depth.shape
        self.native = _Native(
            depth.ctypes.data, width, height, target_width, target_height,
            (ctypes.c_float * 9)(*A.ravel()), (ctypes.c_float * 3)(*t),
        )  # fmt: skip


def _reprojection(source: Pointmap, target: Pointmap) -> _Call:
    T_target_source = np.linalg.inv(target.T_world_camera) @ source.T_world_camera
    A = target.K @ T_target_source[:3, :3] @ np.linalg.inv(source.K)
    return _Call(np.ascontiguousarray(source.depth, np.float32), target, A, target.K @ T_target_source[:3, 3])
