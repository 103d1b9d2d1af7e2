"""All that is known of a station's cameras over its recordings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.process.terminal import ProgressStep, Tell, ignore_progress
from splatnode.extras.auditing.stations import StationRecording, load_sample_frames
from splatnode.recon.geometry import angles_deg, cross_matrix
from splatnode.recon.locating.localize import (
    Localization,
    choose_intrinsics,
    localize_with_inliers,
    prepare_query_image,
)
from splatnode.recon.locating.pose_refinement import POSE, optimize_camera, pose_covariance
from splatnode.recon.result.snapshot import Landmarks

# How a camera moved between two photographs, by the landmarks that both show.
#
# Each photograph by itself is placed as well as the landmarks are known. What is wrong with a landmark moves it alike
# in both pictures, so that the difference tells of a move far smaller than that: here the shift in the picture, of
# each landmark that both show, is explained by a turn and a shift of the camera.

Array = npt.NDArray[np.float64]

# Chi-squared with 6 degrees of freedom that chance exceeds once in a million: the move is no chance beyond it.
UNLIKELY = 38.26
MIN_COMMON = 30  # landmarks that both photographs must show; with fewer, what is known of each by itself decides
_LEAST_NOISE = 2.5e-4  # of the longer side: no shift of a feature is known better than an eighth of 512 pixels' one


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """The motion of a camera between two images, in the frame of the first: x right, y down, z forward."""

    T_before_after: Array  # (4, 4): p_before = T_before_after @ p_after
    covariance: Array  # (6, 6) of a small motion in that frame: shift (result's unit), then turn (radians)
    common: int  # landmarks that both show and that it was measured by; 0: each photograph was placed by itself

    @property
    def degrees(self) -> float:
        """The angle of the rotation."""
        return float(angles_deg(self.T_before_after[None, :3, :3], np.eye(3)[None])[0])

    @property
    def distance(self) -> float:
        """The length of the shift, in the result's unit."""
        return float(np.linalg.norm(self.T_before_after[:3, 3]))

    @property
    def degrees_sigma(self) -> float:
        """The standard deviation of the turn along the axis about which it is known worst."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1])))

    @property
    def distance_sigma(self) -> float:
        """The standard deviation of the shift in the direction in which it is known worst."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    def format_motion(self, unit: float, metric: bool) -> str:
        """How far, with two standard deviations: in centimetres if the result is `metric`, else over its `unit`."""
        turn = f"{self.degrees:.2g} degrees (± {2 * self.degrees_sigma:.1g})"
        distance, sigma = self.distance, 2 * self.distance_sigma
        if metric:
            return f"{turn} and {100 * distance:.2g} cm (± {100 * sigma:.1g})"
        return f"{turn} and {100 * distance / unit:.2g} % of the distance (± {100 * sigma / unit:.1g})"

    @property
    def is_significant(self) -> bool:
        """Whether the motion exceeds chance."""
        step = twist(self.T_before_after)
        return float(step @ np.linalg.solve(self.covariance, step)) > UNLIKELY

    @property
    def least_turn_deg(self) -> float:
        """The smallest turn alone that would be significant, about the axis about which the least is known."""
        information = np.linalg.inv(self.covariance)[3:, 3:]
        return float(np.degrees(np.sqrt(UNLIKELY / np.linalg.eigvalsh(information)[0])))

    @property
    def least_shift(self) -> float:
        """The smallest shift alone that would be significant, in the direction in which the least is known."""
        information = np.linalg.inv(self.covariance)[:3, :3]
        return float(np.sqrt(UNLIKELY / np.linalg.eigvalsh(information)[0]))


def measure_motion(before: Localization, after: Localization) -> MeasuredMotion:
    """How the camera of the photograph `before` moved until `after`; both are of one camera.

    Where it has another lens since, as once it zoomed, what each photograph says by itself is compared.
    """
    own, other = _find_common(before, after)
    T = np.linalg.inv(before.camera.T_world_camera) @ after.camera.T_world_camera
    apart = before.located.covariance + _rotate_covariance(after.located.covariance, T)
    if len(own) >= MIN_COMMON and before.size == after.size and _has_same_lens(before, after):
        measured = _fit_motion(before, own, after.seen.pixels[other] - before.seen.pixels[own])
        if measured is not None:
            depth = float(np.median(before.camera.project(before.seen.points[own])[1]))
            otherwise = _compute_unshared_error(measured, min(depth, before.spread))
            return replace(measured, covariance=measured.covariance + otherwise**2 * apart)
    return MeasuredMotion(T, apart, 0)


def _has_same_lens(before: Localization, after: Localization) -> bool:
    """Whether the focal lengths differ by no more than their bounds allow."""
    first, second = (np.diag(each.located.K)[:2] for each in (before, after))
    bounds = [math.log1p(each.located.claim.focal_percent / 100.0) for each in (before, after)]
    return bool(np.abs(np.log(second / first)).max() <= math.hypot(*bounds))


def _compute_unshared_error(motion: MeasuredMotion, reach: float) -> float:
    """The share of what is wrong with the scene that is not the same for both cameras, in [0, 1].

    A scene that is bent turns its cameras against each other, those that are farther apart by more: it is all for two
    that are `reach` apart, which is how far the scene's cameras stand from each other, or from the scene, if that is
    less. It grows with the angle between the directions in which the two look, too.
    """
    if motion.distance >= reach:
        return 1.0
    return min(1.0, motion.distance / reach + np.radians(motion.degrees))


def _find_common(before: Localization, after: Localization) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The places of the landmarks that both show, among those that each shows."""
    _, own, other = np.intersect1d(before.seen.landmark_of, after.seen.landmark_of, return_indices=True)
    return own, other


def _fit_motion(before: Localization, own: npt.NDArray[np.int64], shifts: Array) -> MeasuredMotion | None:
    """The motion that explains the `shifts` (M, 2) of the landmarks in the picture; None where they do not tell it.

    The landmarks, and the lens, count as exact: what is wrong with them is so in both photographs.
    """
    start, seen = before.camera, before.seen.select(own)
    pixels = start.project(seen.points)[0] + shifts
    exact = replace(seen, pixels=pixels, covariances=np.zeros_like(seen.covariances))
    lens = replace(start.lens, log_focal_sigma=0.0, radial_sigma=0.0, shift_sigma=0.0, log_aspect_sigma=0.0)
    fit = optimize_camera(start, lens, exact, _LEAST_NOISE * max(before.size))
    if not np.isfinite(fit.covariance).all():
        return None
    T = np.linalg.inv(start.T_world_camera) @ fit.camera.T_world_camera
    return MeasuredMotion(T, _rotate_covariance(pose_covariance(fit.camera, fit.covariance), T), len(own))


def adjoint(T: Array) -> Array:
    """(6, 6) what makes of a small motion, shift then turn, the same in the frame that T (4, 4) leads to."""
    result = np.zeros((POSE, POSE))
    result[:3, :3] = result[3:, 3:] = T[:3, :3]
    result[:3, 3:] = cross_matrix(T[None, :3, 3])[0] @ T[:3, :3]
    return result


def twist(T: Array) -> Array:
    """(6,) the shift and the rotation vector of a motion (4, 4)."""
    return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()])


def _rotate_covariance(covariance: Array, T_before_after: Array) -> Array:
    """The covariance (6, 6) of a small motion in the frame of the second photograph, along the axes of the first."""
    turn = np.kron(np.eye(2), T_before_after[:3, :3])
    return turn @ covariance @ turn.T


# A camera of a station in one recording: where it stood, or why that is not known.

MOVING = "MOVING"  # the code of a camera that did not stand still
UNREADABLE = "UNREADABLE"


@dataclass(frozen=True, eq=False)
class CameraSighting:
    """A camera that stood still."""

    photograph: str
    placed: Localization


@dataclass(frozen=True)
class SightingFailure:
    """Why it is not known where a camera stood."""

    photograph: str
    code: str  # a Reason of recon/locating/outcome.py, MOVING or UNREADABLE
    message: str


def localize_camera(
    landmarks: Landmarks, frames: Iterable[Frame | DroppedFrame], fov_deg: float | None = None
) -> CameraSighting | SightingFailure:
    """Localizes the camera that took these images of one recording; there is at least one.

    `fov_deg` is its angle of view across the longer side, in degrees. Of several photographs all that can be placed
    must be of one place.
    """
    first, problem = None, None
    for frame in frames:
        if isinstance(frame, DroppedFrame):
            problem = problem or SightingFailure(frame.name, UNREADABLE, frame.reason)
            continue
        try:
            photograph = prepare_query_image(frame.image, choose_intrinsics(frame, fov_deg), name=frame.name)
        except ValueError as error:  # of its lens, which nothing can undo
            problem = problem or SightingFailure(frame.name, UNREADABLE, str(error))
            continue
        found = localize_with_inliers(landmarks, photograph)
        if not isinstance(found, Localization):
            problem = problem or SightingFailure(frame.name, found.code.value, found.message)
        elif first is None:
            first = CameraSighting(frame.name, found)
        elif (since := measure_motion(first.placed, found)).is_significant:
            told = f"since {first.photograph} it moved by {since.format_motion(landmarks.unit, landmarks.metric)}"
            return SightingFailure(
                frame.name, MOVING, f"{told}: only a camera that stands still in a recording can be compared"
            )
    if first is not None:
        return first
    assert problem is not None  # there is at least one photograph
    return problem


# When each camera of a station stood still, when it moved, and which moved as one.


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


@dataclass(frozen=True, eq=False)
class Audit:
    """The result of `audit`. Recordings are identified by their number in `recordings`."""

    recordings: tuple[str, ...]  # their names, in the order given, which is that of time
    periods: Mapping[str, Sequence[Period]]  # of each camera that was placed at least once, by its name
    not_seen: Mapping[str, Mapping[int, SightingFailure]]  # of each camera, where it was not placed
    unreadable: Mapping[int, str]  # recordings of whose cameras nothing is known, and why
    moves: Sequence[Move]  # in their order
    unit: float  # the distance to the scene: the median depth of its points, in the unit of the result
    metric: bool  # lengths are metres

    @property
    def comparable_cameras(self) -> list[str]:
        """The cameras that were placed in two recordings or more."""
        return [name for name, history in self.periods.items() if sum(len(each.recordings) for each in history) > 1]


def audit(
    landmarks: Landmarks,
    recordings: Sequence[StationRecording],
    given: Intrinsics | None = None,
    fov_deg: float | None = None,
    tell: Tell = ignore_progress,
) -> Audit:
    """Localizes each camera in each recording, in the world of the landmarks, and finds when it moved.

    `given` is the cameras' lens; `fov_deg` their angle of view across the longer side, in degrees. What is in memory
    grows with the moves, not with the recordings.
    """
    histories: dict[str, list[Period]] = {}
    not_seen: dict[str, dict[int, SightingFailure]] = {}
    total, done = sum(len(recording.cameras) for recording in recordings), 0
    for number, recording in enumerate(recordings):
        for camera, pictures in recording.cameras.items():
            tell(ProgressStep("placing", done, total, "camera"))
            found = localize_camera(landmarks, load_sample_frames(pictures, given), fov_deg)
            if isinstance(found, CameraSighting):
                histories[camera] = extend_history(histories.get(camera, ()), number, found)
            else:
                not_seen.setdefault(camera, {})[number] = found
            done += 1
    histories = {camera: histories[camera] for camera in sorted(histories)}
    names = tuple(recording.name for recording in recordings)
    unreadable = {number: each.problem for number, each in enumerate(recordings) if each.problem}
    return Audit(names, histories, not_seen, unreadable, find_moves(histories), landmarks.unit, landmarks.metric)
