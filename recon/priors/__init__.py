"""Priors: each proposes matches where plain features find few, and gives depth to registered cameras.

Pointmap: what every prior gives for a keyframe, in one world frame.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.core import library, pointer
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching.view_graph import Matcher, ViewGraph
from splatnode.recon.networks.vit import Crop
from splatnode.recon.priors.stereo import MIN_SPARSE_POINTS, SparsePoints, estimate_depth_range
from splatnode.recon.registration.known_poses import axis_depths
from splatnode.recon.registration.registration import RegisteredCamera, Registration
from splatnode.recon.threads import BACKGROUND, RunContext, map_parallel


@dataclass(frozen=True, eq=False)
class Pointmap:
    """A 3D point and a confidence for every pixel of a keyframe at modelled size, with the camera that saw them."""

    name: str
    frame_id: int
    depth: npt.NDArray[np.float32]  # (h, w) z in the camera frame, 0 where unknown
    confidence: npt.NDArray[np.float32]  # (h, w) in [0, 1], 0 where unknown
    normal: npt.NDArray[np.float32]  # (h, w, 3) camera frame, unit length, facing the camera; any where depth is 0
    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    K: npt.NDArray[np.float64]  # (3, 3) at modelled size
    # (h, w) z that other views have not confirmed or denied yet, 0 where unknown: what further views are compared with
    unchecked: npt.NDArray[np.float16] | None = None

    @property
    def points(self) -> npt.NDArray[np.float32]:
        """(h, w, 3) world points; the camera's centre where the depth is unknown."""
        return compute_world_points(self.depth, self.T_world_camera, self.K)

    def thin_points(self, step: int) -> npt.NDArray[np.float32]:
        """(M, 3) the world points of every `step`-th pixel along each axis whose depth is known."""
        return self.points[::step, ::step][self.depth[::step, ::step] > 0]

    def apply_mask(self, keep: npt.NDArray[np.bool_]) -> Pointmap:
        """The point map with depth and confidence 0, which is unknown, outside the mask `keep` (h, w).

        It shares what the mask does not change: a hundred point maps at a time are most of the memory that is held.
        """
        if keep.all():
            return self
        return replace(self, depth=self.depth * keep, confidence=self.confidence * keep)

    def apply_image_mask(self, mask: npt.NDArray[np.bool_] | None) -> Pointmap:
        """As `apply_mask` by the mask (h, w) of the photograph, whose pixels confirm and deny nothing either."""
        if mask is None:
            return self
        unchecked = None if self.unchecked is None else self.unchecked * mask
        return replace(self.apply_mask(mask), unchecked=unchecked)


def compute_world_points(
    depth: npt.NDArray[np.float32],  # (h, w) z in the camera frame
    T_world_camera: npt.NDArray[np.float64],  # (4, 4)
    K: npt.NDArray[np.float64],  # (3, 3)
) -> npt.NDArray[np.float32]:
    """(h, w, 3) world points that a camera's pixels show; the camera's centre where the depth is 0."""
    height, width = depth.shape
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    camera_points = rays * depth[..., None]
    return (camera_points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]).astype(np.float32)


# Reprojection of one view's point map into another: which point is nearest at a pixel, and what it would hide.

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
    thinned = [pointmap.thin_points(OVERLAP_STEP) for pointmap in pointmaps]
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


# Depths that two photographs confirm, and what of them a result keeps.


LEAST_CONFIDENCE = 0.12  # of stereo for a depth that counts, as in recon.scene.completion
AGREEING = 0.02  # relative difference of two photographs' depths of one point
REDUCTION = 2  # pixels along each axis of which a result keeps one depth
MOST_PARTNERS = 8  # other photographs that each is compared with: those that share most with it


def find_consistent_pixels(pointmaps: Sequence[Pointmap]) -> list[Mask]:
    """(h, w) for each point map the pixels whose depth a point of another one confirms."""
    known = [pointmap.apply_mask(pointmap.confidence >= LEAST_CONFIDENCE) for pointmap in pointmaps]
    partners = find_overlapping(known, MOST_PARTNERS)

    def agrees(j: int) -> Mask:
        mine = known[j]
        mask = np.zeros(mine.depth.shape, bool)
        for i in partners[j]:
            there, _ = project_nearest(known[i], mine)
            mask |= np.abs(there - mine.depth) < AGREEING * mine.depth
        return mask & (mine.depth > 0)

    return map_parallel(agrees, range(len(known)))


def compute_consistent_shares(masks: Sequence[Mask], used: Sequence[Mask]) -> list[float]:
    """The share of each view's used pixels (h, w) whose depth is multi-view consistent, by the masks of
    `find_consistent_pixels`.

    It is 0 for a view of which nothing is used.
    """
    return [float(mask[own].mean()) if own.any() else 0.0 for mask, own in zip(masks, used, strict=True)]


def compute_consistent_depths(pointmaps: Sequence[Pointmap]) -> dict[str, npt.NDArray[np.float16]]:
    """Computes consistent depths by image, one for REDUCTION squared pixels; 0 where there is none.

    It is the mean of those of the square that are confirmed, at least half of its pixels, where these show one surface:
    at outlines nothing is kept.
    """
    return {
        pointmap.name: _reduce_depth(np.where(mask, pointmap.depth, np.float32(0)))
        for pointmap, mask in zip(pointmaps, find_consistent_pixels(pointmaps), strict=True)
    }


def _reduce_depth(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float16]:
    height, width = (side // REDUCTION for side in depth.shape)
    squares = depth[: height * REDUCTION, : width * REDUCTION].reshape(height, REDUCTION, width, REDUCTION)
    count = (squares > 0).sum((1, 3))
    near, far = np.where(squares > 0, squares, np.inf).min((1, 3)), squares.max((1, 3))
    sure = (2 * count >= REDUCTION**2) & (far - near < AGREEING * near)
    return np.where(sure, squares.sum((1, 3)) / np.maximum(count, 1), 0.0).astype(np.float16)


# Normals of a depth map that has none of its own.

Map = npt.NDArray[np.float32]


def compute_depth_normals(depth: Map, K: npt.NDArray[np.float64], max_step: float = 0.1) -> Map:
    """(H, W, 3) unit normals in the camera frame, facing the camera; 0 where they are not known.

    From the points of the neighbours on both sides (one side at borders and at steps of the depth by more than
    `max_step`, relatively). `depth` (H, W) is z, 0 where unknown; K is (3, 3).
    """
    height, width = depth.shape
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    z = depth.astype(np.float64)
    points = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], -1)
    along_u, along_v = _slope(points, 1, max_step), _slope(points, 0, max_step)
    normal = np.cross(along_u, along_v)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    known = (length > 0) & (depth[..., None] > 0)
    normal = np.where(known, normal / np.where(length > 0, length, 1.0), 0.0)
    away = (normal * points).sum(-1, keepdims=True) > 0
    return np.where(away, -normal, normal).astype(np.float32)


def _slope(points: npt.NDArray[np.float64], axis: int, max_step: float) -> npt.NDArray[np.float64]:
    """Change of the points (H, W, 3) along `axis`: the sum of the steps to both neighbours that lie on the surface."""
    step = np.diff(points, axis=axis)
    first, second = (points.take(range(a, points.shape[axis] + b), axis=axis)[..., 2:] for a, b in ((0, -1), (1, 0)))
    joined = (first > 0) & (second > 0) & (np.abs(first - second) <= max_step * np.minimum(first, second))
    step = np.where(joined, step, 0.0)
    pad = [(0, 0)] * 3
    pad[axis] = (1, 0)
    before = np.pad(step, pad)
    pad[axis] = (0, 1)
    return before + np.pad(step, pad)


# What the registration knows of a camera, at the modelled size of its keyframe's image.

Array = npt.NDArray[np.float64]

_AROUND = 4.0  # times nearer and farther than where the cameras' axes meet: searched of a camera without points


def compute_modelled_K(graph: ViewGraph, camera: RegisteredCamera) -> Array:
    """(3, 3) the intrinsics of a registered camera for its image at modelled size."""
    keyframe = graph.keyframes[camera.index]

    (sx, sy), (fx, fy), (cx, cy) = keyframe.scale, camera.focals, camera.principal
    return np.array([[fx * sx, 0.0, cx * sx], [0.0, fy * sy, cy * sy], [0.0, 0.0, 1.0]])


def select_sparse_points(
    registration: Registration, camera: RegisteredCamera, scale: tuple[float, float]
) -> SparsePoints:
    """The registered points that a camera observes: their pixels at modelled size, and their depths.

    `scale` is modelled over full width and height, as `Keyframe.scale`.
    """
    mine = registration.observed_by == camera.index
    world = registration.points[registration.observed_point[mine]]
    T_camera_world = np.linalg.inv(camera.T_world_camera)
    depths = world @ T_camera_world[2, :3] + T_camera_world[2, 3]
    return SparsePoints(registration.observed_pixels[mine] * scale, depths)


def compute_depth_range(
    registration: Registration, camera: RegisteredCamera, points: SparsePoints
) -> tuple[float, float]:
    """(near, far) in which a camera's depth is searched: from its `points`; of too few, where others look, too.

    A camera that a given pose holds may have no points: those of the others count, and where the axes of cameras meet.
    """
    if int((points.depths > 0).sum()) >= MIN_SPARSE_POINTS or registration.given is None:
        return estimate_depth_range(points.depths)
    T_camera_world = np.linalg.inv(camera.T_world_camera)
    depths = registration.points @ T_camera_world[2, :3] + T_camera_world[2, 3]
    if int((depths > 0).sum()) >= MIN_SPARSE_POINTS:
        return estimate_depth_range(depths)
    Ts = np.stack([each.T_world_camera for each in registration.cameras])
    depths = axis_depths(np.swapaxes(Ts[:, :3, :3], 1, 2), Ts[:, :3, 3])
    middle = float(np.median(depths)) if len(depths) else 1.0  # the unit of length is the distance to the scene
    return middle / _AROUND, middle * _AROUND


# The interface of priors. A new prior is one file or folder of recon/priors, and no line elsewhere.
#
# Its module has `Config`, a Struct with at least `seed`, and `load(config)`; `splatnode.recon.fallbacks` says what a
# module with learned weights has beside them. The weights need an entry in recon/networks/__init__.py.


class Prior(Protocol):
    """A loaded prior. It proposes matches that plain features miss, and gives depth to registered cameras.

    Cameras come from `recon.registration` whatever the prior is. The verdict on them comes before depth is asked for,
    so that cameras which are refused cost none.
    """

    matcher: Matcher | None  # what the view graph asks where plain features find few matches
    ends_early: bool = False  # whether a pause may raise OutOfTime, after which depth comes soon and coarser

    def pointmaps(
        self, graph: ViewGraph, registration: Registration, run: RunContext = BACKGROUND
    ) -> tuple[Pointmap, ...]:
        """A point map for each registered camera, in the order and the world of `registration`.

        It pauses several times a second, which may raise to abandon the work.
        """
        ...

    def further_pointmaps(
        self, graph: ViewGraph, registration: Registration, known: Mapping[str, Pointmap]
    ) -> tuple[Pointmap, ...]:
        """Point maps of the registered cameras that `known` (by name, in the same world) does not have, in their order.

        A prior that can add one view to others does better than this default, which computes all anew.
        """
        return tuple(found for found in self.pointmaps(graph, registration) if found.name not in known)


def apply_image_masks(pointmaps: Iterable[Pointmap], graph: ViewGraph) -> dict[str, Pointmap]:
    """The point maps by name, where nothing is known of what a mask hides."""
    masks = {keyframe.name: keyframe.mask for keyframe in graph.keyframes}
    return {pointmap.name: pointmap.apply_image_mask(masks[pointmap.name]) for pointmap in pointmaps}


# Monocular depth, learned from single photographs, fitted to multi-view depth: known where that is unknown too.

Network = Callable[[npt.NDArray[np.uint8]], tuple[Map, Crop]]  # image (h, w, 3) -> values (H, W), and their crop

_MIN_KNOWN = 50  # pixels with multi-view depth, to fit two numbers to
_MAX_DEPTH = 20.0  # times the median depth: beyond, inverse depths say nothing
_ITERATIONS = 15  # of reweighted least squares: the line then moves no more
_MIN_RESIDUAL = 1e-4  # of the median inverse depth: smaller residuals weigh no more


def fit_monocular_depth(pointmap: Pointmap, image: npt.NDArray[np.uint8], network: Network) -> Pointmap:
    """`pointmap` with the depth and the normals of `network`, which gives inverse depths up to scale and offset.

    These two are fitted to the known depths. `image` (h, w, 3) is the view at modelled size. The confidence is 1 where
    the network's depth is known. A view of which too little is known, or that the network contradicts, stays.
    """
    inverse = _resample_to_image(*network(image), image.shape[:2])
    known = (pointmap.depth > 0) & (inverse > 0)
    if known.sum() < _MIN_KNOWN:
        return pointmap
    slope, offset = _fit_line(inverse[known], 1.0 / pointmap.depth[known], pointmap.confidence[known])
    if slope <= 0:
        return pointmap
    fitted = slope * inverse + offset
    usable = (inverse > 0) & (fitted > 1.0 / (_MAX_DEPTH * np.median(pointmap.depth[known])))
    depth = np.where(usable, 1.0 / np.where(usable, fitted, 1.0), 0.0).astype(np.float32)
    return replace(
        pointmap, depth=depth, confidence=usable.astype(np.float32), normal=compute_depth_normals(depth, pointmap.K)
    )


def _resample_to_image(values: Map, crop: Crop, size: tuple[int, ...]) -> Map:
    """(h, w) at the size of the image that was cropped, from `values` (H, W) of the crop; 0 outside of it."""
    to_network = np.array([[crop.scale, 0, -crop.left], [0, crop.scale, -crop.top]])
    to_network[:, 2] += 0.5 * crop.scale - 0.5  # from centres at whole numbers to such

    def warp(source: Map, interpolation: int, border: int) -> Map:
        flags = interpolation | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(source, to_network, (size[1], size[0]), None, flags, border), np.float32)

    inside = warp(np.ones_like(values), cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)
    return inside * warp(values, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)


def _fit_line(x: Map, y: Map, weights: Map) -> tuple[float, float]:
    """Slope and offset of the line through points x, y (M,), by weighted least absolute deviations."""
    x64, y64, robust = x.astype(np.float64), y.astype(np.float64), weights.astype(np.float64) + 1e-6
    slope, offset = 0.0, float(np.median(y64))
    for _ in range(_ITERATIONS):
        share = robust / robust.sum()
        mean_x, mean_y = share @ x64, share @ y64
        slope = float(share @ ((x64 - mean_x) * (y64 - mean_y)) / max(share @ (x64 - mean_x) ** 2, 1e-18))
        offset = float(mean_y - slope * mean_x)
        robust = (weights + 1e-6) / np.maximum(np.abs(slope * x64 + offset - y64), _MIN_RESIDUAL * np.median(y64))
    return slope, offset


# A network's depth map, up to scale and in a crop, as the point map of a registered camera.


def make_registered_pointmap(
    graph: ViewGraph, registration: Registration, camera: RegisteredCamera, crop: Crop, depth: Map, certainty: Map
) -> Pointmap:
    """The point map from `depth` (H, W) of the network's image, scaled to the registered points that the camera sees.

    `certainty` (H, W) is the network's, from 1 up (DUSt3R's confidence); the point map's is 1 - 1 / certainty. Pixels
    outside the crop are unknown.
    """
    keyframe = graph.keyframes[camera.index]
    K = compute_modelled_K(graph, camera)
    depth = resample_to_modelled(keyframe, crop, depth, unknown=0)
    certainty = resample_to_modelled(keyframe, crop, certainty, unknown=1)
    depth = (depth * _compute_point_scale(registration, camera, keyframe, depth)).astype(np.float32)
    confidence = np.where(depth > 0, 1.0 - 1.0 / np.maximum(certainty, 1.0), 0).astype(np.float32)
    return Pointmap(
        name=keyframe.name,
        frame_id=keyframe.frame.frame_id,
        depth=depth,
        confidence=confidence,
        normal=compute_depth_normals(depth, K),
        T_world_camera=camera.T_world_camera,
        K=K,
    )


def resample_to_modelled(keyframe: Keyframe, crop: Crop, values: Map, *, unknown: float) -> Map:
    """(h, w) at the keyframe's modelled size: the nearest of `values` (H, W) of the network's image; else `unknown`."""
    height, width = keyframe.image.shape[:2]
    step = keyframe.frame.width / width * crop.scale, keyframe.frame.height / height * crop.scale
    u = ((np.arange(width) + 0.5) * step[0] - crop.left - 0.5).astype(np.float32)
    v = ((np.arange(height) + 0.5) * step[1] - crop.top - 0.5).astype(np.float32)
    map_u, map_v = np.meshgrid(u, v)
    border = cv2.BORDER_CONSTANT
    return np.asarray(cv2.remap(values, map_u, map_v, cv2.INTER_NEAREST, None, border, unknown), np.float32)


def _compute_point_scale(registration: Registration, camera: RegisteredCamera, keyframe: Keyframe, depth: Map) -> float:
    """The factor that brings `depth` (h, w) to the registered points' depths, in the median; 1 without such points."""
    there, truth = sample_depth_at_points(registration, camera, keyframe, depth)
    both = (there > 0) & (truth > 0)
    return float(np.median(truth[both] / there[both])) if both.any() else 1.0


def sample_depth_at_points(
    registration: Registration, camera: RegisteredCamera, keyframe: Keyframe, depth: Map
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """(M,) `depth` (h, w) at the pixels where the camera observes registered points; (M,) the points' own depths."""
    points = select_sparse_points(registration, camera, keyframe.scale)
    pixels = np.floor(points.points).astype(np.int64)
    height, width = depth.shape
    inside = ((pixels >= 0) & (pixels < [width, height])).all(1)
    return depth[pixels[inside, 1], pixels[inside, 0]].astype(np.float64), points.depths[inside]
