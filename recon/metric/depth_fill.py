"""Point maps with the depth that depth images measured, where the images themselves cannot tell it.

Stereo needs something to see: a plain wall has no depth by it. A depth image is smoothed where it is a plane within its
noise, taken into the image, and weighed against stereo by the sigmas of both.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics
from splatnode.capture.lenses import project, unproject
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.metric.depth_fit import DepthFit, DepthView, find_depth_lens, fit_depth_images, group_by_name
from splatnode.recon.priors.pointmap import LEAST_CONFIDENCE, Pointmap, compute_depth_normals
from splatnode.recon.registration.registration import RegisteredCamera, Registration

log = logging.getLogger(__name__)

Map = npt.NDArray[np.float64]

STEREO_SIGMA = 0.004  # of a depth by stereo whose confidence is 1, as a share of it
MOST_SIGMA = 0.04  # of a measured depth that is taken, as a share of it
_CONFIDENT_SIGMA = 0.005  # at which a measured depth has the confidence 1
_MOST_CONFIDENCE = 0.9
_APART_SIGMAS = 3.0  # by which stereo and measured depth may differ and be averaged
_SURE = 0.9  # confidence of stereo from which on it is kept where both differ by more; below, it widens outlines
_JUMP = 0.03  # relative step of depth across which nothing is interpolated


@dataclass(frozen=True, eq=False)
class MeasuredDepth:
    """z and its standard deviation at each pixel of an image, metres; 0 where none was measured."""

    z: Map  # (h, w)
    sigma: Map  # (h, w)


def fill_measured_depth(
    pointmaps: Sequence[Pointmap], graph: ViewGraph, registration: Registration
) -> tuple[Pointmap, ...]:
    """The point maps, with measured depth where it tells more than stereo; the same ones where none was measured.

    Depth images that the points of the images contradict, or cannot judge, add nothing, which the log tells: without
    numbers, for those of the result are of all points that matches and cameras agree on in the end. `graph`
    and `registration` are those that the point maps were made of.
    """
    cameras = {graph.keyframes[camera.index].name: camera for camera in registration.cameras}
    keyframes = {keyframe.name: keyframe for keyframe in graph.keyframes if keyframe.frame.depth is not None}
    if not keyframes:
        return tuple(pointmaps)
    views = [make_depth_view(keyframes[name], registration, cameras[name]) for name in cameras if name in keyframes]
    fits = fit_depth_images(views)
    for fit in fits:
        log.log(logging.INFO if fit.is_usable else logging.WARNING, "%s", _describe_use(fit))
    usable, by_name = group_by_name(fits), {view.name: view for view in views}
    found = []
    for pointmap in pointmaps:
        if (fit := usable.get(pointmap.name)) is not None:
            measured = warp_depth(by_name[pointmap.name], pointmap.K, pointmap.depth.shape)
            unit = fit.metres_per_unit
            pointmap = fuse_depth(pointmap, MeasuredDepth(measured.z / unit, measured.sigma / unit))
        found.append(pointmap)
    return tuple(found)


def _describe_use(fit: DepthFit) -> str:
    who = f"depth images of {len(fit.names)} photographs" + (f" of {fit.camera_id}" if fit.camera_id else "")
    if fit.is_usable:
        return f"{who} fit the images and fill what these cannot tell"
    return f"{who} fill nothing: {fit.check.code.value}; the result tells why (depth_checks, report.json's depth)"


def make_depth_view(keyframe: Keyframe, registration: Registration, camera: RegisteredCamera) -> DepthView:
    """The keyframe's depth image, with the registered points that its camera observes."""
    frame = keyframe.frame
    if frame.depth is None:
        raise ValueError(f"{keyframe.name} has no depth image")
    mine = registration.observed_point[registration.observed_by == camera.index]
    T_camera_world = np.linalg.inv(camera.T_world_camera)
    points = registration.points[mine] @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    (fx, fy), (cx, cy) = camera.focals.tolist(), camera.principal.tolist()
    terms = (*camera.radial.tolist(), 0.0, 0.0) if camera.radial.any() else ()
    lens = Intrinsics(frame.width, frame.height, fx, fy, cx, cy, "estimated", terms)
    return DepthView(keyframe.name, frame.camera_id, points, frame.depth, lens)


def warp_depth(view: DepthView, K: Map, shape: tuple[int, int]) -> MeasuredDepth:
    """The depth image as the pinhole K (3, 3) of its camera sees it, in `shape` (h, w)."""
    z, sigma = view.surface
    own = find_depth_lens(view.depth, view.lens)
    T_camera_depth = view.depth.matrix
    height, width = shape
    across, down = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(across - K[0, 2]) / K[0, 0], (down - K[1, 2]) / K[1, 1], np.ones_like(across)], -1)
    if np.array_equal(T_camera_depth, np.eye(4)):
        pixels = project(rays.reshape(-1, 3).astype(np.float64), own).reshape(height, width, 2)
        return MeasuredDepth(*_sample(z, sigma, pixels))
    return _splat(z, sigma, own, T_camera_depth, K, shape)


def _sample(z: Map, sigma: Map, pixels: Map) -> tuple[Map, Map]:
    """z and sigma at pixels (h, w, 2): between its neighbours where these are one surface, else of the nearest."""
    columns, rows = np.moveaxis(np.nan_to_num(pixels - 0.5, nan=-9.0), -1, 0).astype(np.float32)
    near = [
        np.asarray(cv2.remap(each.astype(np.float32), columns, rows, cv2.INTER_NEAREST), np.float64)
        for each in (z, sigma)
    ]
    nearness = np.where(z > 0, 1.0 / np.maximum(z, 1e-9), 0.0).astype(np.float32)
    between = cv2.remap(nearness, columns, rows, cv2.INTER_LINEAR).astype(np.float64)
    fine = np.where(between > 0, 1.0 / np.maximum(between, 1e-9), 0.0)
    smooth = (near[0] > 0) & (np.abs(fine - near[0]) < _JUMP * near[0])
    return np.where(smooth, fine, near[0]), near[1]


def _splat(z: Map, sigma: Map, own: Intrinsics, T_camera_depth: Map, K: Map, shape: tuple[int, int]) -> MeasuredDepth:
    """Each measured point where the camera sees it, the nearest first; on a grid so coarse that it has no gaps."""
    rows, columns = np.nonzero(z > 0)
    rays = unproject(np.column_stack([columns, rows]).astype(np.float64) + 0.5, own)
    points = rays / rays[:, 2:] * z[rows, columns][:, None] @ T_camera_depth[:3, :3].T + T_camera_depth[:3, 3]
    size = max(1.0, 1.5 * K[0, 0] / own.fx)  # pixels of the image for one of the depth image
    height, width = (int(np.ceil(side / size)) for side in shape)
    nearest, its_sigma = np.full(height * width, np.inf), np.zeros(height * width)
    u, v = (K[i, i] * points[:, i] / np.maximum(points[:, 2], 1e-9) + K[i, 2] for i in (0, 1))
    inside = (points[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])
    cell = (v[inside] / size).astype(np.int64) * width + (u[inside] / size).astype(np.int64)
    order = np.argsort(-points[inside, 2], kind="stable")
    nearest[cell[order]] = points[inside, 2][order]
    its_sigma[cell[order]] = sigma[rows, columns][inside][order]
    grid = np.where(np.isfinite(nearest), nearest, 0.0).reshape(height, width)
    at = [
        np.minimum((np.arange(side) / size).astype(np.int64), most - 1)
        for side, most in zip(shape, (height, width), strict=True)
    ]
    return MeasuredDepth(grid[np.ix_(*at)], its_sigma.reshape(height, width)[np.ix_(*at)])


def fuse_depth(pointmap: Pointmap, measured: MeasuredDepth) -> Pointmap:
    """The point map with measured depth (the scene's unit) where stereo tells none, and the mean where both agree.

    Where both differ, what stereo is sure of stays: the images judge.
    """
    stereo = pointmap.depth.astype(np.float64)
    share = np.where(measured.z > 0, measured.sigma / np.maximum(measured.z, 1e-12), np.inf)
    there = (measured.z > 0) & (share < MOST_SIGMA)
    by_stereo = (stereo > 0) & (pointmap.confidence >= LEAST_CONFIDENCE)
    stereo_share = STEREO_SIGMA / np.sqrt(np.maximum(pointmap.confidence, 1e-3))
    off = np.abs(np.log(np.where(there & by_stereo, measured.z / np.maximum(stereo, 1e-12), 1.0)))
    near = off < _APART_SIGMAS * np.hypot(share, stereo_share)
    both = there & by_stereo & near
    instead = there & (~by_stereo | (~near & (pointmap.confidence < _SURE)))
    weight = np.where(both, share**-2 / (share**-2 + stereo_share**-2), np.where(instead, 1.0, 0.0))
    weight = np.nan_to_num(weight)
    depth = np.where(weight > 0, (1.0 - weight) * stereo + weight * measured.z, stereo).astype(np.float32)
    believed = np.clip(_CONFIDENT_SIGMA / np.maximum(share, 1e-6), LEAST_CONFIDENCE, _MOST_CONFIDENCE)
    confidence = np.where(instead, believed, pointmap.confidence).astype(np.float32)
    normal = np.where(instead[..., None], compute_depth_normals(depth, pointmap.K), pointmap.normal)
    unchecked = pointmap.unchecked
    if unchecked is not None:
        unchecked = np.where(instead & (unchecked == 0), depth, unchecked).astype(np.float16)
    return replace(pointmap, depth=depth, confidence=confidence, normal=normal.astype(np.float32), unchecked=unchecked)
