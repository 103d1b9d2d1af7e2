"""The walk by keyframes: where the camera is at each, and which room is toured when."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from splatnode.capture.diorama.building.legs import STEP, Array, line
from splatnode.capture.diorama.cast import Matrix
from splatnode.capture.diorama.look_at import look_at

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
