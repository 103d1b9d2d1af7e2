"""The walk as a line on the floor plan: tours of rooms, joined by the corridor, without corners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.capture.diorama.building.plan import DOORS, LENGTH, ZONES

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
