"""The unit by how odometry says that the camera moved from one photograph to the next: wheels, an IMU.

Each motion is compared with what the photographs say of the same two cameras, in the frame of the first of them. So an
error of one motion is in no other, and turns that add up along the way bend nothing. A motion that does not fit is
named and left out. Neither the photographs' cameras nor the scene are changed by them otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations, pairwise
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares, minimize_scalar
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import Gravity, Motion
from splatnode.recon.geometry import Similarity, align_cameras, angles_deg, compute_rms_radius
from splatnode.recon.metric.measurement import TWO_SIDED_95, Measurement, MetricView
from splatnode.recon.metric.pose_drift import PoseNoise, PosePlacement, fit_placement, part_steps
from splatnode.recon.result.verdict import Up

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_FARTHEST = 3.76  # standard deviations in three dimensions: what one has within 3 in one dimension, 99.7 %
_LEAST_DEG = 1.0  # standard deviation of a turn between two cameras of the scene: their own, and how it is mounted
_LEAST_FITTING = 0.6  # of the motions
_LEAST_KNOWN = 0.3  # standard deviation of the log of the unit: what is more unsure says nothing
_ROUNDS = 10


@dataclass(frozen=True, eq=False)
class _MotionSteps:
    """Motions between neighbouring cameras of the scene, each in the frame of its first camera."""

    names: tuple[tuple[str, str], ...]
    scene: Array  # (K, 3) from camera to camera, in the scene's unit
    given: Array  # (K, 3) metres
    turned_deg: Array  # (K,) by which the rotations differ
    sigma_m: Array  # (K,) in each direction
    sigma_deg: Array  # (K,) about each axis
    bounds: Array  # (K,) standard deviation of `scene`, in each direction

    def normalize_errors(self, scale: float) -> Array:
        """(K, 3) the errors over their standard deviations: along the motion, and twice across it."""
        off = scale * self.scene - self.given
        length = np.linalg.norm(self.given, axis=1)
        ahead = self.given / np.maximum(length, 1e-12)[:, None]
        along = (off * ahead).sum(1)
        across = off - along[:, None] * ahead
        sigma = np.hypot(self.sigma_m, scale * self.bounds)
        turned = np.hypot(sigma, np.radians(np.hypot(self.sigma_deg, _LEAST_DEG)) * length)
        return np.column_stack([along / sigma, np.linalg.norm(across, axis=1) / turned])

    def find_fitting(self, scale: float) -> Mask:
        near = np.linalg.norm(self.normalize_errors(scale), axis=1) < _FARTHEST
        return near & (self.turned_deg < _FARTHEST * np.hypot(self.sigma_deg, _LEAST_DEG))

    def cost(self, scale: float, kept: Mask) -> float:
        return float((self.normalize_errors(scale)[kept] ** 2).sum())


def estimate_scale_from_motions(
    views: Mapping[str, MetricView], motions: Mapping[str, Motion], shared: float
) -> list[Measurement | str]:
    """Estimates the scale, with a sentence for each motion that was left out; else one on why not.

    `views` are in the order of the way. `shared` is the standard deviation of an error that all motions have alike, as
    a share of their length. Nothing of motions that all are the first of their chain.
    """
    if not any(motion.sigma_m for motion in motions.values()):
        return []
    steps = _collect_steps(views, motions)
    if steps is None:
        return ["motions were given, and none of them is between two cameras of the scene that follow one another"]
    count = len(steps.names)
    scale, kept = _find_consensus(steps)
    if kept.sum() < max(1, math.ceil(_LEAST_FITTING * count)):
        return [
            f"motions between {_format_pair_count(count)} were given, of which no more than {kept.sum()} fit the "
            "cameras of the "
            "scene: are they of the camera, with x right, y down and z forward, and in metres?"
        ]
    sigma = _estimate_sigma(steps, scale, kept)
    if sigma > _LEAST_KNOWN:
        return [f"motions between {_format_pair_count(count)} were given, which are not longer than they are unsure"]
    off = np.linalg.norm(scale * steps.scene - steps.given, axis=1)
    notes = [
        f"the motion from {first} to {second} was left out: it is {off[i]:.2g} m and {steps.turned_deg[i]:.2g} degrees "
        "off"
        for i, (first, second) in enumerate(steps.names)
        if not kept[i]
    ]
    unit = Measurement(scale, math.hypot(sigma, shared), f"motions between {_format_pair_count(int(kept.sum()))}")
    return [unit, *notes]


def _format_pair_count(count: int) -> str:
    return "one pair of photographs" if count == 1 else f"{count} pairs of photographs"


def _collect_steps(views: Mapping[str, MetricView], motions: Mapping[str, Motion]) -> _MotionSteps | None:
    known = [name for name in views if name in motions]
    pairs = [(a, b) for a, b in pairwise(known) if _follows(motions[a], motions[b])]
    if not pairs:
        return None
    one, other = ([views[pair[i]] for pair in pairs] for i in (0, 1))
    firsts, seconds = ([motions[pair[i]] for pair in pairs] for i in (0, 1))
    of_scene = np.stack([_relative(a.T_world_camera, b.T_world_camera) for a, b in zip(one, other, strict=True)])
    given = np.stack([_relative(a.matrix, b.matrix) for a, b in zip(firsts, seconds, strict=True)])
    return _MotionSteps(
        names=tuple(pairs),
        scene=of_scene[:, :3, 3],
        given=given[:, :3, 3],
        turned_deg=angles_deg(of_scene[:, :3, :3], given[:, :3, :3]),
        sigma_m=np.sqrt([b.sigma_m**2 - a.sigma_m**2 for a, b in zip(firsts, seconds, strict=True)]),
        sigma_deg=np.sqrt([b.sigma_deg**2 - a.sigma_deg**2 for a, b in zip(firsts, seconds, strict=True)]),
        bounds=np.array([math.hypot(a.bound, b.bound) for a, b in zip(one, other, strict=True)]) / TWO_SIDED_95,
    )


def _follows(first: Motion, second: Motion) -> bool:
    """Whether the one is later in the same chain; a recording that is shown again begins it anew."""
    later = second.sigma_m > first.sigma_m and second.sigma_deg > first.sigma_deg
    return first.chain == second.chain and later


def _relative(first: Array, second: Array) -> Array:
    return np.linalg.inv(first) @ second


def _find_consensus(steps: _MotionSteps) -> tuple[float, Mask]:
    """The unit that most motions agree on, and which do: first by that of each of them, then by all that fit."""
    lengths = np.linalg.norm(steps.scene, axis=1), np.linalg.norm(steps.given, axis=1)
    moved = (lengths[0] > 0) & (lengths[1] > 0)
    proposals = (lengths[1][moved] / lengths[0][moved]).tolist()
    if not proposals:
        return 1.0, np.zeros(len(steps.names), bool)

    def cost(scale: float) -> float:
        return float(np.minimum((steps.normalize_errors(scale) ** 2).sum(1), _FARTHEST**2).sum())

    scale = min(proposals, key=cost)
    kept = steps.find_fitting(scale)
    for _ in range(_ROUNDS):
        if not kept.any():
            break
        scale = _minimize_cost(steps, scale, kept)
        now = steps.find_fitting(scale)
        if (now == kept).all():
            break
        kept = now
    return scale, kept


def _minimize_cost(steps: _MotionSteps, near: float, kept: Mask) -> float:
    """The unit with the least squares, errors of the cameras counted like those of the motions."""

    def cost(log: float) -> float:
        return steps.cost(near * math.exp(log), kept)

    span = math.log(2.0)
    found = minimize_scalar(cost, bounds=(-span, span), method="bounded", options={"xatol": 1e-6})
    return near * math.exp(float(found.x))


def _estimate_sigma(steps: _MotionSteps, scale: float, kept: Mask) -> float:
    """Standard deviation of the log of the unit; wider where motions scatter more than they should."""
    length = (scale * steps.scene * steps.given).sum(1) / np.maximum(np.linalg.norm(steps.given, axis=1), 1e-12)
    sigma = np.hypot(steps.sigma_m, scale * steps.bounds)
    known = float(((length[kept] / sigma[kept]) ** 2).sum())
    wider = max(1.0, steps.cost(scale, kept) / max(3 * int(kept.sum()) - 1, 1))
    return math.inf if known <= 0 else math.sqrt(wider / known)


# Where up is in a scene, by what an IMU says of gravity in the frames of its cameras.


_MAX_SIGMAS_2D = 3.44  # standard deviations in two dimensions: what one has within 3 in one dimension, 99.7 %
_SHARED_DEG = 0.5  # standard deviation of an error that all have alike: how the IMU is mounted


def estimate_up(views: Mapping[str, MetricView], gravities: Mapping[str, Gravity]) -> Up | None:
    """Up in the world of the cameras; None where nothing was said, or less than 60 % of it agrees.

    The source names the photographs whose gravity was left out because it does not fit the others.
    """
    names = [name for name in views if name in gravities]
    if not names:
        return None
    ups = np.stack([-views[name].T_world_camera[:3, :3] @ gravities[name].direction for name in names])
    sigmas = np.array([gravities[name].sigma_deg for name in names])
    up = ups[np.argmin([_compute_truncated_cost(ups, sigmas, each) for each in ups])]
    kept = np.zeros(len(names), bool)
    for _ in range(_ROUNDS):
        fits = _compute_angles_deg(ups, up) < _MAX_SIGMAS_2D * np.hypot(sigmas, _SHARED_DEG)
        if not fits.any() or (fits == kept).all():
            break
        kept = fits
        mean = (ups[kept] / sigmas[kept, None] ** 2).sum(0)
        up = mean / np.linalg.norm(mean)
    if kept.sum() < math.ceil(_LEAST_FITTING * len(names)):
        return None
    wider = max(
        1.0, float(((_compute_angles_deg(ups[kept], up) / sigmas[kept]) ** 2).sum()) / max(2 * int(kept.sum()) - 2, 1)
    )
    sigma = math.hypot(math.sqrt(wider / float((sigmas[kept] ** -2.0).sum())), _SHARED_DEG)
    x, y, z = up.tolist()
    return Up((x, y, z), sigma, _source(names, kept))


def _source(names: list[str], kept: npt.NDArray[np.bool_]) -> str:
    left_out = [name for name, fits in zip(names, kept, strict=True) if not fits]
    said = f"gravity in {kept.sum()} photographs"
    return f"{said}; that of {', '.join(left_out)} was left out: it does not fit the others" if left_out else said


def _compute_truncated_cost(ups: Array, sigmas: Array, up: Array) -> float:
    return float(np.minimum((_compute_angles_deg(ups, up) / sigmas) ** 2, _MAX_SIGMAS_2D**2).sum())


def _compute_angles_deg(ups: Array, up: Array) -> Array:
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(ups, up), axis=1), ups @ up))


# Unit and orientation by poses that others estimated: odometry, a tracker, a drone's log.
#
# The cameras of the scene are carried onto the poses by the similarity that most of them agree on. A pose that does
# not fit is named and left out. Neither the photographs' cameras nor the scene are changed by them otherwise.


_MAX_SIGMAS_3D = 3.76  # standard deviations in three dimensions: what one has within 3 in one dimension, 99.7 %
# What poses that scatter more than was given are believed to scatter at most: as a share of their spread, and degrees.
_MOST_SHARE, _MOST_DEG = 0.05, 15.0
_DRIFT_LEFT = 0.5  # of the drift at the end of the way, in one direction: what is left of it beside the best similarity
_TO_SIGMA = 0.65  # standard deviation in one dimension over the median length in three
_MOST_PAIRS = 500  # of cameras, each of which proposes a similarity
# Standard deviations of a camera of the scene, at least: radians, and a share of the poses' spread
_LEAST_TURN, _LEAST_SHIFT = math.radians(0.01), 1e-4


@dataclass(frozen=True, eq=False)
class PoseAlignment:
    """The alignment of a scene to given poses."""

    unit: Measurement
    to_world: Similarity  # from the scene to the world of the poses
    centre: Array  # (3,) mean of the cameras that count, in the scene
    notes: tuple[str, ...]  # a sentence for each pose that was left out
    placement: PosePlacement | None = None  # by the errors that the poses have; None: nothing is known of these

    def rescale(self, scale: float) -> Similarity:
        """The similarity with another scale, where the poses place that; else with the cameras' middle where it is."""
        if self.placement is not None:
            return self.placement.place(scale)
        rotation = self.to_world.rotation
        return Similarity(scale, rotation, self.to_world(self.centre) - scale * rotation @ self.centre)


@dataclass(frozen=True)
class PoseSigmas:
    """Standard deviations of given poses."""

    position_m: float  # of each position, in each direction
    rotation_deg: float  # of each orientation, about each axis
    drift: float  # of the error that has grown at the end of the way, as a share of the way


@dataclass(frozen=True, eq=False)
class _CameraPairs:
    """Cameras of the scene and the poses given for them."""

    names: tuple[str, ...]
    scene: Array  # (C, 4, 4)
    given: Array  # (C, 4, 4)
    bounds: Array  # (C,) 95 % of the cameras' centres, in the scene's unit
    bounds_deg: Array  # (C,) and of their orientations, degrees

    @classmethod
    def collect(cls, views: Mapping[str, MetricView], poses: Mapping[str, Array]) -> _CameraPairs:
        """The cameras that have a pose, in the order of the views."""
        chosen = {name: view for name, view in views.items() if name in poses}
        return cls(
            tuple(chosen),
            np.stack([view.T_world_camera for view in chosen.values()]),
            np.stack([poses[name] for name in chosen]),
            np.array([view.bound for view in chosen.values()]),
            np.array([view.bound_deg for view in chosen.values()]),
        )

    def make_scene_sigmas(self, scale: float) -> Array:
        """(C, 2) standard deviations of the cameras' turns, radians, and of their centres, metres, at most.

        Bounds hold what all cameras have wrong together, too: how the scene is bent.
        """
        return np.column_stack([np.radians(self.bounds_deg), scale * self.bounds]) / TWO_SIDED_95

    @property
    def least_sigmas(self) -> Array:
        """(2,) likewise, at least."""
        return np.array([_LEAST_TURN, _LEAST_SHIFT * compute_rms_radius(self.given[:, :3, 3])])

    def compute_errors(self, by: Similarity) -> tuple[Array, Array]:
        """Metres (C,) and degrees (C,) by which each pose is off."""
        turned = by.rotation @ self.scene[:, :3, :3]
        return np.linalg.norm(by(self.scene[:, :3, 3]) - self.given[:, :3, 3], axis=1), angles_deg(
            turned, self.given[:, :3, :3]
        )

    def sigma_m(self, by: Similarity, position_m: Array) -> Array:
        """(C,) standard deviation of the difference in each direction."""
        return np.hypot(position_m, by.scale * self.bounds / TWO_SIDED_95)


def align_to_poses(
    views: Mapping[str, MetricView],
    poses: Mapping[str, Array],
    sigmas: PoseSigmas,
    own: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> PoseAlignment | str:
    """Aligns the scene to `poses` (4, 4) T_world_camera, metres, by image name; else returns why not.

    `views` are in the order of the way, along which poses drift. Where poses scatter more than `sigmas` say, what they
    scatter counts. `own` are the standard deviations, metres and degrees, of poses that have their own.
    """
    names = tuple(name for name in views if name in poses)
    if len(names) < 2:
        return f"poses were given, and {len(names) or 'none'} of them is of a camera of the scene; two are needed"
    pairs = _CameraPairs.collect(views, poses)
    usual = sigmas.position_m, sigmas.rotation_deg
    position_m, rotation_deg = np.array([own.get(name, usual) for name in names]).T
    if compute_rms_radius(pairs.given[:, :3, 3]) <= np.median(position_m):
        return f"poses of {len(names)} photographs were given, which are not farther apart than they are unsure"
    by, kept, scattered_deg = _find_pose_consensus(pairs, position_m, rotation_deg, sigmas.drift)
    if kept.sum() < _count_required(len(names)):
        return (
            f"poses of {len(names)} photographs were given, of which no more than {kept.sum()} fit the cameras of the "
            "scene: are they of the cameras, with x right, y down and z forward, and in metres?"
        )
    noise = _describe_noise(pairs, by, position_m, rotation_deg, sigmas.drift)
    placement = fit_placement(pairs.scene, pairs.given, by, kept, noise)
    kept = placement.fits
    by, sigma = _refine_similarity(pairs, by, kept, position_m, scattered_deg, sigmas.drift)
    off_m, off_deg = pairs.compute_errors(by)
    notes = tuple(
        f"the pose of {name} was left out: it is {_format_error(off_m[i], off_deg[i], scattered_deg[i])} off"
        for i, name in enumerate(names)
        if not kept[i]
    )
    unit = Measurement(by.scale, sigma, f"poses of {kept.sum()} photographs")
    return PoseAlignment(unit, placement.place(by.scale), pairs.scene[kept, :3, 3].mean(0), notes, placement)


def _describe_noise(
    pairs: _CameraPairs, by: Similarity, position_m: Array, rotation_deg: Array, drift: float
) -> PoseNoise:
    """Describes the errors as they were told: at the end of the way turns have grown to the drift, in radians."""
    steps = np.linalg.norm(np.diff(pairs.given[:, :3, 3], axis=0), axis=1)
    turns = np.radians(angles_deg(pairs.given[:-1, :3, :3], pairs.given[1:, :3, :3]))
    ahead = steps / max(float(steps.sum()), 1e-12)  # shares of the way, and of all turns
    turned = (ahead + turns / max(float(turns.sum()), 1e-12)) / 2.0
    grown = np.column_stack([drift * np.sqrt(turned), drift * steps.sum() * np.sqrt(ahead / 3.0)])
    own = np.hypot(np.column_stack([np.radians(rotation_deg), position_m]), pairs.make_scene_sigmas(by.scale))
    return PoseNoise(own, np.vstack([np.zeros(2), grown]), pairs.least_sigmas)


def align_to_motions(
    views: Mapping[str, MetricView], motions: Mapping[str, Motion], poses: Mapping[str, Array]
) -> PosePlacement | str:
    """Places the scene in the frame in which one chain of motions began; else returns why it cannot.

    `poses` are the (4, 4) T_start_camera to which the motions add up, by image name. A motion that the images
    contradict parts what follows it from the start. `views` are in the order of the way.
    """
    steps = _collect_steps(views, {name: each for name, each in motions.items() if name in poses})
    names = [name for name in views if name in poses]
    if steps is None or len(steps.names) < len(names) - 1:
        return f"motions of {len(names)} images were given, which are not in the order of their chain"
    _, fitting = _find_consensus(steps)
    pairs = _CameraPairs.collect(views, poses)
    grown = np.vstack([np.zeros(2), np.column_stack([np.radians(steps.sigma_deg), steps.sigma_m])])
    turn = pairs.given[0, :3, :3] @ pairs.scene[0, :3, :3].T
    scale = compute_rms_radius(pairs.given[:, :3, 3]) / max(compute_rms_radius(pairs.scene[:, :3, 3]), 1e-12)
    begun = Similarity(scale, turn, pairs.given[0, :3, 3] - scale * turn @ pairs.scene[0, :3, 3])
    own = np.hypot(np.median(grown[1:], axis=0), pairs.make_scene_sigmas(scale))
    noise = PoseNoise(own, grown, pairs.least_sigmas)
    noise = part_steps(noise, np.concatenate([[False], ~fitting]), float(np.ptp(pairs.given[:, :3, 3], axis=0).max()))
    return fit_placement(pairs.scene, pairs.given, begun, np.ones(len(names), bool), noise)


def _format_error(metres: float, degrees: float, rotation_deg: float) -> str:
    turned = f"{degrees:.2g} degrees" if degrees > _MAX_SIGMAS_3D * rotation_deg else ""
    return " and ".join(filter(None, (f"{metres:.2g} m", turned)))


def _find_pose_consensus(
    pairs: _CameraPairs, position_m: Array, rotation_deg: Array, drift: float
) -> tuple[Similarity, Mask, Array]:
    """The similarity, which poses fit it, and the standard deviations (C,) of the orientations among them, degrees.

    First with what was given; where too few fit then, with what the poses scatter.
    """
    way = float(np.linalg.norm(np.diff(pairs.given[:, :3, 3], axis=0), axis=1).sum())
    position_m = np.hypot(position_m, _DRIFT_LEFT * drift * way)
    by = _propose_similarity(pairs, position_m, rotation_deg)
    by, kept = _refine_inliers(pairs, by, position_m, rotation_deg)
    if kept.sum() < _count_required(len(kept)):
        off_m, off_deg = pairs.compute_errors(_propose_similarity(pairs, position_m, rotation_deg, by_most=True))
        least_m = min(_MOST_SHARE * compute_rms_radius(pairs.given[:, :3, 3]), _TO_SIGMA * float(np.median(off_m)))
        least_deg = min(_MOST_DEG, _TO_SIGMA * float(np.median(off_deg)))
        position_m, rotation_deg = np.maximum(position_m, least_m), np.maximum(rotation_deg, least_deg)
        by, kept = _refine_inliers(
            pairs, _propose_similarity(pairs, position_m, rotation_deg), position_m, rotation_deg
        )
    return by, kept, rotation_deg


def _count_required(count: int) -> int:
    """Returns how many of `count` poses must fit."""
    return max(2, math.ceil(_LEAST_FITTING * count))


def _refine_inliers(
    pairs: _CameraPairs, by: Similarity, position_m: Array, rotation_deg: Array
) -> tuple[Similarity, Mask]:
    """The similarity that the poses which fit it agree on."""
    kept = np.zeros(len(pairs.names), bool)
    for _ in range(_ROUNDS):
        off_m, off_deg = pairs.compute_errors(by)
        fits = (off_m < _MAX_SIGMAS_3D * pairs.sigma_m(by, position_m)) & (off_deg < _MAX_SIGMAS_3D * rotation_deg)
        if fits.sum() < 2 or (fits == kept).all():
            return by, fits
        kept = fits
        by, _ = _refine_similarity(pairs, by, kept, position_m, rotation_deg)
    return by, kept


def _propose_similarity(
    pairs: _CameraPairs, position_m: Array, rotation_deg: Array, by_most: bool = False
) -> Similarity:
    """Returns the similarity that the poses fit best, of those of two cameras each and that of all.

    What does not fit counts no more than what hardly does; `by_most`: by the median, however far the others are off.
    """
    chosen = list(combinations(range(len(pairs.names)), 2))
    chosen = chosen[:: -(-len(chosen) // _MOST_PAIRS)]
    proposals = [align_cameras(pairs.scene[list(two)], pairs.given[list(two)]) for two in chosen]
    proposals.append(align_cameras(pairs.scene, pairs.given))

    def cost(by: Similarity) -> float:
        off_m, off_deg = pairs.compute_errors(by)
        squares = (off_m / pairs.sigma_m(by, position_m)) ** 2 + (off_deg / rotation_deg) ** 2
        return float(np.median(squares) if by_most else np.minimum(squares, 2.0 * _MAX_SIGMAS_3D**2).sum())

    return min(proposals, key=cost)


def _refine_similarity(
    pairs: _CameraPairs, by: Similarity, kept: Mask, position_m: Array, rotation_deg: Array, drift: float = 0.0
) -> tuple[Similarity, float]:
    """The similarity with the least weighted squares over the poses that are kept; sigma of its log scale.

    With `drift`, errors of positions that follow one another are alike: they grow at random along the way.
    """
    scene, given = pairs.scene[kept], pairs.given[kept]
    middle, size = scene[:, :3, 3].mean(0), by.scale * max(compute_rms_radius(scene[:, :3, 3]), 1e-12)
    covariance = np.diag(pairs.sigma_m(by, position_m)[kept] ** 2) + _compute_drift_covariance(given[:, :3, 3], drift)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))

    def move_similarity(values: Array) -> Similarity:
        rotation = Rotation.from_rotvec(values[:3]).as_matrix() @ by.rotation
        scale = by.scale * math.exp(values[6])
        return Similarity(scale, rotation, by(middle) + size * values[3:6] - scale * rotation @ middle)

    def errors(values: Array) -> Array:
        to = move_similarity(values)
        positions = whitening @ (to(scene[:, :3, 3]) - given[:, :3, 3])
        turns = Rotation.from_matrix(np.swapaxes(given[:, :3, :3], 1, 2) @ to.rotation @ scene[:, :3, :3]).as_rotvec()
        return np.concatenate([positions.ravel(), (turns / np.radians(rotation_deg[kept])[:, None]).ravel()])

    found = least_squares(errors, np.zeros(7), method="lm", x_scale=np.full(7, 0.01))
    of_values = np.linalg.pinv(found.jac.T @ found.jac)
    wider = max(1.0, 2.0 * found.cost / max(6 * len(scene) - 7, 1))  # where they scatter more than they should
    return move_similarity(found.x), math.sqrt(max(float(of_values[6, 6]) * wider, 0.0))


def _compute_drift_covariance(positions: Array, drift: float) -> Array:
    """(C, C) covariance, in each direction, of errors that add up step by step to `drift` of the way at its end."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    return drift**2 / 3.0 * way[-1] * np.minimum(way[:, None], way[None, :])
