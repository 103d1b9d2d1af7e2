"""The built-in building: a robot's keyframes of a long walk through rooms and a corridor, made one by one.

The walk comes back to its rooms, walks the corridor both ways, and passes a mirror, two rooms that look alike, a chair
that is moved between two visits, and a few keyframes of blank wall. The photographs carry no intrinsics, as those of an
unknown camera do. What is known is for tests and benchmarks: scene_camera, held_out_camera, depth and shared_surface.
The place is made by splatnode.extras.building; this file photographs it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama import Camera, Matrix, Solid, colour_pixels, look_at, trace
from splatnode.capture.frame import Clock, DroppedFrame, Frame, FramesPerSecond, Pace, Stamp, pace_frames
from splatnode.capture.process.config import Internal
from splatnode.extras.building import (
    CHAIR_ROOM,
    CORRIDOR,
    DOORS,
    LENGTH,
    MIRROR_ROOM,
    ZONES,
    Door,
    doors_of,
    interior,
    zones_at,
)

# The walk by keyframes: where the camera is at each, and which room is toured when.

# The walk as a line on the floor plan: tours of rooms, joined by the corridor, without corners.

Array = npt.NDArray[np.float64]

STEP = 0.02  # metres between two points of a line
ROUNDING = 0.28  # metres: standard deviation of the window that rounds corners
TURNING = 0.30  # the same of the window that smooths where the camera looks
RADII = (1.3, 1.1)  # metres, of the tour of a room, along x and y
INWARDS = 62.0  # degrees that the camera is turned from the way to the room's middle
BLANK_END = -1  # in place of a room: the walk goes to the corridor's blank end and turns round
FIRST_ROOMS = (0, 3, 0, 2, 4, 3, BLANK_END, 1, 5, 2, 4, 1, 0, 5, BLANK_END, 3)  # then as the seed says


@dataclass(frozen=True)
class Line:
    """Points of the walk, `STEP` apart; where the camera looks there; and the room tours' first and last points."""

    xy: Array  # (P, 2) metres
    yaw: Array  # (P,) radians, unwrapped; 0 along x, pi / 2 along y
    visits: tuple[tuple[int, int, int], ...]  # room, first and last point


def rooms_of(seed: int, legs: int) -> list[int]:
    """Which room is toured on each leg."""
    rng = np.random.default_rng([seed, 51])
    rooms: list[int] = [*FIRST_ROOMS]
    while len(rooms) < legs:
        follower = int(rng.integers(-1, len(DOORS)))
        if follower != rooms[-1]:
            rooms.append(follower)
    return rooms[:legs]


def line(seed: int, legs: int) -> Line:
    """The walk of so many legs. A longer one begins with the same points, but for the last metre."""
    parts: list[tuple[Array, Array]] = []  # points, and the camera's turn from the way
    visits: list[tuple[int, int, int]] = []
    times: dict[int, int] = {}
    total = 0
    for room in rooms_of(seed, legs):
        times[room] = times.get(room, 0) + 1
        counterclockwise = times[room] % 3 != 2 or room == FIRST_ROOMS[0]
        way = _resample(_blank_end() if room == BLANK_END else _tour(room, counterclockwise, first=not parts))
        if parts:
            between = _resample(np.stack([parts[-1][0][-1], way[0]]))
            parts.append((between, np.zeros(len(between))))
            total += len(between)
        turn = np.zeros(len(way)) if room == BLANK_END else _compute_gaze_degrees(room, way, counterclockwise)
        parts.append((way, turn))
        if room != BLANK_END:
            visits.append((room, total, total + len(way) - 1))
        total += len(way)
    xy = _smooth(np.concatenate([points for points, _ in parts]), ROUNDING)
    heading = np.unwrap(np.arctan2(*np.gradient(xy, axis=0).T[::-1]))
    turn = np.concatenate([turn for _, turn in parts])
    yaw = _smooth(heading + np.radians(turn), TURNING)
    return Line(xy, yaw, tuple(visits))


def _tour(room: int, counterclockwise: bool, first: bool) -> Array:
    """(P, 2) corners: from the corridor into the room, around its middle, and out."""
    door, (x, y) = DOORS[room], ZONES[room].centre
    inside = np.array([door.x, door.outer + 0.5 * door.side])
    ends = (-100.0, 175.0) if counterclockwise else (-130.0, -380.0)
    angles = np.radians(np.linspace(*ends, 56))
    around = np.stack([x + door.side * RADII[0] * np.cos(angles), y + door.side * RADII[1] * np.sin(angles)], 1)
    corridor = np.array([door.x, 0.0])
    return np.concatenate([*([] if first else [corridor[None], inside[None]]), around, inside[None], corridor[None]])


def _compute_gaze_degrees(room: int, way: Array, counterclockwise: bool) -> Array:
    """(P,) degrees: to the middle of the room while the way goes around it."""
    deep = np.abs(way[:, 1]) > abs(DOORS[room].outer) + 0.7
    return np.where(deep, INWARDS if counterclockwise else -INWARDS, 0.0)


def _blank_end() -> Array:
    """(P, 2) along one side of the corridor to its blank end, a half circle, and back along the other side."""
    x = LENGTH - 1.3
    angles = np.radians(np.linspace(-90, 90, 19))
    turn = np.stack([x + 0.42 * np.cos(angles), 0.42 * np.sin(angles)], 1)
    return np.concatenate([[[x - 1.5, -0.42]], turn, [[x - 1.5, 0.42]]])


def _resample(corners: Array) -> Array:
    """Points `STEP` apart on the line through `corners`, from the first one on."""
    lengths = np.concatenate([[0.0], np.linalg.norm(np.diff(corners, axis=0), axis=1).cumsum()])
    along = np.arange(0.0, max(lengths[-1], STEP), STEP)
    return np.stack([np.interp(along, lengths, corners[:, axis]) for axis in (0, 1)], 1)


def _smooth(values: Array, sigma: float) -> Array:
    """Values (P,) or (P, n) under a Gaussian window of `sigma` metres; the ends are continued."""
    reach = round(3.5 * sigma / STEP)
    window = np.exp(-0.5 * (np.arange(-reach, reach + 1) * STEP / sigma) ** 2)
    columns = values.reshape(len(values), -1).T
    smooth = [np.convolve(np.pad(column, reach, mode="edge"), window / window.sum(), "valid") for column in columns]
    return np.stack(smooth, 1).reshape(values.shape)


FARTHEST_STEP = 0.36  # metres from keyframe to keyframe on a straight way
WIDEST_TURN = 11.0  # degrees from keyframe to keyframe where the camera only turns
HEIGHT = 1.25  # metres, of the camera
FEWEST_A_LEG = 30  # keyframes: fewer no leg has


@dataclass(frozen=True)
class Visit:
    """A tour of a room: its first and last position, in keyframes."""

    room: int
    first: float
    last: float


@dataclass(frozen=True, eq=False)
class Walk:
    """`positions` (P,) count keyframes along the points of the line, `xy` (P, 2) metres, `yaw` (P,) radians."""

    positions: Array
    xy: Array
    yaw: Array
    visits: tuple[Visit, ...]
    phases: Array  # (6,) of the camera's sway

    def T_world_camera(self, position: float) -> Matrix:
        """(4, 4) of the camera at a position, also between keyframes. Height, tilt and roll sway a little."""
        x, y, yaw = (float(np.interp(position, self.positions, v)) for v in (*self.xy.T, self.yaw))
        sway = np.sin(self.phases + position * np.array([0.61, 0.83, 0.47, 0.97, 0.71, 0.39]))
        yaw += np.radians(1.5) * sway[0]
        tilt = np.radians(-5.0 + 2.0 * sway[1])
        centre = np.array([x, y, HEIGHT + 0.05 * sway[2] + 0.03 * sway[3]])
        forward = np.array([np.cos(tilt) * np.cos(yaw), np.cos(tilt) * np.sin(yaw), np.sin(tilt)])
        return look_at(centre, centre + forward, roll_deg=1.2 * float(sway[4]))

    def visit_at(self, position: float) -> Visit | None:
        """The tour during which a position comes."""
        return next((visit for visit in self.visits if visit.first <= position <= visit.last), None)


def walk(seed: int, keyframes: int) -> Walk:
    """A walk of at least so many keyframes. The seed alone decides where keyframe n is taken."""
    return _make_walk(seed, 8 + keyframes // FEWEST_A_LEG // 8 * 8)


@lru_cache(maxsize=4)
def _make_walk(seed: int, legs: int) -> Walk:
    ways = line(seed, legs)
    steps = np.linalg.norm(np.diff(ways.xy, axis=0), axis=1) / FARTHEST_STEP
    turns = np.abs(np.diff(ways.yaw)) / np.radians(WIDEST_TURN)
    positions = np.concatenate([[0.0], np.hypot(steps, turns).cumsum()])
    visits = tuple(Visit(room, float(positions[a]), float(positions[b])) for room, a, b in ways.visits)
    end = len(positions) - round(2.0 / STEP)  # the last metres depend on where the line ends
    phases = np.random.default_rng([seed, 52]).uniform(0, 2 * np.pi, 6)
    return Walk(positions[:end], ways.xy[:end], ways.yaw[:end], visits, phases)


# Which zones a camera can see: its own, and what lies behind the doors in its field of view.

ROLLED = 0.04  # of the slope, by which roll moves what is seen at the upper and lower rim
MARGIN = 1.15  # of the field of view: the camera is tilted and rolled a little
NEAR = 0.02  # metres; what of a door is closer to the camera's plane is cut off

Slopes = tuple[float, float]  # x / z of the leftmost and of the rightmost ray, in the camera's frame


def visible_zones(camera: Camera, width: int, behind: int | None = None) -> dict[int, slice]:
    """The zones that can be seen, by number, each with the image's columns in which it can be.

    `behind`: of a mirrored camera, the zone in which its rays begin.
    """
    T_world_camera, K = camera
    half = MARGIN * width / 2 / float(K[0, 0])
    x, y = T_world_camera[:2, 3]
    seen: dict[int, Slopes] = {}
    for zone in zones_at(float(x), float(y)) if behind is None else (behind,):
        _collect_zones(T_world_camera, zone, (-half, half), seen, None)
    return {zone: _columns(seen[zone], K, width) for zone in sorted(seen)}


def _columns(slopes: Slopes, K: Matrix, width: int) -> slice:
    """The columns of rays with such slopes, with a margin for the camera's tilt and roll."""
    low, high = (sign * (abs(slope) * (MARGIN - 1) + ROLLED) for sign, slope in zip((-1, 1), slopes, strict=True))
    ends = (K[0, 0] * (slope + wider) + K[0, 2] for slope, wider in zip(slopes, (low, high), strict=True))
    left, right = (int(np.clip(end, 0, width)) for end in ends)
    return slice(left, min(right + 1, width))


def find_visible_spheres(spheres: Matrix, camera: Camera, columns: slice, height: int) -> npt.NDArray[np.bool_]:
    """(S,) whether spheres (S, 4), centre and radius in the world, reach into so many rows and these columns."""
    T_world_camera, K = camera
    x, y, z = T_world_camera[:3, :3].T @ (spheres[:, :3] - T_world_camera[:3, 3]).T
    radius, inside = spheres[:, 3], z > -spheres[:, 3]
    bounds = (x, columns.start, columns.stop, K[0]), (y, 0, height, K[1])
    for along, first, last, row in bounds:
        focal, centre = row[row != 0][0], row[2]
        low, high = (first - centre) / focal, (last - centre) / focal
        inside &= along - low * z > -radius * np.hypot(1, low)
        inside &= along - high * z < radius * np.hypot(1, high)
    return inside


def _collect_zones(
    T_world_camera: Matrix, zone: int, slopes: Slopes, seen: dict[int, Slopes], through: Door | None
) -> None:
    known = seen.get(zone, slopes)
    seen[zone] = min(known[0], slopes[0]), max(known[1], slopes[1])
    for door in doors_of(zone):
        if door is through:
            continue
        narrowed = _clip_to_door(T_world_camera, door, zone, slopes)
        if narrowed is not None:
            _collect_zones(T_world_camera, door.room if zone == CORRIDOR else CORRIDOR, narrowed, seen, door)


def _clip_to_door(T_world_camera: Matrix, door: Door, zone: int, slopes: Slopes) -> Slopes | None:
    """The rays of `slopes` that pass a door from `zone`; None where there is none."""
    y = door.inner if zone == CORRIDOR else door.outer
    ends = np.array([[x, y] for x in door.span]) - T_world_camera[:2, 3]
    right, forward = T_world_camera[:2, 0], T_world_camera[:2, 2]
    right, forward = right / np.linalg.norm(right), forward / np.linalg.norm(forward)
    (x_a, z_a), (x_b, z_b) = ((float(end @ right), float(end @ forward)) for end in ends)
    if max(z_a, z_b) < NEAR:
        return None
    if min(z_a, z_b) < NEAR:
        share = (NEAR - z_a) / (z_b - z_a)
        cut = x_a + share * (x_b - x_a), NEAR
        (x_a, z_a), (x_b, z_b) = ((x_a, z_a), cut) if z_a > z_b else (cut, (x_b, z_b))
    low, high = sorted((x_a / z_a, x_b / z_b))
    low, high = max(low, slopes[0]), min(high, slopes[1])
    return (low, high) if low < high else None


# What a camera in the building sees: colours and depth, with what the mirror reflects.

SILVER = 0.93  # of the light that the mirror gives back


@dataclass(frozen=True)
class BuildingState:
    """A building at one moment."""

    seed: int
    density: float  # texels a metre
    chair: int  # where the chair stands


@dataclass(frozen=True)
class VisibleSolids:
    """The solids that may be seen, and each one's columns of the image; the mirror's index among them."""

    solids: list[Solid]
    columns: list[slice]
    mirror: int | None


def view(state: BuildingState, camera: Camera, width: int, height: int) -> npt.NDArray[np.float32]:
    """(H, W, 3) 8-bit colours."""
    sight = _collect_visible_solids(state, camera, width, height)
    z, nearest = trace(sight.solids, camera, width, height, columns=sight.columns)
    colours = colour_pixels(sight.solids, camera, z, nearest)
    if sight.mirror is not None and (nearest == sight.mirror).any():
        glass = np.where(nearest == sight.mirror, z, np.inf)
        _reflect(state, sight.solids[sight.mirror], camera, glass, colours)
    return colours


def render_depth(state: BuildingState, camera: Camera, width: int, height: int) -> npt.NDArray[np.float32]:
    """(H, W) z of the nearest surface in the camera's frame, metres; of the mirror, that of its glass."""
    sight = _collect_visible_solids(state, camera, width, height)
    return trace(sight.solids, camera, width, height, columns=sight.columns)[0]


def _collect_visible_solids(
    state: BuildingState, camera: Camera, width: int, height: int, behind: int | None = None
) -> VisibleSolids:
    """Collects the solids that `camera` may see; `behind`: the zone in which the rays of a mirrored camera begin."""
    solids: list[Solid] = []
    columns: list[slice] = []
    mirror = None
    for number, part in visible_zones(camera, width, behind).items():
        zone = interior(state.seed, state.density, number)
        near = find_visible_spheres(zone.spheres, camera, part, height)
        for index in np.flatnonzero(near):
            mirror = len(solids) if index == zone.mirror else mirror
            solids.append(zone.solids[index])
        solids += zone.chairs[state.chair] if number == CHAIR_ROOM else ()
        columns += [part] * (len(solids) - len(columns))
    return VisibleSolids(solids, columns, mirror)


def mirror_camera(mirror: Solid, camera: Camera) -> Camera:
    """The camera on the other side of the mirror's face; its frame is left-handed. A pixel's z stays the same."""
    T_world_camera, K = camera
    normal = mirror.axes[:, 1] / np.linalg.norm(mirror.axes[:, 1])
    turned = np.eye(4)
    turned[:3, :3] -= 2 * np.outer(normal, normal)
    turned[:3, 3] = 2 * (normal @ (mirror.centre + mirror.axes[:, 1])) * normal
    return turned @ T_world_camera, K


def _reflect(
    state: BuildingState,
    mirror: Solid,
    camera: Camera,
    glass: npt.NDArray[np.floating],
    colours: npt.NDArray[np.float32],
) -> None:
    """Paints what the mirror shows into `colours`, where `glass` (H, W), the mirror's z, is finite."""
    shown = np.isfinite(glass)
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    T_world_camera, K = mirror_camera(mirror, camera)
    shift = np.array([[1.0, 0.0, -columns[0]], [0.0, 1.0, -rows[0]], [0.0, 0.0, 1.0]])
    height, width = glass[part].shape
    virtual = T_world_camera, shift @ K
    solids = _collect_visible_solids(state, (T_world_camera, K), colours.shape[1], colours.shape[0], MIRROR_ROOM).solids
    z, nearest = trace(solids, virtual, width, height, glass[part] + 1e-3)
    reflected = colour_pixels(solids, virtual, z, nearest)
    inside = shown[part]
    colours[part][inside] = SILVER * reflected[inside]


# How much of the same surface two cameras see.

COLUMNS = 40  # of the grid of rays on which it is measured
TOLERANCE = 0.04  # of the depth, by which the same surface may differ
GRAZING = 0.06  # metres added to it, for surfaces seen at a slant


@dataclass(frozen=True, eq=False)
class CoarseView:
    """A coarse view of a camera: `z` (h, w) at pixel centres of the small image with `K`."""

    T_world_camera: Matrix
    K: Matrix
    z: npt.NDArray[np.float32]


def render_coarse_view(state: BuildingState, camera: Camera, width: int, height: int) -> CoarseView:
    """Renders the coarse view of a camera with images of `width` x `height` pixels."""
    T_world_camera, K = camera
    small = COLUMNS, max(1, round(COLUMNS * height / width))
    scaled = np.diag([small[0] / width, small[1] / height, 1.0]) @ K
    return CoarseView(T_world_camera, scaled, render_depth(state, (T_world_camera, scaled), *small))


def compute_overlap(first: CoarseView, second: CoarseView) -> float:
    """0 to 1: the share of what one sees that the other sees, too; of both ways the lesser."""
    return min(_share(first, second), _share(second, first))


def _share(first: CoarseView, second: CoarseView) -> float:
    rows, columns = first.z.shape
    u, v = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    known = np.isfinite(first.z)
    rays = np.stack([u, v, np.ones_like(u)], -1)[known] @ np.linalg.inv(first.K).T
    T_second_first = np.linalg.inv(second.T_world_camera) @ first.T_world_camera
    points = (rays * first.z[known][:, None]) @ T_second_first[:3, :3].T + T_second_first[:3, 3]
    ahead = points[:, 2] > 0.05
    pixels = points[ahead] @ second.K.T
    x, y = (np.floor(pixels[:, axis] / pixels[:, 2]).astype(int) for axis in (0, 1))
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    z, found = points[ahead][inside, 2], second.z[y[inside], x[inside]]
    same = np.abs(z - found) < GRAZING + TOLERANCE * z
    return float(same.sum()) / first.z.size


SAME_PLACE = 0.3  # of what two keyframes show: as much in common, and they show the same place
BARE = 16.0  # texels a metre, where only surfaces matter: they are the same at every density, and soon made
LONGEST_KIDNAP = 400  # keyframes of the walk that a kidnapped robot may miss; the next tour of another room is nearer

Count = Annotated[int, msgspec.Meta(ge=1, le=100_000)]
Side = Annotated[int, msgspec.Meta(ge=16, le=4096)]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    keyframes: Count = 1000  # how many are made; the walk is as long as they need
    width: Internal[Side] = 480  # of an image, pixels
    height: Internal[Side] = 360  # of an image, pixels
    seed: Annotated[int, msgspec.Meta(ge=0, le=1_000_000)] = 0  # of the building and of the walk
    noise: Internal[float] = 1.0  # standard deviation of the sensor noise, grey levels
    samples: Internal[Annotated[int, msgspec.Meta(ge=1, le=4)]] = 2  # rays a pixel in each direction
    # The number of the keyframe from which on the robot is in another room; 0: it is never carried away
    kidnap_at: Annotated[int, msgspec.Meta(ge=0, le=100_000)] = 0
    fps: FramesPerSecond = 2.0  # by the stamps
    pace: Pace = "fastest"  # recorded: at the pace of the stamps; fastest: as fast as they are made


def stream(config: Config) -> Iterator[Frame | DroppedFrame]:
    """The photographs in the order of the walk, each made when it is asked for."""
    return pace_frames(_frames(config), config.pace)


def _frames(config: Config) -> Iterator[Frame]:
    for index in range(config.keyframes):
        stamp_ns = round(index / config.fps * 1e9)
        image, captured_at = render_image(config, index), Stamp(stamp_ns, Clock.RECORDING)
        yield Frame(index, frame_name(index), stamp_ns, image, intrinsics=None, captured_at=captured_at)


def frame_name(index: int) -> str:
    return f"keyframe_{index:05d}.png"


def frame_index(name: str) -> int:
    """Inverse of frame_name, of what begins with it, too."""
    return int(name.removeprefix("keyframe_").partition(".")[0])


def scene_camera(config: Config, index: float) -> Camera:
    """T_world_camera and K of a keyframe; world axes as in splatnode.extras.building, metres."""
    return _walk(config).T_world_camera(_position(config, index)), intrinsic_matrix(config)


def evaluation_camera(config: Config, index: int) -> Camera:
    """A camera for testing: midway on the walk from keyframe `index` to the next."""
    return scene_camera(config, index + 0.5)


def render_image(config: Config, index: float) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB as the camera of keyframe `index` (held out where it ends with .5) sees the building of then."""
    T_world_camera, K = scene_camera(config, index)
    dense = T_world_camera, np.diag([config.samples, config.samples, 1.0]) @ K
    colours = view(state(config, index), dense, config.width * config.samples, config.height * config.samples)
    image = cv2.resize(colours, (config.width, config.height), interpolation=cv2.INTER_AREA)
    grain = np.random.default_rng([config.seed, round(2 * index)]).standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image + np.float32(config.noise) * grain), 0, 255).astype(np.uint8)


def depth(config: Config, index: float) -> npt.NDArray[np.float32]:
    """(H, W) true z in the keyframe's camera frame, metres, at pixel centres; of the mirror, that of its glass."""
    return render_depth(state(config, index), scene_camera(config, index), config.width, config.height)


def measure_shared_surface(config: Config, first: int, second: int) -> float:
    """0 to 1: how much of the surface that one keyframe shows the other shows, too; of both ways the lesser."""
    return compute_overlap(_render_coarse_view(config, first), _render_coarse_view(config, second))


def same_place(config: Config, first: int, second: int) -> bool:
    """Whether two keyframes show the same place. A chair that was moved in between makes no other place of it."""
    return measure_shared_surface(config, first, second) >= SAME_PLACE


def state(config: Config, index: float) -> BuildingState:
    """The building when a keyframe is taken: the chair is moved whenever its room has been left."""
    position = _position(config, index)
    left = sum(visit.room == CHAIR_ROOM and visit.last < position for visit in _walk(config).visits)
    density = float(np.clip(0.28 * max(config.width, config.height), 48, 512))
    return BuildingState(config.seed, density, left % 2)


def room(config: Config, index: float) -> int | None:
    """The room that is toured at a keyframe; None on the way between two."""
    visit = _walk(config).visit_at(_position(config, index))
    return None if visit is None else visit.room


def intrinsic_matrix(config: Config) -> npt.NDArray[np.float64]:
    """(3, 3); 71 degrees from left to right."""
    focal = 0.7 * config.width
    return np.array([[focal, 0.0, config.width / 2], [0.0, focal, config.height / 2], [0.0, 0.0, 1.0]])


def _walk(config: Config) -> Walk:
    return walk(config.seed, config.keyframes + LONGEST_KIDNAP)


def _position(config: Config, index: float) -> float:
    if not config.kidnap_at or index < config.kidnap_at:
        return index
    return index + _count_missed_keyframes(config)


@lru_cache(maxsize=8)
def _count_missed_keyframes(config: Config) -> float:
    """Keyframes that the kidnapped robot misses: it goes on in the middle of the next tour of another room."""
    here = _walk(config).visit_at(config.kidnap_at)
    for visit in _walk(config).visits:
        middle = (visit.first + visit.last) / 2
        if middle > config.kidnap_at and (here is None or visit.room != here.room):
            return round(middle - config.kidnap_at)
    raise ValueError(f"no other room is toured after keyframe {config.kidnap_at}; kidnap the robot earlier")


@lru_cache(maxsize=4096)
def _render_coarse_view(config: Config, index: int) -> CoarseView:
    bare = replace(state(config, index), density=BARE)
    return render_coarse_view(bare, scene_camera(config, index), config.width, config.height)
