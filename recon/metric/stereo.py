"""The unit by rectified stereo pairs of known baseline: how far the scene's points move between the two pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import folder
from splatnode.capture.frame import Baseline, DroppedFrame, Frame, grey, partners, reduce_image
from splatnode.capture.lenses import undistort_frame
from splatnode.capture.process.text import format_length
from splatnode.recon.keyframes import REFERENCE_SIDE
from splatnode.recon.metric.measurement import Measurement, MetricView, compute_scale_sigma
from splatnode.recon.networks.vit import Crop
from splatnode.recon.registration import subpixel
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import CameraEstimate, Landmarks, Snapshot

# Stereo pairs: photographs of a second camera, to the right of the first, of which both pictures are rectified.

Grey = npt.NDArray[np.uint8]  # (H, W)

_LONGEST_SIDE = 1280  # pixels that are compared at least, where a photograph has them


@dataclass(frozen=True, eq=False)
class StereoPair:
    """A stereo pair: two grey images of one size, taken at once, without the given distortion."""

    photograph: str
    left: Grey
    right: Grey
    baseline: Baseline | None = None  # that came with it; None: as it is configured for all


def make_pairs(
    frames: Sequence[Frame | DroppedFrame], rights: Iterable[Frame | DroppedFrame]
) -> tuple[StereoPair, ...]:
    """The pairs of frames and right photographs of the same name, whatever their suffixes.

    Raises ValueError where none has a partner, or a partner is of another size.
    """
    lefts = {each.name: each for each in frames if isinstance(each, Frame)}
    seen = {each.name: each for each in rights if isinstance(each, Frame)}
    return tuple(_pair(lefts[left], seen[right]) for left, right in partners(list(lefts), list(seen)).items())


def make_own_pair(frame: Frame) -> StereoPair | None:
    """The frame and the right image that came with it; None where none did. Raises ValueError for a folded lens."""
    straight = undistort_frame(frame)
    if straight.right is None:
        return None
    right = straight.right
    return StereoPair(frame.name, _convert_to_grey(straight.image), _convert_to_grey(right.image), right.baseline)


def stream_right_images(path: Path, frames: Sequence[Frame | DroppedFrame]) -> Iterator[Frame | DroppedFrame]:
    """The photographs in the folder that are partners of the frames. Raises FileNotFoundError, ValueError."""
    names = partners([each.name for each in frames], folder.names_in(path)).values()
    return folder.stream(folder.Config(folder=path, names=tuple(names)))


def _pair(left: Frame, right: Frame) -> StereoPair:
    """A right camera has the lens of the left one: that is what rectifying means."""
    if (right.width, right.height) != (left.width, left.height):
        raise ValueError(
            f"both photographs of a pair must have one size: {left.name} has {left.width} x {left.height} pixels, "
            f"its partner {right.width} x {right.height}"
        )
    partner = undistort_frame(replace(right, intrinsics=left.intrinsics))
    return StereoPair(left.name, _convert_to_grey(undistort_frame(left).image), _convert_to_grey(partner.image))


def _convert_to_grey(image: npt.NDArray[np.uint8]) -> Grey:
    """The picture (H, W, 3) or (H, W) as it is compared with its partner."""
    return grey(reduce_image(image, _LONGEST_SIDE))


Array = npt.NDArray[np.float64]

_PATCHES = subpixel.PatchAlignmentConfig(radius=6)
_LEAST_CORRELATION, _MOST_SIGMA_PX = 0.85, 0.25  # of a patch with what it was aligned to
_MOST_BACK_PX = 0.5  # between a point and where it comes from there and back
_LEAST_POINTS = 30
_MOST_ROWS_PX = 1.0  # median difference of rows: beyond, the pair is not rectified
_SHIFT_SIGMA_PX, _MOST_SIGMAS = 0.1, 4.0  # by which the principal points of a rectified pair differ still
_FREE_PX = 1e3  # where they may differ by anything
_POINTS_AS_ONE = 10.0  # neighbours are wrong alike
_ROUNDS, _HUBER = 10, 1.5  # of the robust fit; standard deviations


@dataclass(frozen=True, eq=False)
class _Disparities:
    """Points that both pictures of a pair show, M of them. Lengths in a picture are rays at depth 1."""

    depths: Array  # (M,) in the scene's unit
    across: Array  # (M,) left less right, along the rows
    down: Array  # (M,) left less right
    px: float  # of the reference size, in rays


def estimate_scale_from_stereo(
    views: Mapping[str, MetricView],
    landmarks: Landmarks | None,
    pairs: Sequence[StereoPair],
    baseline_m: float,
    sigma_m: float,
) -> Measurement | str:
    """The unit, or a sentence why the pairs do not give it.

    `baseline_m` is between the two cameras and `sigma_m` its standard deviation, metres. Rows are compared first.
    Pairs of which there is no view, or which the landmarks do not know, do not count: the scene that is shown and the
    newest estimate, whose landmarks they are, need not have the same cameras.
    """
    name = f"stereo pairs with {format_length(baseline_m)} between the cameras"
    if landmarks is None:
        return f"{name} were given, and the scene has no points to compare with"
    pairs = [each for each in pairs if each.photograph in views and each.photograph in landmarks.names]
    seen = [_measure_disparities(views[each.photograph], landmarks, each) for each in pairs]
    seen = [each for each in seen if len(each.depths)]
    count = sum(len(each.depths) for each in seen)
    if count < _LEAST_POINTS:
        return f"{name} were given, and their pictures share {count} points of the scene; {_LEAST_POINTS} are needed"
    rows_px = float(np.median(np.concatenate([np.abs(each.down / each.px) for each in seen])))
    if rows_px > _MOST_ROWS_PX:
        return f"{name} are not rectified: what both see is {rows_px:.1f} pixels higher in one than in the other"
    across_px = np.concatenate([each.across / each.px for each in seen])
    if np.median(across_px) < 0.0:
        return f"{name} have left and right exchanged: the photographs of the scene must be the left camera's"
    px = np.concatenate([np.full(len(each.depths), each.px) for each in seen])
    nearness = 1.0 / (np.concatenate([each.depths for each in seen]) * px)
    free = _fit_line(nearness, across_px, _FREE_PX)
    if abs(free.shift) > _MOST_SIGMAS * math.hypot(free.shift_sigma, _SHIFT_SIGMA_PX):
        return (
            f"{name} are not rectified: what is far away moves by {free.shift:.1f} pixels between them; the principal "
            "points of both must be the same"
        )
    line = _fit_line(nearness, across_px, _SHIFT_SIGMA_PX)
    of_scene = compute_scale_sigma(list(views.values()))  # all fix the depths of the points, whichever have a partner
    sigma = math.hypot(line.log_sigma, of_scene, sigma_m / baseline_m)
    return Measurement(baseline_m / line.slope, sigma, f"{len(seen)} {name}")


def _measure_disparities(view: MetricView, landmarks: Landmarks, pair: StereoPair) -> _Disparities:
    """The scene's points that the photograph shows, found in its partner to parts of a pixel."""
    height, width = pair.left.shape
    number = landmarks.names.index(pair.photograph)
    points = landmarks.points[np.unique(landmarks.point_of[landmarks.photograph_of == number])]
    depths = ((points - view.centre) @ view.T_world_camera[:3, :3])[:, 2]
    left = view.project(points, width, height)
    margin = _PATCHES.radius + 1.0
    inside = (depths > 0) & (left > margin).all(1) & (left < np.array([width, height]) - margin).all(1)
    left, depths = left[inside], depths[inside]
    right, found = _track_points(pair, left)
    rays = view.unproject(left[found], width, height), view.unproject(right[found], width, height)
    across, down = (rays[0] - rays[1]).T
    return _Disparities(depths[found], across, down, 1.0 / (REFERENCE_SIDE * view.focal))


def _track_points(pair: StereoPair, left: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Pixels (M, 2) in the right picture of pixels in the left one, and which of them were found (M,)."""
    if not len(left):
        return left, np.zeros(0, bool)
    start = np.ascontiguousarray(left - 0.5, np.float32)[:, None]
    there, ahead, _ = cv2.calcOpticalFlowPyrLK(pair.left, pair.right, start, None, winSize=(15, 15), maxLevel=4)  # type: ignore[call-overload]
    back, behind, _ = cv2.calcOpticalFlowPyrLK(pair.right, pair.left, there, None, winSize=(15, 15), maxLevel=4)  # type: ignore[call-overload]
    same = np.linalg.norm((back - start)[:, 0], axis=1) < _MOST_BACK_PX
    first = np.zeros(len(left), np.int64)
    guess = np.asarray(there[:, 0] + 0.5, np.float64)
    patches = subpixel.Patches(first, left, first + 1, guess, np.tile(np.eye(2), (len(left), 1, 1)))
    grey = [np.asarray(each, np.float32) for each in (pair.left, pair.right)]
    aligned = subpixel.align(grey, patches, _PATCHES)
    good = (aligned.correlation > _LEAST_CORRELATION) & (aligned.sigma < _MOST_SIGMA_PX)
    near = np.linalg.norm(aligned.target - guess, axis=1) < 2.0
    return aligned.target, same & good & near & (ahead.ravel() > 0) & (behind.ravel() > 0)


@dataclass(frozen=True)
class _Line:
    slope: float
    shift: float  # pixels
    log_sigma: float  # standard deviation of the slope's logarithm
    shift_sigma: float  # of the shift, pixels


def _fit_line(nearness: Array, across: Array, held: float) -> _Line:
    """The line of `across` (M,) over `nearness` (M,), robust (Huber's weights).

    The shift is held near 0 with the standard deviation `held`, pixels.
    """
    columns = np.stack([nearness, np.ones_like(nearness)], 1)
    values, covariance = np.array([float(np.median(across / nearness)), 0.0]), np.eye(2)
    for _ in range(_ROUNDS):
        off = np.abs(across - columns @ values)
        noise = max(1.48 * float(np.median(off)), 1e-3)
        weights = np.clip(_HUBER * noise / np.maximum(off, 1e-12), 0.0, 1.0) / noise**2 / _POINTS_AS_ONE
        covariance = np.linalg.inv(columns.T @ (weights[:, None] * columns) + np.diag([0.0, held**-2]))
        values = covariance @ (columns.T @ (weights * across))
    slope, sigmas = float(values[0]), np.sqrt(np.diag(covariance))
    return _Line(slope, float(values[1]), float(sigmas[0]) / abs(slope), float(sigmas[1]))


# The unit by a network that knows rooms: it tells the depth of photographs in metres.

Map = npt.NDArray[np.float32]
_VIEWS = 6  # that the network is asked about
_OPAQUE = 0.9
_ENOUGH = 0.1  # of a view's pixels
_MOST_SPREAD = 0.3  # between views: beyond, the network does not know this place


@dataclass(frozen=True)
class MetricDepth:
    """A network that tells the depth of photographs in metres."""

    name: str
    depth: Callable[[npt.NDArray[np.uint8]], tuple[Map, Crop]]  # image (h, w, 3) -> metres (H, W), and their crop


def estimate_scale_from_network(snapshot: Snapshot, network: MetricDepth, sigma: float) -> Measurement | str:
    """The unit, or a sentence why the network does not give it: its views disagree, or show too little.

    `sigma` is the standard deviation, as a share, of an error that all views of a place have alike.
    """
    step = -(-len(snapshot.cameras) // _VIEWS)
    ratios = [_measure_ratio(snapshot, camera, network) for camera in snapshot.cameras[::step]]
    logs = np.log([ratio for ratio in ratios if ratio is not None])
    if not len(logs):
        return f"{network.name} was asked, and no view shows enough of the scene to compare"
    spread = float(np.exp(1.48 * np.median(np.abs(logs - np.median(logs)))) - 1.0)
    if spread > _MOST_SPREAD:
        return f"{network.name} was asked, and its {len(logs)} views disagree by {100 * spread:.0f} %"
    source = f"{network.name}, {len(logs)} views that agree to {100 * spread:.0f} %"
    return Measurement(float(np.exp(np.median(logs))), math.hypot(sigma, spread / math.sqrt(len(logs))), source)


def _measure_ratio(snapshot: Snapshot, camera: CameraEstimate, network: MetricDepth) -> float | None:
    """Metres by scene unit in the median of a view's pixels; None where too few can be compared."""
    metres, crop = network.depth(snapshot.images[camera.name])
    shape = camera.T_world_camera, camera.K, camera.width, camera.height
    picture = render_arrays(snapshot.gaussians, *shape, channels=("depth", "alpha"))
    rows, columns = np.mgrid[: crop.height, : crop.width]
    there = np.floor(crop.map_to_image(np.stack([columns, rows], -1) + 0.5)).astype(np.int64)
    depth, alpha = (channel[there[..., 1], there[..., 0]] for channel in (picture.depth, picture.alpha))
    both = (alpha > _OPAQUE) & (depth > 0) & (metres > 0)
    return float(np.median(metres[both] / depth[both])) if both.mean() > _ENOUGH else None
