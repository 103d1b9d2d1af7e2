"""All losses beside the photometric one together (equation 13), each with its weight at its time.

Point rendering, which some of them take: each pixel blends the colours of the nearest points, and is white where there
are none.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import msgspec
import numpy as np
import numpy.typing as npt
import torch
from scipy.linalg import expm, logm
from torch import Tensor

from splatnode.capture.process.config import Internal
from splatnode.recon.networks.depth_anything import load_relative
from splatnode.recon.optimize.losses import Evaluate, Loss, LossChoice, Schedule
from splatnode.recon.priors import Pointmap, fit_monocular_depth
from splatnode.recon.rasterize import Camera
from splatnode.recon.rasterize.reference import Render
from splatnode.recon.scene import TrainingView

# Pseudo views: cameras where no photograph was taken, between the training views.

_SHARES = (0.15, 0.85)  # of the motion between two training views, within which a pseudo view lies

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PseudoView:
    """A camera between two training views, or beside the path that joins them."""

    T_world_camera: Float64  # (4, 4)
    K: Float64  # (3, 3)
    width: int
    height: int
    nearest: int  # index of the training view it is closest to

    @property
    def camera(self) -> Camera:
        """The same in float32 tensors, to render it."""
        return Camera(
            torch.from_numpy(self.T_world_camera).float(), torch.from_numpy(self.K).float(), self.width, self.height
        )


def interpolate(T_start: Float64, T_end: Float64, share: float) -> Float64:
    """(4, 4) camera at `share` of the screw motion from one camera (4, 4) to another: a geodesic of SE(3)."""
    motion = np.real(logm(np.linalg.inv(T_start) @ T_end))
    moved = T_start @ expm(share * motion)
    u, _, vt = np.linalg.svd(moved[:3, :3])  # logm's rounding would let the rotation drift
    moved[:3, :3] = u @ vt
    return moved


def order_cameras(Ts_world_camera: Sequence[Float64]) -> list[int]:
    """The order that visits all cameras in small steps: the shortest of the greedy paths from each of them."""
    centres = np.array([T[:3, 3] for T in Ts_world_camera])
    steps = np.linalg.norm(centres[:, None] - centres[None], axis=-1)

    def greedy(start: int) -> list[int]:
        order, left = [start], set(range(len(centres))) - {start}
        while left:
            order.append(min(left, key=lambda candidate: (steps[order[-1], candidate], candidate)))
            left.remove(order[-1])
        return order

    def length(order: list[int]) -> float:
        return float(sum(steps[a, b] for a, b in pairwise(order)))

    return min((greedy(start) for start in range(len(centres))), key=length)


def pseudo_views(
    Ts_world_camera: Sequence[Float64],
    Ks: Sequence[Float64],
    sizes: Sequence[tuple[int, int]],
    count: int,
    *,
    off_path: float,
    rng: np.random.Generator,
) -> list[PseudoView]:
    """`count` cameras, spread over the steps of the path through C >= 2 training cameras.

    Each lies at a random share between two neighbours, and then beside their path by a random part of up to `off_path`
    of their distance, in the image plane of the camera there. K and size (width, height) are those of the nearer one.
    """
    if len(Ts_world_camera) < 2:
        raise ValueError(
            f"pseudo views lie between training cameras: at least 2 are needed, got {len(Ts_world_camera)}"
        )
    order = order_cameras(Ts_world_camera)
    steps = list(pairwise(order))
    views = []
    for index in range(count):
        start, end = steps[index % len(steps)]
        share = float(rng.uniform(*_SHARES))
        T_world_camera = interpolate(Ts_world_camera[start], Ts_world_camera[end], share)
        distance = float(np.linalg.norm(Ts_world_camera[end][:3, 3] - Ts_world_camera[start][:3, 3]))
        aside = rng.uniform(-off_path, off_path, 2) * distance
        T_world_camera[:3, 3] += T_world_camera[:3, :2] @ aside
        nearest = start if share < 0.5 else end
        views.append(PseudoView(T_world_camera, Ks[nearest], *sizes[nearest], nearest))
    return views


def sample_pseudo_views(
    cameras: Sequence[Camera | TrainingView], count: int, *, off_path: float, rng: np.random.Generator
) -> list[PseudoView]:
    """`count` pseudo views between these cameras, as `pseudo_views` spreads them; none between fewer than two."""
    if len(cameras) < 2:
        return []
    return pseudo_views(
        [camera.T_world_camera.double().numpy() for camera in cameras],
        [camera.K.double().numpy() for camera in cameras],
        [(camera.width, camera.height) for camera in cameras],
        count,
        off_path=off_path,
        rng=rng,
    )


Array = npt.NDArray[np.float32]
_DISTANCE_STEPS = 2**16  # into which distances are quantised, so that pixel and distance sort by one integer key
_MIN_DEPTH = 1e-6  # z of a point in front of the camera


@dataclass(frozen=True, eq=False)
class PointRender:
    """The points as a camera sees them; `seen` says where there are any."""

    rgb: Array  # (H, W, 3) in [0, 1], white where nothing is seen
    depth: Array  # (H, W) z in the camera frame of the frontmost point, 0 where nothing is seen
    normal: Array  # (H, W, 3) camera frame, unit length, facing the camera, 0 where nothing is seen
    seen: npt.NDArray[np.bool_]  # (H, W)


def render_points(
    points: Array,  # (M, 3) world
    colours: Array,  # (M, 3) in [0, 1]
    normals: Array,  # (M, 3) world, unit length
    T_world_camera: npt.NDArray[np.float64],  # (4, 4)
    K: npt.NDArray[np.float64],  # (3, 3)
    width: int,
    height: int,
    *,
    nearest: int = 8,  # K
    radius: float = 1.5,  # pixels
    same_surface: float = 0.02,  # share of the depth
) -> PointRender:
    """The point-rendered image of equation 6.

    A point is a candidate for the pixels whose centres lie within `radius` pixels of its projection. Of a pixel's
    candidates those count that lie on the frontmost surface (z at most `same_surface` behind the first, relatively):
    a surface hides what is behind it. The `nearest` K of them by image distance d are blended with weights
    exp(-d) / sum of exp(-d). Points seen from behind are left out.
    """
    to_camera = np.linalg.inv(T_world_camera).astype(np.float32)
    in_camera = points @ to_camera[:3, :3].T + to_camera[:3, 3]
    turned = normals @ to_camera[:3, :3].T
    in_front = (in_camera[:, 2] > _MIN_DEPTH) & ((turned * in_camera).sum(1) <= 0)
    index = np.flatnonzero(in_front)
    z = in_camera[index, 2]
    u = in_camera[index, 0] / z * np.float32(K[0, 0]) + np.float32(K[0, 2])
    v = in_camera[index, 1] / z * np.float32(K[1, 1]) + np.float32(K[1, 2])
    visible = (np.abs(u - 0.5 * width) < 0.5 * width + radius) & (np.abs(v - 0.5 * height) < 0.5 * height + radius)
    index, z, u, v = index[visible], z[visible], u[visible], v[visible]

    pixel, point, distance = _candidates(u, v, width, height, radius)
    depth = np.full(height * width, np.inf, np.float32)
    np.minimum.at(depth, pixel, z[point])
    front = z[point] <= depth[pixel] * (1 + same_surface)
    pixel, point, distance = pixel[front], point[front], distance[front]
    order = np.argsort(pixel * _DISTANCE_STEPS + (distance * (_DISTANCE_STEPS / (radius + 1.0))).astype(np.int64))
    pixel, point, distance = pixel[order], point[order], distance[order]
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    rank = np.arange(len(pixel)) - np.repeat(first, np.diff(first, append=len(pixel)))
    chosen = rank < nearest
    pixel, point, weight = pixel[chosen], index[point[chosen]], np.exp(-distance[chosen])

    total = np.bincount(pixel, weight, height * width)
    seen = total > 0

    def blend_values(values: Array) -> Array:
        sums = [np.bincount(pixel, weight * values[point, k], height * width) for k in range(3)]
        return (np.stack(sums, 1) / np.where(seen, total, 1.0)[:, None]).astype(np.float32)

    rgb = np.where(seen[:, None], blend_values(colours), np.float32(1.0))
    normal = blend_values(turned)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return PointRender(
        rgb=rgb.reshape(height, width, 3),
        depth=np.where(seen, depth, 0).astype(np.float32).reshape(height, width),
        normal=np.where(seen[:, None], normal, 0).reshape(height, width, 3),
        seen=seen.reshape(height, width),
    )


def _candidates(
    u: Array, v: Array, width: int, height: int, radius: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Array]:
    """(pixel, point, distance) of every pixel centre within `radius` of a projection (u, v), each of shape (C,)."""
    reach = int(np.ceil(radius - 0.5))
    columns = [_find_neighbour_pixels(u, step, width) for step in range(-reach, reach + 1)]
    rows = [_find_neighbour_pixels(v, step, height) for step in range(-reach, reach + 1)]
    pixels, members, distances = [], [], []
    for y, vertical, in_rows in rows:
        for x, horizontal, in_columns in columns:
            squared = vertical + horizontal
            inside = np.flatnonzero((squared <= radius * radius) & in_rows & in_columns)
            pixels.append(y[inside] * width + x[inside])
            members.append(inside)
            distances.append(np.sqrt(squared[inside]))
    return np.concatenate(pixels), np.concatenate(members), np.concatenate(distances)


def _find_neighbour_pixels(
    at: Array, step: int, size: int
) -> tuple[npt.NDArray[np.int64], Array, npt.NDArray[np.bool_]]:
    """The pixels `step` beside those at (C,) along one axis, the squared distances of their centres, if they exist."""
    pixel = np.floor(at).astype(np.int64) + step
    return pixel, (pixel.astype(np.float32) + np.float32(0.5) - at) ** 2, (pixel >= 0) & (pixel < size)


# What is known of training views and pseudo views beside the photographs: targets that losses compare renders with.


@dataclass(frozen=True, eq=False)
class SurfaceTarget:
    """The depth and the normals of a view, where they are known."""

    depth: Tensor  # (H, W) z in the camera frame
    normal: Tensor  # (H, W, 3) camera frame, unit length, facing the camera
    weights: Tensor  # (H, W) in [0, 1], 0 where nothing is known


@dataclass(frozen=True, eq=False)
class Supervision:
    """Targets of the C training views and the V pseudo views; each kind is computed when a loss first asks for it."""

    images: Sequence[npt.NDArray[np.uint8]]  # C photographs (H, W, 3) RGB at modelled size
    pointmaps: Sequence[Pointmap]  # of the same C views
    pseudo_views: Sequence[PseudoView]  # V of them
    nearest_points: int  # that are blended in a pixel of a point render
    min_confidence: float  # of a point or a depth that is used
    # C masks (H, W): False where a photograph does not show the scene; None: all of them do everywhere
    shown: Sequence[npt.NDArray[np.bool_]] | None = None

    @cached_property
    def surfaces(self) -> tuple[SurfaceTarget, ...]:
        """Returns the training views' surfaces: of a monocular network where there is one, else of point maps."""
        return tuple(_make_pointmap_target(pointmap, self.min_confidence) for pointmap in self._depth_targets[0])

    @property
    def depth_source(self) -> str:
        """Returns the source of the depths of `surfaces`, for the report."""
        return self._depth_targets[1]

    @cached_property
    def point_renders(self) -> tuple[PointRender, ...]:
        """Renders the point cloud of all point maps from each pseudo view."""
        if not self.pseudo_views:
            return ()
        cloud = _cloud(self.pointmaps, self.images, self.min_confidence)
        return tuple(
            render_points(*cloud, view.T_world_camera, view.K, view.width, view.height, nearest=self.nearest_points)
            for view in self.pseudo_views
        )

    @cached_property
    def pseudo_surfaces(self) -> tuple[SurfaceTarget, ...]:
        """Returns the surfaces of the pseudo views: depth and normals of the point renders."""
        return tuple(_make_point_target(shown) for shown in self.point_renders)

    @cached_property
    def _depth_targets(self) -> tuple[Sequence[Pointmap], str]:
        """The point maps with a monocular network's depth, except in views that contradict it, and the source."""
        network = load_relative()
        if network is None:
            return self.pointmaps, "multi-view depth"
        pairs = list(zip(self.pointmaps, self.images, strict=True))
        completed = [fit_monocular_depth(pointmap, image, network) for pointmap, image in pairs]
        changed = sum(new is not old for new, (old, _) in zip(completed, pairs, strict=True))
        if self.shown is not None:  # a network sees depth in what a mask hides, too
            completed = [pointmap.apply_mask(shown) for pointmap, shown in zip(completed, self.shown, strict=True)]
        source = f"depth of {network.name} (in {changed} of {len(pairs)} views, scaled by multi-view depth)"
        return completed, source


def resample_target(target: Tensor, render: Tensor) -> Tensor:
    """`target` (h, w, ...) sampled at the pixels of `render` (H, W, ...), which has the same view at another size."""
    if target.shape == render.shape:
        return target
    rows, columns = (
        ((torch.arange(size) + 0.5) * full / size).long()
        for size, full in zip(render.shape[:2], target.shape[:2], strict=True)
    )
    return target[rows][:, columns]


def _cloud(
    pointmaps: Sequence[Pointmap], images: Sequence[npt.NDArray[np.uint8]], min_confidence: float
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Points (M, 3), colours (M, 3) and world normals (M, 3) of all confident pixels."""
    points, colours, normals = [], [], []
    for pointmap, image in zip(pointmaps, images, strict=True):
        confident = (pointmap.confidence >= min_confidence) & (pointmap.depth > 0)
        points.append(pointmap.points[confident])
        colours.append(image[confident].astype(np.float32) / 255.0)
        normals.append((pointmap.normal[confident] @ pointmap.T_world_camera[:3, :3].T).astype(np.float32))
    return np.concatenate(points), np.concatenate(colours), np.concatenate(normals)


def _make_pointmap_target(pointmap: Pointmap, min_confidence: float) -> SurfaceTarget:
    confident = (pointmap.confidence >= min_confidence) & (pointmap.depth > 0)
    weights = np.where(confident, pointmap.confidence, 0).astype(np.float32)
    return SurfaceTarget(*(torch.from_numpy(array) for array in (pointmap.depth, pointmap.normal, weights)))


def _make_point_target(shown: PointRender) -> SurfaceTarget:
    weights = shown.seen.astype(np.float32)
    return SurfaceTarget(*(torch.from_numpy(array) for array in (shown.depth, shown.normal, weights)))


class RegularizerConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The losses, and what they share: pseudo views, and the points and depths that are trusted.

    Pseudo views have the full size: with half of it sceaux lost .29 dB, .005 SSIM and .016 LPIPS, because Gaussians of
    a pixel look different there.
    """

    losses: Mapping[str, LossChoice] = {}  # by names of your own, which the report uses; a weight of 0 costs nothing
    pseudo_views: Internal[int] = 12  # how many views between the cameras are drawn for losses that need them
    # Largest distance of these from the cameras' path, in distances of neighbouring cameras
    off_path: Internal[float] = 0.1
    nearest_points: Internal[int] = 8  # points that are blended in a pixel (K of equation 6)
    # Least confidence of the points that are rendered and of the depths that are compared
    min_confidence: Internal[float] = 0.3

    @property
    def active_losses(self) -> dict[str, LossChoice]:
        """The losses whose weight is not 0."""
        return {name: choice for name, choice in self.losses.items() if choice.config.weight}


class Regularizer:
    """The losses of one refinement; it draws the pseudo view of each iteration."""

    def __init__(
        self,
        pointmaps: Sequence[Pointmap],
        images: Sequence[npt.NDArray[np.uint8]],
        config: RegularizerConfig,
        *,
        seed: int,
        shown: Sequence[npt.NDArray[np.bool_]] | None = None,
    ) -> None:
        """`pointmaps` and `images` (h, w, 3) RGB are of the training views, in the order of `training_loss`.

        `shown` (h, w) are False where these photographs do not show the scene: what a network tells there is not used.
        """
        self._rng = np.random.default_rng(seed)
        self._pseudo_views = _sample_pseudo_views(pointmaps, config, self._rng)
        supervision = Supervision(
            images, pointmaps, self._pseudo_views, config.nearest_points, config.min_confidence, shown
        )
        losses = {
            name: choice.module.prepare(choice.config, supervision, seed)
            for name, choice in config.active_losses.items()
        }
        self._losses: list[tuple[Schedule, Loss]] = [
            (config.losses[name].config, loss) for name, loss in losses.items() if _is_usable(loss)
        ]
        self.served_by = {name: loss.served_by for name, loss in losses.items()}

    def channels(self, progress: float) -> tuple[str, ...]:
        """Returns the channels to render at this progress in [0, 1]: colours, and what active losses compare."""
        compared = [
            channel for schedule, loss in self._losses if schedule.weight_at(progress) for channel in loss.channels
        ]
        return tuple(dict.fromkeys(("rgb", *compared)))

    def training_loss(self, index: int, render: Render, progress: float) -> Tensor | None:
        """The losses on training view `index` (equation 11), weighted; None while none is active."""
        return _sum_losses(self._active(progress, lambda loss: loss.on_training_view), index, render)

    def pseudo_loss(self, draw: Callable[[PseudoView, Collection[str]], Render], progress: float) -> Tensor | None:
        """The losses on a random pseudo view, as `draw` renders its channels, weighted; None while none is active."""
        active = self._active(progress, lambda loss: loss.on_pseudo_view)
        if not self._pseudo_views or not active:
            return None
        index = int(self._rng.integers(len(self._pseudo_views)))
        return _sum_losses(active, index, draw(self._pseudo_views[index], self.channels(progress)))

    def _active(self, progress: float, function: Callable[[Loss], Evaluate | None]) -> list[tuple[float, Evaluate]]:
        """Weight and `function` of each loss that has it and counts at this progress."""
        found = [(schedule.weight_at(progress), function(loss)) for schedule, loss in self._losses]
        return [(weight, evaluate) for weight, evaluate in found if weight and evaluate is not None]


def _sum_losses(active: Sequence[tuple[float, Evaluate]], index: int, render: Render) -> Tensor | None:
    parts = [weight * evaluate(index, render) for weight, evaluate in active]
    return torch.stack(parts).sum() if parts else None


def _is_usable(loss: Loss) -> bool:
    return loss.on_training_view is not None or loss.on_pseudo_view is not None


def _sample_pseudo_views(
    pointmaps: Sequence[Pointmap], config: RegularizerConfig, rng: np.random.Generator
) -> list[PseudoView]:
    """The pseudo views; none between fewer than two cameras."""
    if len(pointmaps) < 2:
        return []
    return pseudo_views(
        [pointmap.T_world_camera for pointmap in pointmaps],
        [pointmap.K for pointmap in pointmaps],
        [(pointmap.depth.shape[1], pointmap.depth.shape[0]) for pointmap in pointmaps],
        config.pseudo_views,
        off_path=config.off_path,
        rng=rng,
    )
