"""A map of three states for navigation: where rays of confirmed depth passed, where they ended, and what nobody saw.

occupancy_map: a snapshot's cameras and confirmed depths, as a map of three states.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from os import PathLike
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.messaging.messages import Amount, Header, Message, Name, Sequential, Text, WireError
from splatnode.capture.process.text import guard_untrusted, sanitize_text
from splatnode.recon.result.message import Matrix4, ScaleRecord, Vector3, make_scale_record, parse_scale
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot, find_camera_problem
from splatnode.recon.result.verdict import RELATIVE, SURE, FrameName, ReferenceFrame, Scale, find_widest

# Layout: where the voxels of a map lie.

Array = npt.NDArray[np.float64]

PART_OF_DISTANCE = 64  # the default voxel is the median distance of what was seen, divided by this
MOST_VOXELS = 30_000_000  # a byte each, and as much again while they are carved
LONGEST_SIDE = 30_000  # voxels: OctoMap numbers 65536 along each axis, half of them on either side of 0
_OUTLIERS = 1.0  # per cent of the surface at either end of each axis that the map need not reach
_RIM = 2  # voxels around what was seen


@dataclass(frozen=True, eq=False)
class Layout:
    voxel: float
    first: npt.NDArray[np.int64]  # (3,) number of the first voxel along each axis; voxel 0 begins at the map's origin
    shape: tuple[int, int, int]

    @property
    def origin(self) -> Array:
        """(3,) least corner of the first voxel, map frame."""
        return self.first.astype(np.float64) * self.voxel


def choose_layout(points: Array, centres: Array, unit: float, metric: bool, voxel: float | None) -> Layout:
    """Voxels around surface points (M, 3) and cameras (C, 3) in the map's frame; `unit` is the median distance.

    Without a size `voxel`, it is chosen by the distance, and in metres made a round number. Raises ValueError for a
    size that is none, or of which there would be too many.
    """
    low, high = (np.percentile(points, percent, axis=0) for percent in (_OUTLIERS, 100.0 - _OUTLIERS))
    low, high = np.minimum(low, centres.min(0)), np.maximum(high, centres.max(0))
    if voxel is not None:
        voxel = float(voxel)  # files write it as Python does: NumPy's own numbers look otherwise
        if not (np.isfinite(voxel) and voxel > 0):
            raise ValueError(f"a voxel must have a side above 0, got {voxel!r}")
        if _count(low, high, voxel) > MOST_VOXELS or (high - low).max() / voxel > LONGEST_SIDE:
            least = _smallest_voxel(low, high, voxel)
            raise ValueError(
                f"the map would have more than {MOST_VOXELS} voxels of {voxel:g}; give a voxel of at least {least:.3g}"
            )
        return _create_layout(low, high, voxel)
    wanted = unit / PART_OF_DISTANCE
    return _create_layout(low, high, _smallest_voxel(low, high, _round(wanted) if metric else wanted))


def _create_layout(low: Array, high: Array, voxel: float) -> Layout:
    first = np.floor(low / voxel).astype(np.int64) - _RIM
    x, y, z = (np.ceil(high / voxel).astype(np.int64) + _RIM - first).tolist()
    return Layout(voxel, first, (x, y, z))


def _count(low: Array, high: Array, voxel: float) -> float:
    return float(np.prod((high - low) / voxel + 2 * _RIM + 2))


def _smallest_voxel(low: Array, high: Array, voxel: float) -> float:
    """The voxel, doubled until there are not too many."""
    while _count(low, high, voxel) > MOST_VOXELS or (high - low).max() / voxel > LONGEST_SIDE:
        voxel *= 2
    return voxel


def _round(metres: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above `metres`, or hardly."""
    power = 10.0 ** np.floor(np.log10(metres))
    return float(max(step * power for step in (1, 2, 5) if step * power <= 1.01 * metres))


# Sight: what one camera saw at depths that another photograph confirms.

Float32 = npt.NDArray[np.float32]
UNBOUNDED = 0.01  # of a depth: what a camera may be off whose bounds nobody tells, as of one of a merged scene
DEPTH_ERROR = 0.02  # of a depth: as much confirmed depths may differ from each other (recon/priors/__init__.py)


@dataclass(frozen=True, eq=False)
class DepthObservation:
    """Confirmed depths of a camera, and how wrong they may be."""

    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    K: npt.NDArray[np.float64]  # (3, 3) of the depth's pixels
    depth: Float32  # (h, w) z in the camera's frame, 0 where nobody confirms one
    error: float = DEPTH_ERROR  # of a depth, relative: its own, and what the camera's bounds let it be off
    carves: npt.NDArray[np.bool_] | None = (
        None  # (h, w) where it tells free space (`mask_narrow_parallax`); None: everywhere
    )

    @property
    def points(self) -> npt.NDArray[np.float64]:
        """(M, 3) world points of the pixels with a depth."""
        rows, columns = np.nonzero(self.depth)
        z = self.depth[rows, columns]
        x = (columns + 0.5 - self.K[0, 2]) / self.K[0, 0] * z
        y = (rows + 0.5 - self.K[1, 2]) / self.K[1, 1] * z
        in_camera = np.stack([x, y, z], 1)
        return in_camera @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]


def make_depth_observations(
    cameras: Sequence[CameraEstimate], depths: Mapping[str, npt.NDArray[np.float16]]
) -> list[DepthObservation]:
    """Makes the depth observations of cameras with depths. Raises ValueError where a depth does not fit its camera."""
    return [_make_depth_observation(camera, depths[camera.name]) for camera in cameras if camera.name in depths]


def _make_depth_observation(camera: CameraEstimate, depth: npt.NDArray[np.float16]) -> DepthObservation:
    reduction = max(1, round(camera.width / depth.shape[1]))
    if depth.shape != (camera.height // reduction, camera.width // reduction):
        raise ValueError(
            f"the depth of {camera.name} has {depth.shape[1]} x {depth.shape[0]} values, which fits no photograph of "
            f"{camera.width} x {camera.height} pixels: depth.npz is not of these cameras"
        )
    K = np.diag([1 / reduction, 1 / reduction, 1.0]) @ camera.K
    bounds = camera.bounds
    off = UNBOUNDED if bounds is None else bounds.centre_percent / 100.0 + math.radians(bounds.rotation_deg)
    return DepthObservation(camera.T_world_camera, K, depth.astype(np.float32), DEPTH_ERROR + off)


# Which depths tell free space: stereo of two images from nearly the same place is wrong in both alike.

LEAST_PARALLAX_PX = 0.5  # of the photograph, by which DEPTH_ERROR of a depth moves a point in an image that confirms it
_SIZE = 2.0  # pixels of a photograph for one of its depths
_NEAREST = 24  # other cameras that a depth is compared with


def mask_narrow_parallax(seen: Sequence[DepthObservation]) -> list[DepthObservation]:
    """The observations with the depths that tell free space: those that two others confirm, or one from far aside."""
    centres = np.stack([sight.T_world_camera[:3, 3] for sight in seen])
    found = []
    for sight, centre in zip(seen, centres, strict=True):
        apart = np.linalg.norm(centres - centre, axis=1)
        near = np.argsort(apart, kind="stable")[1 : _NEAREST + 1]
        found.append(
            replace(sight, carves=_find_carving_pixels(sight, [seen[i] for i in near[::-1]]))
        )  # far aside first
    return found


def _find_carving_pixels(sight: DepthObservation, others: Sequence[DepthObservation]) -> npt.NDArray[np.bool_]:
    rows, columns = np.nonzero(sight.depth)
    points, carves = sight.points, np.zeros(len(rows), bool)
    count, open_yet = np.zeros(len(rows), np.int64), np.arange(len(rows))
    reach = DEPTH_ERROR * max(sight.K[0, 0], sight.K[1, 1]) * _SIZE
    for other in others:
        if not len(open_yet):
            break
        agrees = _is_confirmed(points[open_yet], other)
        own = open_yet[agrees]
        count[own] += 1
        carves[own] |= count[own] > 1
        here, there = (points[own] - each.T_world_camera[:3, 3] for each in (sight, other))
        lengths = np.linalg.norm(here, axis=1) * np.linalg.norm(there, axis=1)
        sine = np.linalg.norm(np.cross(here, there), axis=1) / np.maximum(lengths, 1e-12)
        carves[own] |= reach * sine >= LEAST_PARALLAX_PX
        open_yet = open_yet[~carves[open_yet]]
    found = np.zeros(sight.depth.shape, bool)
    found[rows, columns] = carves
    return found


def _is_confirmed(points: npt.NDArray[np.float64], other: DepthObservation) -> npt.NDArray[np.bool_]:
    """(M,) whether the other camera has the depth of the world points (M, 3) where it sees them."""
    T = np.linalg.inv(other.T_world_camera)
    x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
    ahead = np.maximum(z, 1e-9)
    column, row = other.K[0, 0] * x / ahead + other.K[0, 2], other.K[1, 1] * y / ahead + other.K[1, 2]
    height, width = other.depth.shape
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    found = np.zeros(len(points), bool)
    there = other.depth[row[inside].astype(np.intp), column[inside].astype(np.intp)]
    found[inside] = np.abs(there - z[inside]) < DEPTH_ERROR * z[inside]
    return found


# Carving: which voxels rays of confirmed depth pass, whole, and well before they end.

Mask = npt.NDArray[np.bool_]

KNOWN_SHARE = 0.8  # of the pixels that a voxel covers: so many must have a confirmed depth, all of them beyond it
STOP_SHORT = 1.0  # voxels by which a ray ends before the surface, beside its uncertainty
_RADII = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)  # pixels, of the squares that voxels are looked up in
_AT_ONCE = 2_000_000  # voxels


def ignore_cancel() -> None:
    """Ignores the check for cancellation, for work that nobody interrupts."""


def carve_free_space(
    sight: DepthObservation,
    layout: Layout,
    T_world_map: npt.NDArray[np.float64],
    pause: Callable[[], None] = ignore_cancel,
) -> Mask:
    """(X, Y, Z) the voxels that the camera looks through; `pause` is called in between, and may raise.

    A voxel is covered by the pixels around its centre that its bounding sphere reaches. Each of them must end beyond
    the sphere, by the depth's uncertainty and a voxel; KNOWN_SHARE of them must have a depth that tells free space.
    """
    limits = _limits(sight, STOP_SHORT * layout.voxel)
    reach = np.float32(np.sqrt(3.0) / 2.0 * layout.voxel)
    T_camera_map = np.linalg.inv(sight.T_world_camera) @ T_world_map
    start = T_camera_map[:3, :3] @ (layout.origin + layout.voxel / 2) + T_camera_map[:3, 3]
    steps = layout.voxel * T_camera_map[:3, :3]
    free = np.zeros(layout.shape, bool)
    rows = max(1, _AT_ONCE // (layout.shape[1] * layout.shape[2]))
    for first in range(0, layout.shape[0], rows):
        pause()
        part = slice(first, min(first + rows, layout.shape[0]))
        free[part] = _carve_block(_coordinates(start, steps, part, layout.shape), sight.K, limits, reach)
    return free


def _coordinates(
    start: npt.NDArray[np.float64], steps: npt.NDArray[np.float64], part: slice, shape: tuple[int, int, int]
) -> tuple[Float32, Float32, Float32]:
    """x, y and z (X', Y, Z) of the voxels' centres in the camera's frame."""
    i, j, k = (np.arange(a, b) for a, b in ((part.start, part.stop), (0, shape[1]), (0, shape[2])))
    along_i, along_j, along_k = (
        (steps[:, axis, None] * number).astype(np.float32) for axis, number in enumerate((i, j, k))
    )
    x, y, z = (
        np.float32(start[row]) + along_i[row][:, None, None] + along_j[row][None, :, None] + along_k[row][None, None, :]
        for row in range(3)
    )
    return x, y, z


def _carve_block(
    centres: tuple[Float32, Float32, Float32], K: npt.NDArray[np.float64], limits: Float32, reach: np.float32
) -> Mask:
    x, y, z = centres
    ahead = np.flatnonzero(z > 2 * reach)
    x, y, z = x.ravel()[ahead], y.ravel()[ahead], z.ravel()[ahead]
    column, row = np.float32(K[0, 0]) * x / z + np.float32(K[0, 2]), np.float32(K[1, 1]) * y / z + np.float32(K[1, 2])
    radius = np.float32(max(K[0, 0], K[1, 1])) * reach / (z - reach) + np.float32(0.5)
    height, width = limits.shape[1:]
    seen = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (radius <= _RADII[-1])
    level = np.searchsorted(np.array(_RADII, np.float32), radius[seen])
    limit = limits[level, row[seen].astype(np.intp), column[seen].astype(np.intp)]
    free = np.zeros(centres[0].size, bool)
    free[ahead[seen]] = limit > z[seen] + reach
    return free.reshape(centres[0].shape)


def _limits(sight: DepthObservation, stop_short: float) -> Float32:
    """(radii, h, w) how far all rays of the square around a pixel pass; 0 where too few of them are known."""
    known = sight.depth > 0
    carves = known if sight.carves is None else sight.carves
    far = np.float32(np.finfo(np.float32).max)
    ends = np.where(known, (1.0 - sight.error) * sight.depth - stop_short, far).astype(np.float32)
    limits = []
    for radius in _RADII:
        window = np.ones((2 * radius + 1,) * 2, np.uint8)
        nearest = cv2.erode(ends, window, borderType=cv2.BORDER_CONSTANT, borderValue=(float(far),))
        share = cv2.blur(carves.astype(np.float32), window.shape, borderType=cv2.BORDER_CONSTANT)
        limits.append(np.where((share >= KNOWN_SHARE - 1e-4) & (nearest < far), nearest, 0.0))
    return np.stack(limits).astype(np.float32)


# The floor: the lowest plane under the cameras that much of what was seen lies on.


TILT = 40.0  # degrees from what the cameras suggest, at most: their mean is off by as much as they look down
TILT_OF_GIVEN = 5.0  # degrees from a direction that was given
THICKNESS = 0.015  # of the distance: points that near to a plane are on it
LEAST_SHARE = 0.08  # of the surface that was seen
MOST_BELOW = 0.02  # of the surface that was seen may lie below the floor
LEAST_BELOW_CAMERAS = 0.1  # of the distance, by which every camera is above it
GIVEN = "given"  # by the user: a direction of up that stays as it is
MOST_LEANING = 1.5  # degrees of a floor in a frame whose z axis is up: 3 m away it is 8 cm off
_TRIALS, _SAMPLE = 4000, 4000
_POLISHED = (1.0, 0.5, 0.5)  # of THICKNESS: what is so near to the plane found so far is what the next is fitted to


@dataclass(frozen=True, eq=False)
class Floor:
    """The plane normal @ p = offset; the normal is up."""

    normal: Array  # (3,)
    offset: float
    share: float  # of the surface that was seen
    tilt_deg: float = math.inf  # standard deviation of the normal, by how far its points spread and how thick they lie

    def compute_leaning_deg(self, up: Array) -> float:
        """Returns the angle between its normal and `up` (3,); 0 where it is so small that both may be the same."""
        angle = float(np.degrees(np.arccos(np.clip(self.normal @ up, -1.0, 1.0))))
        return angle if angle > max(MOST_LEANING, 2.0 * self.tilt_deg) else 0.0

    def height(self, point: Array, up: Array) -> float:
        """How far above the floor a point (3,) is, along `up` (3,)."""
        return float((point @ self.normal - self.offset) / (up @ self.normal))


def find_floor(points: Array, centres: Array, up: Array, unit: float, tilt: float = TILT) -> Floor | None:
    """The floor among surface points (M, 3), `unit` being their median distance from the cameras at `centres` (C, 3).

    It is the plane with most points of those that are level to `tilt` degrees, by `up`, below all cameras, and have
    next to nothing below them. None where no plane is. The points are those of pixels: what is near counts for more.
    """
    rng = np.random.default_rng(0)
    sample = points if len(points) <= _SAMPLE else points[rng.choice(len(points), _SAMPLE, replace=False)]
    if len(sample) < 3:
        return None
    candidates = _planes(sample, rng, up, np.cos(np.radians(tilt)))
    judged = [_validate_floor(normal, offset, sample, centres, unit) for normal, offset in candidates]
    floors = [floor for floor in judged if floor is not None]
    return _refine_floor(max(floors, key=lambda floor: floor.share), sample, centres, unit) if floors else None


def _refine_floor(best: Floor, sample: Array, centres: Array, unit: float) -> Floor:
    """Fitted to all points that are near to it."""
    for part in _POLISHED:
        near = sample[np.abs(sample @ best.normal - best.offset) < part * THICKNESS * unit]
        middle = near.mean(0)
        normal = np.linalg.svd(near - middle, full_matrices=False)[2][2]
        normal = normal * np.sign(normal @ best.normal)
        best = _validate_floor(normal, float(middle @ normal), sample, centres, unit) or best
    return replace(best, tilt_deg=_measure_tilt_deg(best, sample, unit))


def _measure_tilt_deg(floor: Floor, sample: Array, unit: float) -> float:
    """How thick the floor's points lie over how far they reach where they reach least, as an angle.

    However many they are, they count as one: depths beside each other are wrong alike, and bend a floor. A few far
    aside, as where the plane cuts a wall, do not make a strip wide.
    """
    near = sample[np.abs(sample @ floor.normal - floor.offset) < THICKNESS * unit]
    if len(near) < 3:
        return math.inf
    off, axes = near - np.median(near, axis=0), np.linalg.svd(near - near.mean(0), full_matrices=False)[2]
    along = np.linspace(0.0, np.pi, 12, endpoint=False)  # in the plane: where it is narrowest
    ways = np.cos(along)[:, None] * axes[0] + np.sin(along)[:, None] * axes[1]
    low, high = np.percentile(off @ ways.T, (16.0, 84.0), axis=0)
    thick = float(np.std(off @ axes[2]))
    return float(np.degrees(np.arctan2(thick, (high - low).min() / 2.0)))


def _planes(points: Array, rng: np.random.Generator, up: Array, cosine: float) -> list[tuple[Array, float]]:
    """Planes through three of the points that are level, as upward normals and offsets."""
    a, b, c = points[rng.integers(len(points), size=(3, _TRIALS))]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(lengths, 1e-30)[:, None]
    normals *= np.sign(normals @ up)[:, None]
    level = (normals @ up >= cosine) & (lengths > 0)
    return list(zip(normals[level], (a * normals).sum(1)[level].tolist(), strict=True))


def _validate_floor(normal: Array, offset: float, points: Array, centres: Array, unit: float) -> Floor | None:
    """The plane as a floor; None where it cannot be one."""
    if (centres @ normal - offset).min() < LEAST_BELOW_CAMERAS * unit:
        return None
    height = points @ normal - offset
    share, below = float((np.abs(height) < THICKNESS * unit).mean()), float((height < -3 * THICKNESS * unit).mean())
    return Floor(normal, offset, share) if share >= LEAST_SHARE and below <= MOST_BELOW else None


# Upright: the map's frame, whose z axis is up, by the best that tells where up is.

_LEVEL = 3.0  # times as far as along up the cameras' right axes must spread, to tell where up is


@dataclass(frozen=True, eq=False)
class Upright:
    """z up, 0 on the floor, if one was found. x and y are the result's own where its frame has z up.

    Else x is forward of the first camera and y to its left, both level.
    """

    T_world_map: Array  # (4, 4)
    source: str  # of the direction of up, in words
    on_floor: bool  # z = 0 is the floor; else it is the height of the first camera

    @property
    def height(self) -> str:
        """Says what heights count from."""
        return "z = 0 is the floor" if self.on_floor else "no floor was found: z = 0 is the height of the first camera"

    @property
    def is_of_result(self) -> bool:
        """Whether x and y are the result's own, as of a base's, an odometry's or an upright frame."""
        turned = np.abs(self.T_world_map[:3, :3] - np.eye(3)).max() > 1e-9
        return not turned and not self.T_world_map[:2, 3].any()


def make_level_frame(
    Ts_world_camera: Sequence[Array], points: Array, unit: float, frame: ReferenceFrame
) -> Upright | None:
    """The map's frame with the x and y of a result whose frame has z up; None where it has not, or none can tell.

    A base's and an upright frame have, unless a floor leans in it. That of given poses has where a floor is level in
    it. `points` (M, 3) are of surfaces, `unit` is their median distance.
    """
    if frame.name is FrameName.FIRST_CAMERA:
        return None
    z, Ts = np.array([0.0, 0.0, 1.0]), np.stack(Ts_world_camera)
    floor = find_floor(points, Ts[:, :3, 3], z, unit, TILT_OF_GIVEN)
    if floor is None and frame.name is FrameName.ODOMETRY:
        return None
    if floor is not None and floor.compute_leaning_deg(z):
        return None  # z = 0 would be the floor below the first camera alone: obstacles elsewhere would lie in it
    T = np.eye(4)
    T[2, 3] = Ts[0, 2, 3] - (0.0 if floor is None else floor.height(Ts[0, :3, 3], z))
    return Upright(T, f"the z axis of the result's frame, {frame.name.value}", floor is not None)


def upright(
    Ts_world_camera: Sequence[Array], points: Array, given: Array | None, unit: float, source: str = GIVEN
) -> Upright:
    """The frame of a map of surface points (M, 3) that cameras (4, 4) saw from a median distance `unit`.

    `given` (3,) is the direction of up in the world, if gravity or a tracker tells it, as `source` says. Else, or where
    a floor leans in that, it is the normal of the floor, and without one what keeps the cameras level. What a user gave
    stays. Raises ValueError where `given` is no direction.
    """
    Ts = np.stack(Ts_world_camera)
    guess, how = level(Ts)
    if given is not None:
        guess, how = _unit(given), source
    floor = find_floor(points, Ts[:, :3, 3], guess, unit, TILT if given is None else TILT_OF_GIVEN)
    if floor is not None and given is not None and source != GIVEN and (leaning := floor.compute_leaning_deg(guess)):
        guess, how = floor.normal, f"the floor, which leans by {leaning:.1f} degrees by {source}"
    if floor is not None and given is None:
        guess, how = floor.normal, f"the floor, a plane through {100 * floor.share:.0f} % of the surface that was seen"
    return Upright(_frame(Ts[0], guess, floor), how, floor is not None)


def level(Ts_world_camera: Array) -> tuple[Array, str]:
    """(3,) the direction of up that the cameras (C, 4, 4) suggest, and how.

    Cameras are seldom rolled: up is at right angles to their x axes. Where these are all alike, it is the mean of
    the cameras' own up, which is off by as much as they look down.
    """
    mean = _unit(-Ts_world_camera[:, :3, 1].mean(0))
    _, spread, axes = np.linalg.svd(Ts_world_camera[:, :3, 0])
    if len(Ts_world_camera) >= 3 and spread[1] > _LEVEL * spread[2]:
        return axes[2] * np.sign(axes[2] @ mean or 1.0), "the cameras, taken as not rolled in the mean"
    return mean, "the mean up of the cameras"


def _unit(direction: Array) -> Array:
    length = float(np.linalg.norm(direction))
    if np.shape(direction) != (3,) or not np.isfinite(length) or length < 1e-9:
        raise ValueError(f"up must be a direction (3,), not zero, got {np.asarray(direction).tolist()}")
    return np.asarray(direction, np.float64) / length


def _frame(first: Array, up: Array, floor: Floor | None) -> Array:
    """(4, 4) below the first camera on the floor, or at it where there is no floor."""
    forward = first[:3, 2] - (first[:3, 2] @ up) * up
    if np.linalg.norm(forward) < 1e-3:  # it looks straight up or down
        forward = -first[:3, 1] - (-first[:3, 1] @ up) * up
    x = _unit(forward)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(up, x), up], 1)
    height = 0.0 if floor is None else floor.height(first[:3, 3], up)
    T[:3, 3] = first[:3, 3] - height * up
    return T


# OccupancyMap: which parts of a place are free, occupied, or not seen.


class VoxelState(IntEnum):
    """The state of a voxel: free, occupied, or not seen."""

    NOT_SEEN = 0
    FREE = 1  # rays of confirmed depth passed all of it
    OCCUPIED = 2  # a surface that two photographs confirm is in it


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """Cubes of side `voxel` in the map's frame, whose z is up (REP 103).

    Its x and y are the result's where its frame has z up; else x is forward of the first camera and y to its left.
    """

    states: npt.NDArray[np.uint8]  # (X, Y, Z) 0: not seen, 1: free, 2: occupied
    voxel: float  # side of a voxel, in the unit of the result
    origin: npt.NDArray[np.float64]  # (3,) least corner of voxel [0, 0, 0], map frame; whole numbers of voxels
    upright: Upright  # T_world_map, and how the direction of up is known
    scale: Scale = RELATIVE  # the unit of all lengths

    @property
    def T_world_map(self) -> npt.NDArray[np.float64]:
        """(4, 4): p_world = T_world_map @ p_map; the world is that of the result's cameras."""
        return self.upright.T_world_map.copy()

    @property
    def shares(self) -> dict[str, float]:
        """The share of all voxels in each state: `not_seen`, `free`, `occupied`."""
        counts = np.bincount(self.states.ravel(), minlength=len(VoxelState))
        return {state.name.lower(): float(counts[state] / self.states.size) for state in VoxelState}

    def at(self, points: npt.ArrayLike) -> npt.NDArray[np.uint8]:
        """(M,) the states at points (M, 3) of the result's world; NOT_SEEN outside the map.

        Raises ValueError for another shape.
        """
        world = np.asarray(points, np.float64)
        if world.ndim != 2 or world.shape[1] != 3:
            raise ValueError(f"points must be (M, 3), got {world.shape}")
        T = self.upright.T_world_map
        index = np.floor(((world - T[:3, 3]) @ T[:3, :3] - self.origin) / self.voxel)
        inside = np.isfinite(index).all(1) & (index >= 0).all(1) & (index < self.states.shape).all(1)
        found = np.full(len(world), VoxelState.NOT_SEEN, np.uint8)
        found[inside] = self.states[tuple(index[inside].astype(np.intp).T)]
        return found

    def save(
        self, folder: str | PathLike[str], band: Sequence[float] | None = None, *, relative: bool = False
    ) -> list[Path]:
        """Writes occupancy.npz, occupancy.bt, collision.ply and collision.glb; returns what was written.

        With `band`, two heights in the map's frame, also map.pgm and map.yaml for nav2, which takes lengths for metres:
        a map without a unit is written with `relative` alone. Raises ValueError for a band that is none or that the map
        does not reach, or without metres; ResultWriteError where nothing can be written.
        """
        from splatnode.recon.occupancy.files import save  # brings the formats

        return save(self, Path(folder), band, relative)


# Surfaces: which voxels a surface is in that two photographs confirm.

BLUR = 0.008  # of a depth, by which it may well be wrong: nine of ten are better
_FEW = 4_000_000  # voxels, which are counted all at once: faster, and takes 8 bytes each
LEAST_POINTS = 2  # pixels of confirmed depth in a voxel: a single one may be a blend of what is before and behind


def find_surface_voxels(parts: Iterable[npt.NDArray[np.float64]], layout: Layout) -> npt.NDArray[np.bool_]:
    """(X, Y, Z) the voxels with at least LEAST_POINTS of all surface points (M, 3), in the map's frame.

    They come in parts, as of one camera each, so that a map of many cameras takes no more memory than one of a few.
    """
    counts, (_, width, depth) = np.zeros(int(np.prod(layout.shape)), np.int32), layout.shape
    for points in parts:
        index = np.floor(points / layout.voxel).astype(np.int64) - layout.first
        inside = ((index >= 0) & (index < layout.shape)).all(1)
        i, j, k = index[inside].T
        number = (i * width + j) * depth + k
        if len(counts) <= _FEW:
            counts += np.bincount(number, minlength=len(counts)).astype(np.int32)
        else:
            voxels, times = np.unique(number, return_counts=True)
            counts[voxels] += times.astype(np.int32)
    return (counts >= LEAST_POINTS).reshape(layout.shape)


def thicken_points(sight: DepthObservation) -> npt.NDArray[np.float64]:
    """(3 M, 3) world points of a camera: each a little nearer, where it is, and a little farther.

    So a surface beside a voxel's side is in both voxels, as which of them it is in cannot be known.
    """
    centre, points = sight.T_world_camera[:3, 3], sight.points
    return np.concatenate([centre + (1.0 + part) * (points - centre) for part in (-BLUR, 0.0, BLUR)])


UNSURE_DEG = 3.0  # standard deviation of up by gravity, beyond which the floor tells it better
MOST_SAMPLED = 4_000_000  # surface points by which the map is laid out and its floor found; about 80 photographs
LEAST_KNOWN = 0.01  # of the pixels: with fewer confirmed depths there is no map


class NoMap(ValueError):
    """A result has no map; the text says why, and what to do."""

    exit_code = 65


def occupancy_map(
    snapshot: Snapshot,
    voxel: float | None = None,
    up: npt.NDArray[np.float64] | None = None,
    pause: Callable[[], None] = ignore_cancel,
) -> OccupancyMap:
    """The map of what the photographs show at depths that two of them confirm; nothing else makes a voxel known.

    A voxel is free where a camera looks through all of it, and occupied where a confirmed surface is in it, which
    counts for more. `voxel` is its side in the result's unit; None: a 64th of the median depth. `up` (3,) is the
    direction of up in the world; None: gravity tells it, where the snapshot knows it. `pause` is called several times
    a second, and may raise to abandon the work. Raises NoMap, and ValueError for arguments that cannot be used.
    """
    seen = _load_depth_observations(snapshot)
    points, unit = _sample(seen)
    direction, how = _up(snapshot) if up is None else (up, GIVEN)
    Ts = [camera.T_world_camera for camera in snapshot.cameras]
    own = make_level_frame(Ts, points, unit, snapshot.scale.frame) if up is None else None
    frame = own or upright(Ts, points, direction, unit, how)
    T = frame.T_world_map
    centres = np.stack([camera.T_world_camera[:3, 3] for camera in snapshot.cameras])
    layout = choose_layout(
        _transform_to_map(points, T), _transform_to_map(centres, T), unit, snapshot.scale.metric, voxel
    )
    states = np.zeros(layout.shape, np.uint8)
    for sight in mask_narrow_parallax(seen):
        states[carve_free_space(sight, layout, T, pause)] = VoxelState.FREE
    pause()
    states[find_surface_voxels((_transform_to_map(thicken_points(sight), T) for sight in seen), layout)] = (
        VoxelState.OCCUPIED
    )
    return OccupancyMap(states, layout.voxel, layout.origin, frame, snapshot.scale)


def _sample(seen: Sequence[DepthObservation]) -> tuple[npt.NDArray[np.float64], float]:
    """World points (M, 3) of what was seen, all or evenly MOST_SAMPLED of them, and their median depth."""
    each = -(-sum(int(np.count_nonzero(sight.depth)) for sight in seen) // MOST_SAMPLED)
    depths = np.concatenate([sight.depth[sight.depth > 0][::each] for sight in seen])
    return np.concatenate([sight.points[::each] for sight in seen]), float(np.median(depths))


def _up(snapshot: Snapshot) -> tuple[npt.NDArray[np.float64] | None, str]:
    """Returns up by gravity, and its source; none where it is unknown, or too unsure to keep the floor level."""
    up = snapshot.up
    return (None, "") if up is None or up.sigma_deg > UNSURE_DEG else (np.array(up.direction), up.source)


def _transform_to_map(points: npt.NDArray[np.float64], T_world_map: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return (points - T_world_map[:3, 3]) @ T_world_map[:3, :3]


def _load_depth_observations(snapshot: Snapshot) -> list[DepthObservation]:
    """Makes the depth observations of a scene that a map may be made of. Raises NoMap."""
    verdict = snapshot.verdict
    if not verdict.publishable:
        raise NoMap(f"there is no map of a scene that was refused: {verdict.code.value}. {verdict.message}")
    if verdict.code not in SURE and not snapshot.scenes:  # a merged one has depths of its sure scenes alone
        raise NoMap(
            f"the verdict is {verdict.code.value}: the scene can be looked at, but a map of it could call free what is "
            f"solid. {verdict.advice or 'Take more photographs'}"
        )
    if not snapshot.depths:
        raise NoMap(
            "it is not known which depths two photographs confirm: the result has no depth.npz. An earlier splatnode "
            "made it, or it is a scene file, or not final, or merged of scenes that are all known roughly. Reconstruct "
            "the photographs again"
        )
    seen = make_depth_observations(snapshot.cameras, snapshot.depths)
    known = sum(int((sight.depth > 0).sum()) for sight in seen)
    if known < LEAST_KNOWN * sum(sight.depth.size for sight in seen) or not known:
        raise NoMap("next to no depth is confirmed by two photographs: give photographs that share more of the scene")
    return seen


# The map of the present scene as a message; its one array is `states`, as occupancy.npz has it.

Side = Annotated[float, msgspec.Meta(ge=1e-9, le=1e9)]


class ProvisionalRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A map of a scene that grows: how sure its cameras are, and in which world it is."""

    revision: Sequential  # of the scene's world: withdrawn once the heartbeat tells a later one
    views: Sequential  # that it is made of
    rotation_deg: Amount | None  # 95 % bound of its least certain camera; None: nobody tells it
    centre: Amount | None  # likewise, in the unit of the map
    centre_percent: Amount | None  # likewise, of the distance to the scene


class MapRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """An OccupancyMap without its states."""

    scene_sequence: Sequential  # of the message of recon.scene, of this session, that shows the scene of the map
    voxel: Side
    origin: Vector3
    T_world_map: Matrix4  # row by row
    up: Text  # how the direction of up is known
    on_floor: bool  # z = 0 is the floor; else it is the height of the first camera
    scale: ScaleRecord
    provisional: ProvisionalRecord | None = None  # left out where the scene is final

    def __post_init__(self) -> None:
        """Raises ValueError, of which msgspec makes its own error, where the map lies nowhere."""
        why = find_camera_problem(np.array(self.T_world_map).reshape(4, 4), np.eye(3), 1, 1)
        if why:
            raise ValueError(why.replace("T_world_camera", "T_world_map"))


class MapHeader(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The current occupancy map; no array comes where there is no map."""

    scene_id: Name
    why: Text  # there is no map; empty where there is one
    map: MapRecord | None


def encode_map(
    occupancy: OccupancyMap,
    scene_id: str,
    scene_sequence: int,
    numbering: Mapping[str, object],
    provisional: ProvisionalRecord | None = None,
) -> tuple[MapHeader, list[npt.NDArray]]:
    """The header and the array of a map; `numbering` is session, sequence and mono_ns."""
    record = MapRecord(
        scene_sequence=scene_sequence,
        voxel=occupancy.voxel,
        origin=tuple(occupancy.origin.tolist()),
        T_world_map=tuple(occupancy.T_world_map.ravel().tolist()),
        up=sanitize_text(occupancy.upright.source),
        on_floor=occupancy.upright.on_floor,
        scale=make_scale_record(occupancy.scale),
        provisional=provisional,
    )
    header = MapHeader(**numbering, scene_id=scene_id, why="", map=record)  # pyright: ignore[reportArgumentType]
    return header, [occupancy.states]


def make_provisional_record(revision: int, cameras: Sequence[CameraEstimate]) -> ProvisionalRecord:
    """The record of a map that was made of these cameras while their scene grew."""
    widest = find_widest(camera.bounds for camera in cameras if camera.bounds is not None)
    if widest is None:
        return ProvisionalRecord(revision, len(cameras), None, None, None)
    return ProvisionalRecord(revision, len(cameras), widest.rotation_deg, widest.centre, widest.centre_percent)


def no_map(scene_id: str, why: str, numbering: Mapping[str, object]) -> MapHeader:
    """The header that takes the map before it back."""
    return MapHeader(**numbering, scene_id=scene_id, why=sanitize_text(why), map=None)  # pyright: ignore[reportArgumentType]


def decode_map(message: Message[MapHeader]) -> OccupancyMap | None:
    """The map in a message; None where it says that there is none. Raises WireError where its array is no map's."""
    with guard_untrusted(WireError, "a map"):
        record, arrays = message.header.map, message.arrays
        if record is None:
            if arrays:
                raise WireError("a message without a map has no array")
            return None
        if len(arrays) != 1 or arrays[0].ndim != 3 or arrays[0].dtype != np.uint8 or not arrays[0].size:
            raise WireError(f"a map has one array, states (X, Y, Z) uint8; got {[each.shape for each in arrays]}")
        if arrays[0].max() > max(VoxelState):
            raise WireError(f"states must be 0 to {int(max(VoxelState))}, got {int(arrays[0].max())}")
        T_world_map = np.array(record.T_world_map).reshape(4, 4)
        frame = Upright(T_world_map, record.up, record.on_floor)
        return OccupancyMap(arrays[0], record.voxel, np.array(record.origin), frame, parse_scale(record.scale))
