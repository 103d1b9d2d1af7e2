"""What a person wants to know of the Gaussians: support and advice, and the colours that show it.

It takes longer than a picture, and is worked out beside the window for the moment that is shown.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.limits import SH_C0, select_gaussians
from splatnode.recon.result.placement import matrices_from_quats
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, decode_frame_id
from splatnode.viewer.state import Colouring, Moment, look_at, scene_up, transform_to_camera

# Which cameras see which Gaussian: how well a surface is supported, and from where it was seen best.

_LONGER_SIDE = 160  # pixels of the depth images that tell what is hidden
_BEHIND = 1.05  # a Gaussian this many times as far as the surface that a camera sees there is hidden from it


@dataclass(frozen=True, eq=False)
class Support:
    sizes: npt.NDArray[np.float32]  # (N, C) how large camera C sees the Gaussian, pixels a world unit; 0: not at all

    @property
    def views(self) -> npt.NDArray[np.intp]:
        """(N,) the number of cameras that see the Gaussian."""
        return (self.sizes > 0).sum(1)

    @property
    def best(self) -> npt.NDArray[np.intp]:
        """(N,) the index of the camera that sees it largest; -1: none does."""
        if not self.sizes.shape[1]:
            return np.full(len(self.sizes), -1)
        return np.where(self.sizes.any(1), self.sizes.argmax(1), -1)


def support(gaussians: GaussianArrays, cameras: tuple[CameraEstimate, ...]) -> Support:
    """For each Gaussian, the cameras whose image shows its centre unhidden."""
    sizes = np.zeros((len(gaussians), len(cameras)), np.float32)
    for index, camera in enumerate(cameras if len(gaussians) else ()):
        sizes[:, index] = compute_apparent_sizes(gaussians, camera)
    return Support(sizes)


def compute_apparent_sizes(gaussians: GaussianArrays, camera: CameraEstimate) -> npt.NDArray[np.float64]:
    """(N,) how large the camera sees each Gaussian, in pixels a world unit; 0 where it does not see it."""
    scale = min(1.0, _LONGER_SIDE / max(camera.width, camera.height))
    width, height = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
    K = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    T_camera_world = np.linalg.inv(camera.T_world_camera)
    points = transform_to_camera(gaussians.means, T_camera_world)
    depth = points[:, 2]
    ahead = depth > 1e-3
    pixels = points[:, :2] / np.where(ahead, depth, 1.0)[:, None] * K[[0, 1], [0, 1]] + K[:2, 2]
    inside = ahead & (pixels >= 0).all(1) & (pixels < [width, height]).all(1)
    rendered = render_arrays(gaussians, camera.T_world_camera, K, width, height, channels=("depth",))
    columns, rows = pixels[inside].astype(np.int64).T
    surface = np.where(rendered.alpha > 0.5, rendered.depth, np.inf)[rows, columns]
    result = np.zeros(len(gaussians))
    result[inside] = np.where(depth[inside] <= _BEHIND * surface, camera.K[0, 0] / depth[inside], 0.0)
    return result


Array32 = npt.NDArray[np.float32]

UNKNOWN = (0.35, 0.35, 0.35)
_SUPPORT = np.array([UNKNOWN, (0.85, 0.2, 0.15), (0.95, 0.6, 0.1), (0.85, 0.85, 0.2), (0.2, 0.75, 0.3)], np.float32)
_GOLDEN = 0.61803398875  # steps around the circle of hues that stay far apart, however many there are


def colour_gaussians(moment: Moment, colouring: Colouring, support: Support) -> GaussianArrays:
    """The Gaussians in the colours of `colouring`; what is unknown is grey."""
    gaussians = moment.snapshot.gaussians
    if colouring is Colouring.PHOTOGRAPH:
        return gaussians
    rgb = {
        Colouring.DEPTH: _colour_by_depth,
        Colouring.NORMAL: _colour_by_normal,
        Colouring.SUPPORT: _colour_by_support,
        Colouring.SOURCE: _colour_by_source,
    }[colouring](moment, support)
    return replace(gaussians, sh=((rgb[:, None] - 0.5) / SH_C0).astype(np.float32))


def normals(gaussians: GaussianArrays, centre: npt.NDArray[np.float64]) -> Array32:
    """(N, 3) the direction in which each Gaussian is thinnest, on the side of `centre`."""
    axes = matrices_from_quats(gaussians.quats)
    normal = axes[np.arange(len(gaussians)), :, gaussians.scales.argmin(1)]
    away = ((gaussians.means - centre) * normal).sum(1) > 0
    return np.where(away[:, None], -normal, normal).astype(np.float32)


def source_colour(index: int) -> tuple[float, float, float]:
    """RGB of the camera at `index`: as different from its neighbours' as can be."""
    hue = round(180 * (index * _GOLDEN % 1.0)) % 180
    ((red, green, blue),) = cv2.cvtColor(np.array([[[hue, 190, 235]]], np.uint8), cv2.COLOR_HSV2RGB)[0] / 255.0
    return float(red), float(green), float(blue)


def camera_colours(cameras: Sequence[CameraEstimate]) -> list[tuple[float, float, float]]:
    """RGB of each camera: of several ones by their ids, in the order of these; of one camera each view has its own."""
    ids = sorted({camera.camera_id for camera in cameras})
    if ids in ([], [""]):
        return [source_colour(index) for index in range(len(cameras))]
    return [source_colour(ids.index(camera.camera_id)) for camera in cameras]


def mean_camera_centre(cameras: Sequence[CameraEstimate]) -> npt.NDArray[np.float64]:
    """(3,) the mean of the cameras' centres; the origin without any."""
    return np.mean([camera.T_world_camera[:3, 3] for camera in cameras], axis=0) if cameras else np.zeros(3)


def _colour_by_depth(moment: Moment, _support: Support) -> Array32:
    """Colours by inverse distance from the mean camera centre, as images resolve inverse depth."""
    means = moment.snapshot.gaussians.means
    if not len(means):
        return np.zeros((0, 3), np.float32)
    nearness = 1.0 / np.maximum(np.linalg.norm(means - mean_camera_centre(moment.snapshot.cameras), axis=1), 1e-6)
    low, high = np.percentile(nearness, [2, 98])
    levels = np.rint(255 * np.clip((nearness - low) / max(high - low, 1e-9), 0, 1)).astype(np.uint8)
    return cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1].astype(np.float32) / 255


def _colour_by_normal(moment: Moment, _support: Support) -> Array32:
    snapshot = moment.snapshot
    return 0.5 + 0.5 * normals(snapshot.gaussians, mean_camera_centre(snapshot.cameras)) * np.array(
        [1, -1, -1], np.float32
    )


def _colour_by_support(_moment: Moment, support: Support) -> Array32:
    return _SUPPORT[np.minimum(support.views, len(_SUPPORT) - 1)]


def _colour_by_source(moment: Moment, support: Support) -> Array32:
    """Colours by the frame that started a Gaussian; in a file, without these, by the camera that sees it largest."""
    snapshot = moment.snapshot
    palette = np.array([*(source_colour(index) for index in range(len(snapshot.cameras))), UNKNOWN], np.float32)
    if not len(snapshot.gaussians) or not (decode_frame_id(snapshot.gaussians.source_frame) >= 0).any():
        return palette[support.best]
    index_of = {camera.frame_id: index for index, camera in enumerate(snapshot.cameras)}
    frames, inverse = np.unique(decode_frame_id(snapshot.gaussians.source_frame), return_inverse=True)
    return palette[np.array([index_of.get(int(frame), -1) for frame in frames])][inverse]


# Where to take the next photograph: the move that would show the most that is not yet well known.

Array = npt.NDArray[np.float64]

GOOD_ANGLE_DEG = 12.0  # between two rays to a point: wider adds little to its depth, and matches fail
GOOD_ANGLE = math.radians(GOOD_ANGLE_DEG)
GOOD_VIEWS = 3  # two confirm each other, the third tells which is wrong
ENOUGH = 0.03  # a gain below this is not worth a photograph
MIN_OVERLAP = 0.5  # part of the points that a new view must share with old ones to be placed among them
_MIN_SHOWN = 0.2  # part of all points that a new view must show: less is a glance at the scene's edge
_MIN_FACING = 0.2  # cosine between a surface's normal and the ray to it: flatter, it is seen edge-on
_STEPS = tuple(math.radians(degrees) for degrees in (8.0, 16.0, 24.0))  # around the scene, from a camera
_TURNS = {
    "to the right": (1.0, 0.0),
    "to the left": (-1.0, 0.0),
    "up": (0.0, 1.0),
    "down": (0.0, -1.0),
}


@dataclass(frozen=True, eq=False)
class Advice:
    sentence: str
    arrow: tuple[Array, Array] | None  # from a camera's centre to where the next one should be, (3,) each
    target: Array | None  # (3,) where that one should look
    gain: float  # 0: nothing to gain; 1: everything was unknown


@dataclass(frozen=True, eq=False)
class Points:
    """M points on the surfaces of the scene."""

    positions: Array  # (M, 3)
    normals: Array  # (M, 3) unit, towards where they were seen from
    seen_by: npt.NDArray[np.bool_]  # (M, C) by which cameras


def surface_points(
    gaussians: GaussianArrays, cameras: tuple[CameraEstimate, ...], support: Support, most: int = 1500
) -> Points:
    """At most `most` Gaussians, evenly spread over those that any camera sees, as points."""
    visible = np.flatnonzero(support.views > 0)
    chosen = visible[:: max(1, math.ceil(len(visible) / most))]
    return Points(
        positions=gaussians.means[chosen].astype(np.float64),
        normals=normals(select_gaussians(gaussians, chosen), mean_camera_centre(cameras)).astype(np.float64),
        seen_by=support.sizes[chosen] > 0,
    )


@dataclass(frozen=True, eq=False)
class _Move:
    base: CameraEstimate
    centre: Array
    turn: str
    angle: float
    parallax: float  # mean gain of the points' angles, in parts of GOOD_ANGLE
    coverage: float  # mean gain of their number of views, in parts of GOOD_VIEWS

    @property
    def gain(self) -> float:
        return (self.parallax + self.coverage) / 2.0


def next_view(cameras: tuple[CameraEstimate, ...], points: Points) -> Advice:
    """The best of the moves around the scene from each camera, by what it adds to the points' angles and views.

    A point gains parallax when it is seen under a wider angle than before, up to GOOD_ANGLE, and coverage when it has
    fewer than GOOD_VIEWS. A new view shows a point that is inside its image and turned towards it; what hides what is
    not looked at. Moves that would lose touch with the known views are not offered. What no photograph shows has no
    points and cannot be asked for.
    """
    if not cameras or not len(points.positions):
        return Advice("No camera is placed yet: take photographs that overlap, with a step to the side.", None, None, 0)
    sight = _measure_viewing_angles(cameras, points)
    moves = [move for camera in cameras for move in _moves(camera, cameras, points, sight)]
    best = max(moves, key=lambda move: (round(move.gain, 3), move.base.frame_id), default=None)
    if best is None or best.gain < ENOUGH:
        return Advice("The scene is covered well: more photographs from around here would add little.", None, None, 0)
    pivot = _pivot(best.base, points, cameras)
    return Advice(_describe_move(best, points, sight), (best.base.T_world_camera[:3, 3], best.centre), pivot, best.gain)


@dataclass(frozen=True, eq=False)
class _ViewingAngles:
    """How the cameras see the points."""

    rays: Array  # (C, M, 3) unit, from each camera to each point
    angles: Array  # (M,) the widest between two cameras that see the point; 0 where fewer than two do


def _measure_viewing_angles(cameras: tuple[CameraEstimate, ...], points: Points) -> _ViewingAngles:
    rays = np.stack([_rays(points, camera.T_world_camera[:3, 3]) for camera in cameras])
    angles = np.zeros(len(points.positions))
    for index, ray in enumerate(rays):
        to_others = _angles_to(ray, rays, points)
        angles = np.maximum(angles, np.where(points.seen_by[:, index], to_others, 0.0))
    return _ViewingAngles(rays, angles)


def _moves(
    camera: CameraEstimate, cameras: tuple[CameraEstimate, ...], points: Points, sight: _ViewingAngles
) -> list[_Move]:
    up = scene_up(cameras)
    pivot = _pivot(camera, points, cameras)
    angles, views = sight.angles, points.seen_by.sum(1)
    moves = []
    for turn, (right, upwards) in _TURNS.items():
        for step in _STEPS:
            centre = _orbit_camera(camera, pivot, up, right * step, upwards * step)
            shown = _find_visible_points(camera, look_at(centre, pivot, up), points)
            if shown.sum() == 0 or (views[shown] > 0).mean() < MIN_OVERLAP or shown.mean() < _MIN_SHOWN:
                continue
            wider = np.where(shown, np.maximum(angles, _angles_to(_rays(points, centre), sight.rays, points)), angles)
            parallax = (np.minimum(wider, GOOD_ANGLE) - np.minimum(angles, GOOD_ANGLE)).mean() / GOOD_ANGLE
            coverage = (np.minimum(views + shown, GOOD_VIEWS) - np.minimum(views, GOOD_VIEWS)).mean() / GOOD_VIEWS
            moves.append(_Move(camera, centre, turn, step, float(parallax), float(coverage)))
    return moves


def _orbit_camera(camera: CameraEstimate, pivot: Array, up: Array, right: float, upwards: float) -> Array:
    """The camera's centre after a walk around the pivot by angles, to its own right or upwards."""
    offset = camera.T_world_camera[:3, 3] - pivot
    distance = float(np.linalg.norm(offset))
    sideways = np.cross(-offset / distance, up)
    sideways /= max(float(np.linalg.norm(sideways)), 1e-9)
    over = np.cross(sideways, -offset / distance)
    direction = math.cos(right) * math.cos(upwards) * offset / distance
    direction = direction + math.sin(right) * sideways + math.sin(upwards) * over
    return pivot + distance * direction / float(np.linalg.norm(direction))


def _pivot(camera: CameraEstimate, points: Points, cameras: tuple[CameraEstimate, ...]) -> Array:
    """The point ahead of the camera at the median depth of what it sees."""
    mine = points.seen_by[:, next(i for i, other in enumerate(cameras) if other is camera)]
    centre, forward = camera.T_world_camera[:3, 3], camera.T_world_camera[:3, 2]
    depths = (points.positions[mine] - centre) @ forward
    return centre + (float(np.median(depths)) if len(depths) else 1.0) * forward


def _find_visible_points(lens: CameraEstimate, T_world_camera: Array, points: Points) -> npt.NDArray[np.bool_]:
    """(M,) points inside the image that `lens` would take from there, on surfaces turned towards it."""
    offsets = points.positions - T_world_camera[:3, 3]
    local = offsets @ T_world_camera[:3, :3]
    ahead = local[:, 2] > 1e-3
    pixels = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None] * lens.K[[0, 1], [0, 1]] + lens.K[:2, 2]
    facing = -(offsets * points.normals).sum(1) > _MIN_FACING * np.linalg.norm(offsets, axis=1)
    return ahead & facing & (pixels >= 0).all(1) & (pixels < [lens.width, lens.height]).all(1)


def _rays(points: Points, centre: Array) -> Array:
    offsets = points.positions - centre
    return offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)


def _angles_to(ray: Array, rays: Array, points: Points) -> Array:
    """(M,) the widest angle between the point's `ray` (M, 3) and one of a camera that sees it; 0 where none does."""
    cosines = np.einsum("cmi,mi->cm", rays, ray)
    return np.arccos(np.clip(np.where(points.seen_by.T, cosines, 1.0).min(0), -1.0, 1.0))


def _describe_move(move: _Move, points: Points, sight: _ViewingAngles) -> str:
    distance = 2.0 * math.sin(move.angle / 2.0)
    where = f"From {move.base.name} move {move.turn} by {distance:.0%} of the distance to the scene"
    if move.parallax >= move.coverage:
        narrow = float((sight.angles < GOOD_ANGLE).mean())
        return (
            f"{where}, look at the same place: {narrow:.0%} of it is seen under less than {GOOD_ANGLE_DEG:.0f}° so far."
        )
    few = float((points.seen_by.sum(1) < GOOD_VIEWS).mean())
    return f"{where}, look at the same place: {few:.0%} of it has fewer than {GOOD_VIEWS} views."


@dataclass(frozen=True, eq=False)
class Analysis:
    moment: Moment
    support: Support
    advice: Advice


def analyse(moment: Moment) -> Analysis:
    """Which cameras see what, and where the next one should be."""
    snapshot = moment.snapshot
    supported = support(snapshot.gaussians, snapshot.cameras)
    points = surface_points(snapshot.gaussians, snapshot.cameras, supported)
    return Analysis(moment, supported, next_view(snapshot.cameras, points))


class Analyst:
    """Works on one moment at a time, always the one asked for last. The answer to an older question is dropped."""

    def __init__(self) -> None:
        self._asked: Moment | None = None
        self._done: Analysis | None = None
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="analyst", daemon=True)
        self._thread.start()

    def request_analysis(self, moment: Moment) -> Analysis | None:
        """The analysis of `moment`; None while it is not ready. Never waits."""
        with self._changed:
            if self._done is not None and self._done.moment is moment:
                return self._done
            if self._asked is not moment:
                self._asked = moment
                self._changed.notify()
            return None

    def close(self) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._is_pending())
                if self._closing or self._asked is None:
                    return
                moment = self._asked
            analysis = analyse(moment)
            with self._changed:
                self._done = analysis

    def _is_pending(self) -> bool:
        return self._asked is not None and (self._done is None or self._done.moment is not self._asked)
