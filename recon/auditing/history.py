"""When each camera of a station stood still, when it moved, and which moved as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from splatnode.recon.auditing.motion import UNLIKELY, MeasuredMotion, adjoint, measure_motion, twist
from splatnode.recon.auditing.sighting import CameraSighting

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Period:
    """Recordings in which a camera stood where it was in the first of them, as far as can be told."""

    recordings: tuple[int, ...]  # by number, rising: those in which the camera was placed
    sighting: CameraSighting  # in the first of them
    last_motion: MeasuredMotion | None  # from the first to the last of them, which tells what would have been noticed
    came_by: MeasuredMotion | None  # from the period before; None: it is the first


@dataclass(frozen=True)
class Move:
    """Cameras that moved as one between two recordings."""

    after: int  # the last recording before it, by number; of several cameras, the latest
    before: int  # the first recording after it; the earliest
    cameras: tuple[str, ...]


def extend_history(history: Sequence[Period], number: int, sighting: CameraSighting) -> list[Period]:
    """The periods of one camera, once it was seen in the recording `number`, too, which is later than theirs.

    It is compared with the first recording of the last period: drift adds up.
    """
    if not history:
        return [Period((number,), sighting, None, None)]
    *earlier, last = history
    since = measure_motion(last.sighting.placed, sighting.placed)
    if since.is_significant:
        return [*earlier, last, Period((number,), sighting, None, since)]
    return [*earlier, Period((*last.recordings, number), last.sighting, since, last.came_by)]


@dataclass(frozen=True, eq=False)
class _PeriodChange:
    """From one period of a camera to the next."""

    camera: str
    earlier: Period
    later: Period

    @property
    def after(self) -> int:
        return self.earlier.recordings[-1]

    @property
    def before(self) -> int:
        return self.later.recordings[0]


def find_moves(histories: Mapping[str, Sequence[Period]]) -> list[Move]:
    """All moves, in their order; cameras that moved alike in the world between the same recordings are one."""
    steps = [
        _PeriodChange(name, earlier, later)
        for name, history in histories.items()
        for earlier, later in pairwise(history)
    ]
    groups: list[list[_PeriodChange]] = []
    for step in sorted(steps, key=lambda step: (step.before, step.after, step.camera)):
        fitting = (
            group for group in groups if all(_overlap(step, each) and _is_same_motion(step, each) for each in group)
        )
        group = next(fitting, None)
        if group is None:
            groups.append([step])
        else:
            group.append(step)
    return [
        Move(
            max(each.after for each in group), min(each.before for each in group), tuple(each.camera for each in group)
        )
        for group in groups
    ]


def _overlap(one: _PeriodChange, other: _PeriodChange) -> bool:
    """Whether both may have happened at one moment."""
    return max(one.after, other.after) < min(one.before, other.before)


def _is_same_motion(one: _PeriodChange, other: _PeriodChange) -> bool:
    """Whether both cameras may be on one body that moved: the world's points moved alike for both."""
    first, second = _require_motion(one), _require_motion(other)
    T_other_one = np.linalg.inv(_pose(other)) @ _pose(one)
    expected = T_other_one @ first.T_before_after @ np.linalg.inv(T_other_one)
    covariance = adjoint(T_other_one) @ first.covariance @ adjoint(T_other_one).T + second.covariance
    difference = twist(np.linalg.inv(expected) @ second.T_before_after)
    return bool(difference @ np.linalg.solve(covariance, difference) < UNLIKELY)


def _require_motion(step: _PeriodChange) -> MeasuredMotion:
    assert step.later.came_by is not None  # it is not the first period
    return step.later.came_by


def _pose(step: _PeriodChange) -> Array:
    """(4, 4) where the camera stood, to the world."""
    return step.earlier.sighting.placed.camera.T_world_camera
