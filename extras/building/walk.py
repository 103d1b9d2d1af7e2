"""The walk by keyframes: where the camera is at each, and which room is toured when."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama.scene import Camera, Matrix, Solid, colour_pixels, look_at, trace
from splatnode.extras.building.building import (
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
    return _walk(seed, 8 + keyframes // FEWEST_A_LEG // 8 * 8)


@lru_cache(maxsize=4)
def _walk(seed: int, legs: int) -> Walk:
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


def depth(state: BuildingState, camera: Camera, width: int, height: int) -> npt.NDArray[np.float32]:
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
    return CoarseView(T_world_camera, scaled, depth(state, (T_world_camera, scaled), *small))


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
