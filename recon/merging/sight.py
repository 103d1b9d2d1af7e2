"""What a submap's cameras know of a point: whether they see a surface there, through it, or something before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import transform_to_camera
from splatnode.recon.result.export.prepare import select_gaussians
from splatnode.recon.result.rendering import NEAR, render_arrays
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays

Array = npt.NDArray[np.float64]

ALIKE = 0.05  # part of the depth within which a point lies on the surface: the depth that is rendered is a mean
BEFORE = 0.1  # part of the depth from which on a point lies before the surface
SOLID = 0.5  # opacity from which on a pixel has a surface
_AROUND = np.ones((3, 3), np.uint8)  # pixels among which a point's own is looked for: edges are blurred


@dataclass(frozen=True, eq=False)
class DepthView:
    """A camera, and between which depths the surface lies around each of its pixels."""

    camera: CameraEstimate
    nearest: npt.NDArray[np.float32]  # (H, W) infinite where there is no surface
    farthest: npt.NDArray[np.float32]  # (H, W) 0 where there is none


@dataclass(frozen=True, eq=False)
class PointVisibility:
    """The visibility of M points in the cameras of one submap. Pixels are those of the cameras at modelled size."""

    resolution: Array  # (M,) pixels a unit of length of the best camera that has the point on its surface, or 0
    on: npt.NDArray[np.int32]  # (M,) cameras that have the point on their surface
    before: npt.NDArray[np.int32]  # (M,) cameras that have it before their surface: they look through it
    veiled: Array  # (M,) pixels a unit of length at the surface behind the point, of the best such camera, or 0

    @property
    def quality(self) -> Array:
        """(M,) how well the point's surface is seen: the resolution, less for few views or disagreeing ones."""
        return self.resolution * self.on / (self.on + 1.0) * self.on / np.maximum(self.on + self.before, 1)


def depth_views(gaussians: GaussianArrays, cameras: Sequence[CameraEstimate]) -> tuple[DepthView, ...]:
    """Renders the surface of the Gaussians in each camera."""
    return tuple(_depth_view(gaussians, camera) for camera in cameras)


def surface_views(
    gaussians: GaussianArrays, shell: npt.NDArray[np.bool_], cameras: Sequence[CameraEstimate]
) -> tuple[DepthView, ...]:
    """The same without the far shell, which is no surface."""
    return depth_views(select_gaussians(gaussians, ~shell), cameras)


def measure_visibility(views: Sequence[DepthView], points: npt.NDArray[np.floating]) -> PointVisibility:
    """Measures the visibility of the world points (M, 3) in all `views` together."""
    count = len(points)
    resolution, veiled = np.zeros(count), np.zeros(count)
    on, before = np.zeros(count, np.int32), np.zeros(count, np.int32)
    for view in views:
        index, depth, nearest, farthest = _look_up_depths(view, points)
        focal = float(view.camera.K[0, 0])
        here = (depth >= (1 - ALIKE) * nearest) & (depth <= (1 + ALIKE) * farthest)
        through = depth < (1 - BEFORE) * nearest
        through &= np.isfinite(nearest)
        on[index[here]] += 1
        before[index[through]] += 1
        resolution[index[here]] = np.maximum(resolution[index[here]], focal / depth[here])
        veiled[index[through]] = np.maximum(veiled[index[through]], focal / nearest[through])
    return PointVisibility(resolution, on, before, veiled)


def _depth_view(gaussians: GaussianArrays, camera: CameraEstimate) -> DepthView:
    height, width = camera.height, camera.width
    if not len(gaussians):
        return DepthView(camera, np.full((height, width), np.inf, np.float32), np.zeros((height, width), np.float32))
    rendered = render_arrays(gaussians, camera.T_world_camera, camera.K, width, height, channels=("depth",))
    solid = (rendered.alpha >= SOLID) & (rendered.depth > 0)
    nearest = np.where(solid, rendered.depth, np.float32(np.inf)).astype(np.float32)
    farthest = np.where(solid, rendered.depth, np.float32(0)).astype(np.float32)
    eroded, dilated = cv2.erode(nearest, _AROUND), cv2.dilate(farthest, _AROUND)
    return DepthView(camera, np.asarray(eroded, np.float32), np.asarray(dilated, np.float32))


def _look_up_depths(
    view: DepthView, points: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.intp], Array, Array, Array]:
    """Looks up the points (M, 3) inside the image: returns indices, depths, and the nearest and farthest surface."""
    camera = view.camera
    local = transform_to_camera(points.astype(np.float64), camera.T_world_camera)
    ahead = np.flatnonzero(local[:, 2] > NEAR)
    x, y, z = local[ahead].T
    columns = np.floor(camera.K[0, 0] * x / z + camera.K[0, 2])
    rows = np.floor(camera.K[1, 1] * y / z + camera.K[1, 2])
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    at = rows[inside].astype(np.intp), columns[inside].astype(np.intp)
    nearest, farthest = view.nearest[at].astype(np.float64), view.farthest[at].astype(np.float64)
    return ahead[inside], z[inside], nearest, farthest
