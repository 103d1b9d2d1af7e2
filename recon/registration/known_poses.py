"""Poses that came with images, as registration takes them: within their sigmas, in a frame near the cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame
from splatnode.recon.geometry import compute_rms_radius, cross_matrix
from splatnode.recon.keyframes import PLAIN, REFERENCE_SIDE, Keyframe, longer_side, principal_point
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration import bundle_adjustment

Array = npt.NDArray[np.float64]

CALIBRATION_SOURCES = ("given", "calibration")  # sources of a lens that is known
_LEAST_POSES = 2  # that tell a scale
_LEAST_SPREAD = 1e-9  # metres, in place of 0


# Errors of poses that drift: what odometry adds up from step to step is off more the longer the way is.
#
# Each step is off by itself, by a share of its length and by a turn that grows with the root of it; and all steps are
# off alike, by a scale. A turn's error moves all that comes after it.


@dataclass(frozen=True)
class Drift:
    """How fast poses drift: standard deviations."""

    share: float  # of a step's error in each direction, and of the error of all lengths alike
    degrees: float  # of the turn about each axis that has grown after a metre of way; it grows with the root of the way


NO_DRIFT = Drift(0.0, 0.0)


def compute_drift_covariance(rotations: Array, centres: Array, drift: Drift) -> Array:
    """(6 C, 6 C) covariance of the errors of C poses in the order of the way, in the cameras' axes: turns and shifts.

    `rotations` (C, 3, 3) are world to camera, `centres` (C, 3) metres. The first pose has no error. Errors are taken
    for small.
    """
    count = len(centres)
    steps = np.diff(centres, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    errors = np.zeros((6 * count, 6 * count + 1))  # of the poses in the world, by the independent parts
    for i in range(1, count):
        errors[6 * i : 6 * i + 6] = errors[6 * i - 6 : 6 * i]
        turn = slice(6 * i, 6 * i + 3)
        errors[6 * i + 3 : 6 * i + 6] -= cross_matrix(steps[i - 1 : i])[0] @ errors[turn]  # turn x step
        errors[turn, turn] += np.radians(drift.degrees) * np.sqrt(lengths[i - 1]) * np.eye(3)
        errors[6 * i + 3 : 6 * i + 6, 6 * i + 3 : 6 * i + 6] += drift.share * lengths[i - 1] * np.eye(3)
        errors[6 * i + 3 : 6 * i + 6, -1] += drift.share * steps[i - 1]
    # A deviation from a given pose is that pose's error in the camera's axes.
    for i in range(count):
        errors[6 * i : 6 * i + 3] = rotations[i] @ errors[6 * i : 6 * i + 3]
        errors[6 * i + 3 : 6 * i + 6] = rotations[i] @ errors[6 * i + 3 : 6 * i + 6]
    return errors @ errors.T


# Given poses in the frame of a registration.


@dataclass(frozen=True, eq=False)
class Given:
    """Poses of some of C keyframes. A unit of the frame that the poses are in has `metres`, around `origin`."""

    poses: bundle_adjustment.GivenPoses
    origin: Array  # (3,) metres, in the given world
    metres: float
    away: float  # how far away what the cameras look at is, where their axes tell it; else some distance

    @property
    def angle_sigmas(self) -> Array:
        """(C,) radians by which points appear elsewhere, as the poses' sigmas and the distance are; inf: no pose."""
        return np.hypot(self.poses.sigmas[:, 0], self.poses.sigmas[:, 1] / self.away)


@dataclass(frozen=True)
class Deviation:
    """A given pose that the images contradict."""

    index: int  # of the keyframe
    metres: float  # from where the images place the camera
    degrees: float
    sigmas: float  # how unlikely that is, as the deviation of a normal distribution


@dataclass(frozen=True, eq=False)
class GivenWorld:
    """How a registration lies in the world of given poses, and how well its cameras are known there.

    A point p of the registration is at `scale * rotation @ p + translation` there, in metres.
    """

    scale: float
    rotation: Array  # (3, 3)
    translation: Array  # (3,)
    scale_sigma: float  # standard deviation of the logarithm of the scale
    deviations: tuple[Deviation, ...]  # the worst first
    offset: Offset | None  # in which all given poses agree, and which was taken out; None: there is none
    # (C, 3, 3) of the cameras' orientations, radians, and centres, in the frame and unit of the registration
    turn_covariances: Array
    centre_covariances: Array
    held: frozenset[int]  # keyframes whose given pose holds their camera
    from_depth: bool = False  # whether depth images gave the poses, and nobody told them


@dataclass(frozen=True, eq=False)
class Offset:
    """The error that all given poses share: T_given = T_true @ T_true_given, as of a wrong hand-eye calibration."""

    T_camera_given: Array  # (4, 4) metres
    turn_sigma: float  # standard deviation about the axis in which it is least known, radians
    shift_sigma: float  # and in the direction, metres

    @property
    def metres(self) -> float:
        return float(np.linalg.norm(self.T_camera_given[:3, 3]))

    @property
    def degrees(self) -> float:
        return float(np.degrees(np.arccos(np.clip((np.trace(self.T_camera_given[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))))


def collect_known_poses(
    keyframes: Sequence[Keyframe], offset: Offset | None = None, drift: Drift = NO_DRIFT
) -> Given | None:
    """The poses of those keyframes whose lens is told; None where fewer than two hold a scale.

    They must be farther apart than they are unsure. `offset` is taken out of them; they drift in the order in which
    their frames came.
    """
    known = [i for i, keyframe in enumerate(keyframes) if has_pose(keyframe)]
    if len(known) < _LEAST_POSES:
        return None
    rotations, centres = np.tile(np.eye(3), (len(keyframes), 1, 1)), np.zeros((len(keyframes), 3))
    sigmas = np.full((len(keyframes), 2), np.inf)
    for i in known:
        pose = keyframes[i].frame.given_pose
        if pose is None:
            raise AssertionError("these keyframes have poses")
        T = pose.matrix if offset is None else pose.matrix @ np.linalg.inv(offset.T_camera_given)
        u, _, vt = np.linalg.svd(T[:3, :3])  # what comes is a rotation but for rounding
        rotations[i], centres[i] = (u @ vt).T, T[:3, 3]
        sigmas[i] = np.radians(pose.sigma_deg), pose.sigma_m
    apart = compute_rms_radius(centres[known])
    if apart <= np.median(sigmas[known, 1]):
        return None
    origin, metres = centres[known].mean(0), max(apart, _LEAST_SPREAD)
    joint = None
    if drift != NO_DRIFT:
        way = sorted(known, key=lambda i: (keyframes[i].frame.frame_id, keyframes[i].name))
        sigmas, joint = _let_drift(rotations, centres, sigmas, way, drift, metres)
    sigmas[:, 1] /= metres
    centres[known] = (centres[known] - origin) / metres
    poses = bundle_adjustment.GivenPoses(rotations, centres, sigmas, joint)
    depths = axis_depths(rotations[known], centres[known])
    return Given(poses, origin, metres, float(np.median(depths)) if len(depths) else _FAR_OFF)


def _let_drift(
    rotations: Array, centres: Array, sigmas: Array, way: Sequence[int], drift: Drift, metres: float
) -> tuple[Array, Array]:
    """The sigmas (C, 2) of poses that drift on their `way`, and the covariance (6 C, 6 C), whose unit has `metres`."""
    rows = (6 * np.array(way)[:, None] + np.arange(6)).ravel()
    joint = np.zeros((6 * len(sigmas),) * 2)
    joint[np.ix_(rows, rows)] = compute_drift_covariance(rotations[way], centres[way], drift)
    joint[rows, rows] += np.repeat(sigmas[way] ** 2, 3, axis=1).ravel()
    wider = np.sqrt(np.diag(joint).reshape(-1, 2, 3).mean(2))
    unit = np.tile(np.repeat([1.0, 1.0 / metres], 3), len(sigmas))
    return np.where(np.isfinite(sigmas), wider, np.inf), unit[:, None] * joint * unit


def has_pose(keyframe: Keyframe) -> bool:
    """Whether a pose may hold its camera: it came with one, and with its lens."""
    return keyframe.frame.given_pose is not None and has_calibrated_lens(keyframe.frame)


def has_calibrated_lens(frame: Frame) -> bool:
    """Whether the lens of a frame was given, or is that of its camera's calibration."""
    return frame.intrinsics is not None and frame.intrinsics.source in CALIBRATION_SOURCES


def distance(problem: bundle_adjustment.Problem, registered: Sequence[int]) -> float:
    """The median depth of the points; of too few, that at which the cameras' axes are nearest to one another."""
    if len(problem.points) >= _ENOUGH_POINTS:
        return float(np.median(bundle_adjustment.project(problem)[1]))
    found = axis_depths(problem.rotations[list(registered)], bundle_adjustment.centres(problem)[list(registered)])
    centres = bundle_adjustment.centres(problem)[list(registered)]
    return float(np.median(found)) if len(found) else _FAR_OFF * max(compute_rms_radius(centres), _LEAST_SPREAD)


_ENOUGH_POINTS = 5  # to know how far away a scene is
_FAR_OFF = 5.0  # times the cameras' spread: the distance of a scene of which nothing is known
_LEAST_ANGLE = np.sin(np.radians(2.0)) ** 2  # squared sine between two axes that meet somewhere


def axis_depths(rotations: Array, centres: Array) -> Array:
    """(M,) depths at which pairs of optical axes are nearest to each other, where that is before both cameras.

    `rotations` (C, 3, 3) are world to camera.
    """
    found = []
    for i in range(len(centres)):
        for j in range(len(centres)):
            axis, other, way = rotations[i][2], rotations[j][2], centres[j] - centres[i]
            cosine = float(axis @ other)
            if i == j or 1.0 - cosine**2 < _LEAST_ANGLE:
                continue
            here = float(way @ axis - cosine * (way @ other)) / (1.0 - cosine**2)
            there = float(cosine * (way @ axis) - way @ other) / (1.0 - cosine**2)
            if here > 0 and there > 0:
                found.append(here)
    return np.array(found)


# Matches along epipolar lines of given poses, for pairs in which plain matching found few.
#
# The nearest descriptor among those near a feature's epipolar line is compared with the second nearest there, and not
# with those of the whole image: what repeats elsewhere does not matter. Lines that are moved aside tell how many
# matches come by chance.

Float32 = npt.NDArray[np.float32]
Index = npt.NDArray[np.int64]
Pair = tuple[int, int]

_FEW = 60  # matches of a pair from which on it needs no more
_MOST_PAIRS = 60  # that are looked at, those first whose cameras are nearest to each other
_STRONGEST = 3000  # features of an image that are compared
_RATIO = 0.8  # largest ratio of nearest to second-nearest distance
_WIDEST_PX, _LEAST_PX = 24.0, 2.0  # of the band on each side of a line, at REFERENCE_SIDE
_SIGMAS = 3.0  # of the given poses, in pixels: how wide the band is
_BY_CHANCE, _LEAST = 2.5, 12  # times as many as beside the lines, and so many more, must match along them
_ASIDE = (-3.0, 3.0)  # band widths by which lines are moved to see what matches by chance
_ROWS = 512  # features that are compared at once


def add_guided_matches(
    keyframes: Sequence[Keyframe], pairs: Mapping[Pair, TwoView], given: Given
) -> dict[Pair, TwoView]:
    """The pairs, and matches along epipolar lines for those of two given poses that have few."""
    known, centres = np.flatnonzero(given.poses.is_held).tolist(), given.poses.centres
    few = [(i, j) for i in known for j in known if i < j and ((i, j) not in pairs or len(pairs[i, j].matches) < _FEW)]
    few.sort(key=lambda pair: (float(np.linalg.norm(centres[pair[0]] - centres[pair[1]])), pair))
    found = dict(pairs)
    for i, j in few[:_MOST_PAIRS]:
        matches = _along_lines(keyframes[i], keyframes[j], given, (i, j))
        if len(matches):
            found[i, j] = _join_matches(found.get((i, j)), matches, keyframes[i], keyframes[j])
    return dict(sorted(found.items()))


def _along_lines(one: Keyframe, other: Keyframe, given: Given, pair: Pair) -> Index:
    """(M, 2) point numbers; none where as many match beside the lines."""
    descriptors, rays, points = [], [], []
    for keyframe in (one, other):
        plain = keyframe.features.select_tilt(PLAIN)
        chosen = plain.point_of[:_STRONGEST]
        descriptors.append(plain.descriptors[:_STRONGEST].astype(np.float32))
        points.append(chosen)
        rays.append((keyframe.features.points[chosen] - principal_point(keyframe.frame)) / _focal(keyframe))
    if min(map(len, points)) < 2:
        return np.zeros((0, 2), np.int64)
    i, j = pair
    poses = given.poses
    rotation = poses.rotations[j] @ poses.rotations[i].T
    translation = poses.rotations[j] @ (poses.centres[i] - poses.centres[j])
    lines = np.c_[rays[0], np.ones(len(rays[0]))] @ (cross_matrix(translation[None])[0] @ rotation).T
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    pixel = longer_side(other.frame) / REFERENCE_SIDE / _focal(other)  # at REFERENCE_SIDE, at depth 1
    turned = float(np.hypot(*(poses.sigmas[[i, j], 0] if poses.joint is None else given.angle_sigmas[[i, j]])))
    band = np.clip(_SIGMAS * np.sqrt(2.0) * turned / pixel, _LEAST_PX, _WIDEST_PX) * pixel
    along, *beside = _mutual(descriptors, lines, rays[1], band, (0.0, *_ASIDE))
    by_chance = max(map(len, beside))
    if len(along) < _BY_CHANCE * by_chance + _LEAST:
        return np.zeros((0, 2), np.int64)
    return np.stack([points[0][along[:, 0]], points[1][along[:, 1]]], 1)


def _mutual(
    descriptors: Sequence[Float32], lines: Array, rays: Array, band: float, moves: Sequence[float]
) -> list[Index]:
    """(M, 2) features, each the other's nearest within `band` of the line, clearly nearer than the second nearest.

    For the lines as they are moved aside by each of `moves` bands.
    """
    count, other = len(lines), len(rays)
    squared_norms = [(each**2).sum(1) for each in descriptors]
    nearest, distinct = np.full((len(moves), count), -1), np.zeros((len(moves), count), bool)
    back_squared, back = np.full((len(moves), other), np.inf, np.float32), np.full((len(moves), other), -1)
    for start in range(0, count, _ROWS):
        rows = slice(start, start + _ROWS)
        every = squared_norms[0][rows, None] + squared_norms[1] - 2.0 * descriptors[0][rows] @ descriptors[1].T
        away = (lines[rows, :2] @ rays.T + lines[rows, 2:]).astype(np.float32)
        numbers = np.arange(len(every))
        for k, move in enumerate(moves):
            squared = np.where(np.abs(away + np.float32(move * band)) > band, np.float32(np.inf), every)
            least = squared.argmin(0)
            values_back = squared[least, np.arange(other)]
            nearer = values_back < back_squared[k]
            back_squared[k, nearer], back[k, nearer] = values_back[nearer], start + least[nearer]
            first = squared.argmin(1)
            best = squared[numbers, first]
            squared[numbers, first] = np.inf
            nearest[k, rows] = np.where(np.isfinite(best), first, -1)
            distinct[k, rows] = best < _RATIO**2 * squared.min(1)
    found = []
    for k in range(len(moves)):
        (kept,) = np.nonzero(distinct[k] & (nearest[k] >= 0))
        kept = kept[back[k, nearest[k, kept]] == kept]
        found.append(np.stack([kept, nearest[k, kept]], 1))
    return found


def _join_matches(known: TwoView | None, matches: Index, one: Keyframe, other: Keyframe) -> TwoView:
    """The pair's matches and those of these, in which neither point has a match yet."""
    if known is not None:
        fresh = ~np.isin(matches[:, 0], known.matches[:, 0]) & ~np.isin(matches[:, 1], known.matches[:, 1])
        matches = np.concatenate([known.matches, matches[fresh]])
    for side in (0, 1):
        _, first = np.unique(matches[:, side], return_index=True)
        matches = matches[np.sort(first)]
    points1 = one.features.points[matches[:, 0]] - principal_point(one.frame)
    points2 = other.features.points[matches[:, 1]] - principal_point(other.frame)
    ratio = _focal(other) / longer_side(other.frame)
    num_candidates = len(matches) if known is None else known.num_candidates
    log10_nfa = 0.0 if known is None else known.log10_nfa
    return TwoView(matches, points1, points2, num_candidates, log10_nfa, 0, 0, ratio)


def _focal(keyframe: Keyframe) -> float:
    lens = keyframe.frame.intrinsics
    if lens is None:
        raise AssertionError("a given pose counts where the lens is told")
    return lens.fx
