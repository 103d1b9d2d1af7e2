"""Rigs: cameras that took their images together stand as they always do, by what is given or by all frame sets.

Images are registered by themselves first. Then it is tested whether the cameras of each frame set stand alike, and a
joint adjustment gives each set one pose and each camera a mount; images that no match placed are placed by these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from splatnode.capture.frame import Stamp
from splatnode.capture.rig import FrameSet, Rig, RigCamera, form_frame_sets
from splatnode.recon.geometry import cross_matrix
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.registration import bundle_adjustment, known_poses
from splatnode.recon.registration.bundle_adjustment import RigConstraint
from splatnode.recon.registration.incremental_mapper import MapperResult

# How the cameras of frame sets stand to each other: single measurements, one a set, and where they change.
#
# Whether a camera moved on its rig is a question of time: its pose as the sets before tell it, against that of those
# after. Errors of single sets that are larger than they claim, as of cameras that are not triggered together, make
# each measurement less sure, and no change of the rig.

Array = npt.NDArray[np.float64]

LEAST_PROBABILITY = 1e-5  # of a false alarm, as of given poses
STIFF_TURN = np.radians(0.005)  # by which cameras of a rig turn against each other in use: nothing is stiffer
STIFF_SHIFT = 2e-4  # and shift, as a share of the distance to the scene
MOST_SCATTER_TURN = np.radians(1.0)  # of a frame set: a camera that turns more is on an arm, and on no rig
MOST_SCATTER_SHIFT = 0.03  # likewise, as a share of the distance to the scene
_LEAST_RUN = 4  # frame sets that a camera stands still, in the mean, if it moves on its rig now and then
_MEDIAN_OF_CHI2_3 = 2.366
_ENOUGH_DIFFERENCES = 4  # between sets, to know how much their measurements scatter


@dataclass(frozen=True, eq=False)
class RelativePoses:
    """T_reference_camera of one camera by S frame sets, in the order of time."""

    sets: tuple[int, ...]  # (S,)
    rotations: Array  # (S, 3, 3)
    centres: Array  # (S, 3)
    covariances: Array  # (S, 6, 6) of the turn in the reference's axes, radians, and of the centre
    scatter: tuple[float, float] = (0.0, 0.0)  # variances of turn and shift of a set, which the covariances have, too

    @cached_property
    def mounts(self) -> list[list[int]]:
        """Positions that agree on one pose, the most first; see `find_mounts`."""
        return find_mounts(self)

    def select(self, positions: Sequence[int]) -> RelativePoses:
        """Returns those of some positions."""
        at = list(positions)
        sets = tuple(self.sets[i] for i in at)
        return RelativePoses(sets, self.rotations[at], self.centres[at], self.covariances[at], self.scatter)

    def widen(self, turn: float, shift: float) -> RelativePoses:
        """Returns them with these variances added in each direction."""
        further = np.diag([turn] * 3 + [shift] * 3)
        scatter = float(self.scatter[0] + turn), float(self.scatter[1] + shift)
        return RelativePoses(self.sets, self.rotations, self.centres, self.covariances + further, scatter)

    def residuals(self, rotation: Array, centre: Array) -> Array:
        """(S, 6) turns and shifts from a pose."""
        turns = Rotation.from_matrix(self.rotations @ rotation.T).as_rotvec()
        return np.column_stack([turns, self.centres - centre])

    def mean(self) -> tuple[Array, Array, Array]:
        """Rotation (3, 3), centre (3,) and covariance (6, 6) of the mean, each weighed by its inverse covariance."""
        rotation, centre = self.rotations[len(self.sets) // 2], np.median(self.centres, 0)
        weights = np.linalg.inv(self.covariances)
        covariance = np.linalg.inv(weights.sum(0))
        for _ in range(3):
            step = covariance @ np.einsum("sij,sj->i", weights, self.residuals(rotation, centre))
            rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
            centre = centre + step[3:]
        return rotation, centre, covariance


def measure_relative_poses(
    problem: bundle_adjustment.Problem, joint: Array, pairs: Mapping[int, tuple[int, int]]
) -> RelativePoses:
    """The pose of a camera in another's frame by each frame set, of which `pairs` has (reference view, view).

    `joint` (6 C, 6 C) is the covariance of the views' poses. Sets without a finite covariance are left out.
    """
    sets, rotations, centres, covariances = [], [], [], []
    for index, (reference, view) in pairs.items():
        X = problem.rotations[reference] @ problem.rotations[view].T
        placed = X @ problem.translations[view]
        by = np.zeros((6, 12))
        by[:3, :3], by[:3, 6:9] = np.eye(3), -X
        by[3:] = cross_matrix(placed[None])[0] @ by[:3]
        by[3:, 3:6] = np.eye(3)
        by[3:, 9:12] = -X
        rows = np.r_[6 * reference : 6 * reference + 6, 6 * view : 6 * view + 6]
        covariance = by @ joint[np.ix_(rows, rows)] @ by.T
        if not np.isfinite(covariance).all():
            continue
        sets.append(index)
        rotations.append(X)
        centres.append(problem.translations[reference] - placed)
        covariances.append((covariance + covariance.T) / 2.0)
    count = len(sets)
    return RelativePoses(
        tuple(sets),
        np.reshape(rotations, (count, 3, 3)),
        np.reshape(centres, (count, 3)),
        np.reshape(covariances, (count, 6, 6)),
    )


def estimate_scatter(poses: RelativePoses) -> tuple[float, float]:
    """The variances of turns and of shifts that single sets have beyond what they claim; 0 where there is none.

    By differences between one set and the next: a change of the rig is in one of them only.
    """
    if len(poses.sets) - 1 < _ENOUGH_DIFFERENCES:
        return 0.0, 0.0
    turns = Rotation.from_matrix(poses.rotations[1:] @ np.swapaxes(poses.rotations[:-1], 1, 2)).as_rotvec()
    found = []
    for differences, part in ((turns, slice(0, 3)), (np.diff(poses.centres, axis=0), slice(3, 6))):
        claimed = np.median(np.trace(poses.covariances[:, part, part], axis1=1, axis2=2)) / 3.0
        seen = float(np.median((differences**2).sum(1))) / (2.0 * _MEDIAN_OF_CHI2_3)
        found.append(max(0.0, seen - float(claimed)))
    return found[0], found[1]


def compare(one: tuple[Array, Array, Array], other: tuple[Array, Array, Array]) -> float:
    """The probability that two poses, each with a covariance, differ as much by chance."""
    turn = Rotation.from_matrix(one[0] @ other[0].T).as_rotvec()
    error = np.concatenate([turn, one[1] - other[1]])
    return float(chdtrc(6, error @ np.linalg.solve(one[2] + other[2], error)))


def is_mounted(poses: RelativePoses, distance: float) -> bool:
    """Whether a camera is on a rig with the reference: it stands still to it, or moves once and again, as by a blow.

    A camera on an arm moves all the time. `distance` is that to the scene.
    """
    if poses.scatter[0] > MOST_SCATTER_TURN**2 or poses.scatter[1] > (MOST_SCATTER_SHIFT * distance) ** 2:
        return False
    parts, count = poses.mounts, len(poses.sets)
    return len(parts[0]) > 1 and (2 * len(parts[0]) > count or _LEAST_RUN * len(parts) <= count)


def find_mounts(poses: RelativePoses) -> list[list[int]]:
    """Positions of `poses` that agree on one pose, the most first: more than one where the camera moved."""
    parts = _split(poses, list(range(len(poses.sets))))
    parts.sort(key=lambda part: (-len(part), part[0]))
    mounts: list[list[int]] = []
    for part in parts:
        mean = poses.select(part).mean()
        like = [compare(poses.select(mount).mean(), mean) for mount in mounts]
        if like and max(like) >= LEAST_PROBABILITY:
            mounts[int(np.argmax(like))].extend(part)
        else:
            mounts.append(part)
    return [sorted(mount) for mount in sorted(mounts, key=lambda mount: (-len(mount), mount[0]))]


def _split(poses: RelativePoses, positions: list[int]) -> list[list[int]]:
    """The positions in runs without a change."""
    if len(positions) < 2:
        return [positions]
    found = [
        compare(poses.select(positions[:at]).mean(), poses.select(positions[at:]).mean())
        for at in range(1, len(positions))
    ]
    best = int(np.argmin(found))
    if found[best] * len(found) >= LEAST_PROBABILITY:
        return [positions]
    return _split(poses, positions[: best + 1]) + _split(poses, positions[best + 1 :])


# A rig that is given, against what the images tell of it: which of it is believed, and how long its unit is.

# Rotation, centre and covariance in the reference's frame, by camera
MountPoses = Mapping[str, tuple[Array, Array, Array]]

_ROUNDS = 20  # of the fit of the scale
_LEAST_BASELINE = 2.0  # sigmas by which two cameras must be apart to tell a scale


@dataclass(frozen=True)
class MountResidual:
    """How far a camera of the given rig is from where the images have it."""

    camera_id: str
    beside: str  # the camera from which both are counted
    degrees: float
    metres: float
    sigma_deg: float  # of both together, by the given sigmas and what the images leave open
    sigma_m: float


@dataclass(frozen=True, eq=False)
class GivenMounts:
    """The given mounts that are believed, in the frame of the reference, metres."""

    believed: Mapping[str, tuple[Array, Array, Array]]
    refuted: tuple[str, ...]
    metres_per_unit: float | None
    reference: str
    residuals: tuple[MountResidual, ...] = ()  # of cameras that are not believed
    is_inverse: bool = False  # the images fit the inverses of all given poses

    def hold(self, camera: str) -> tuple[Array, Array, tuple[float, float]]:
        """Rotation, centre and sigmas by which the adjustment holds a mount, in the unit of the model."""
        if self.metres_per_unit is None or camera not in self.believed:
            return np.eye(3), np.zeros(3), (np.inf, np.inf)
        rotation, centre, covariance = self.believed[camera]
        turn, shift = (float(np.sqrt(np.trace(covariance[b, b]) / 3.0)) for b in (slice(0, 3), slice(3, 6)))
        return rotation.T, centre / self.metres_per_unit, (turn, shift / self.metres_per_unit)

    def fit_scale(self, mount_poses: MountPoses) -> tuple[float | None, float]:
        """Metres a unit of the model, and the standard deviation of its logarithm."""
        chosen = {camera: mount_poses[camera] for camera in self.believed if camera in mount_poses}
        fitted = _fit(chosen, self.believed, list(chosen)) if self.metres_per_unit is not None and chosen else None
        return (None, np.inf) if fitted is None else fitted[:2]


def fit_given_rig(rig: Rig | None, reference: str, mount_poses: MountPoses) -> GivenMounts:
    """Which given mounts the images do not contradict: those of all cameras, or of all but the one that is wrong."""
    known = {} if rig is None else {each.camera_id: each for each in rig.cameras if each.matrix is not None}
    names = [camera for camera in (reference, *sorted(mount_poses)) if camera in known]
    if len(names) < 2:
        return GivenMounts({}, (), None, reference)
    fits = [chosen for chosen in _choices(names) if _is_consistent(known, mount_poses, chosen, reference)]
    best = [chosen for chosen in fits if len(chosen) == len(fits[0])]
    if len(best) != 1:
        residuals = [_measure_residual(known, mount_poses, camera, names[0], reference) for camera in names[1:]]
        turned = {camera: _invert(each) for camera, each in known.items()}
        is_inverse = _is_consistent(turned, mount_poses, names, reference)
        return GivenMounts({}, tuple(names), None, reference, tuple(residuals), is_inverse)
    believed = _relative_to(known, reference, best[0]) if reference in best[0] else {}
    fitted = _fit(mount_poses, believed, list(believed)) if believed else None
    refuted = tuple(camera for camera in names if camera not in best[0])
    first = reference if reference in best[0] else best[0][0]
    residuals = tuple(_measure_residual(known, mount_poses, camera, first, reference) for camera in refuted)
    return GivenMounts(believed, refuted, None if fitted is None else fitted[0], reference, residuals)


def _measure_residual(
    known: Mapping[str, RigCamera], mount_poses: MountPoses, camera: str, first: str, reference: str
) -> MountResidual:
    """How far the given pose of a camera beside `first` is from the images', in the unit that fits all given ones."""
    given = _relative_to(known, first, list(known))
    seen = {c: mount_poses[c] if first == reference else _between(mount_poses, first, c, reference)
            for c in given if c == reference or c in mount_poses}  # fmt: skip
    lengths = [(float(np.linalg.norm(given[c][1])), float(np.linalg.norm(seen[c][1]))) for c in seen]
    unit = sum(apart for _, apart in lengths)
    scale = sum(metres for metres, _ in lengths) / unit if unit > 0.0 else 0.0
    (R, c, of_seen), (R_given, c_given, of_given) = seen[camera], given[camera]
    both = np.diag([1.0] * 3 + [scale] * 3) @ of_seen @ np.diag([1.0] * 3 + [scale] * 3) + of_given
    turn, shift = (float(np.sqrt(np.trace(both[b, b]) / 3.0)) for b in (slice(0, 3), slice(3, 6)))
    return MountResidual(
        camera,
        first,
        degrees=float(np.degrees(Rotation.from_matrix(R_given @ R.T).magnitude())),
        metres=float(np.linalg.norm(c_given - scale * c)),
        sigma_deg=float(np.degrees(turn)),
        sigma_m=shift,
    )


def _invert(camera: RigCamera) -> RigCamera:
    """The camera with the inverse of its given pose."""
    return replace(camera, T_rig_camera=tuple(np.linalg.inv(_matrix(camera)).ravel().tolist()))


def _choices(names: Sequence[str]) -> list[tuple[str, ...]]:
    """All cameras, then all but one."""
    few = list(combinations(names, len(names) - 1)) if len(names) > 2 else []
    return [tuple(names), *few]


def _is_consistent(
    known: Mapping[str, RigCamera], mount_poses: MountPoses, chosen: Sequence[str], reference: str
) -> bool:
    first = reference if reference in chosen else chosen[0]
    given = _relative_to(known, first, chosen)
    seen = (
        mount_poses
        if first == reference
        else {c: _between(mount_poses, first, c, reference) for c in chosen if c != first}
    )
    fitted = _fit(seen, given, list(given))
    if fitted is None:
        # Cameras in one place tell no scale: only how they are turned can be compared.
        return all(_turn_probability(seen[c], given[c]) >= LEAST_PROBABILITY for c in given)
    return fitted[2] >= LEAST_PROBABILITY


def _relative_to(
    known: Mapping[str, RigCamera], first: str, chosen: Sequence[str]
) -> dict[str, tuple[Array, Array, Array]]:
    """The given poses of the other cameras in the frame of `first`, with what both sigmas amount to."""
    found = {}
    base = _matrix(known[first])
    for camera in chosen:
        if camera == first:
            continue
        T = np.linalg.inv(base) @ _matrix(known[camera])
        u, _, vt = np.linalg.svd(T[:3, :3])
        covariance = np.zeros((6, 6))
        turn_of_first = np.radians(known[first].sigma_deg) ** 2
        covariance[:3, :3] = (turn_of_first + np.radians(known[camera].sigma_deg) ** 2) * np.eye(3)
        lever = cross_matrix(T[None, :3, 3])[0]
        covariance[3:, 3:] = (known[first].sigma_m ** 2 + known[camera].sigma_m ** 2) * np.eye(3)
        covariance[3:, 3:] += turn_of_first * lever @ lever.T
        found[camera] = u @ vt, T[:3, 3], covariance
    return found


def _matrix(camera: RigCamera) -> Array:
    if camera.matrix is None:
        raise AssertionError("these cameras have a pose on their rig")
    return camera.matrix


def _between(mount_poses: MountPoses, first: str, camera: str, reference: str) -> tuple[Array, Array, Array]:
    """The pose of a camera in the frame of `first`, from both poses in that of the reference."""
    R, c, covariance = mount_poses[first]
    if camera == reference:
        other, centre, of_other = np.eye(3), np.zeros(3), np.zeros((6, 6))
    else:
        other, centre, of_other = mount_poses[camera]
    away = centre - c
    by = np.eye(6)
    by[3:, :3] = cross_matrix(away[None])[0]
    turn = np.kron(np.eye(2), R.T)
    return R.T @ other, R.T @ away, turn @ (by @ covariance @ by.T + of_other) @ turn.T


def _turn_probability(seen: tuple[Array, Array, Array], given: tuple[Array, Array, Array]) -> float:
    turn = Rotation.from_matrix(seen[0] @ given[0].T).as_rotvec()
    return float(chdtrc(3, turn @ np.linalg.solve((seen[2] + given[2])[:3, :3], turn)))


def _fit(seen: MountPoses, given: MountPoses, names: Sequence[str]) -> tuple[float, float, float] | None:
    """Metres a unit, the standard deviation of its logarithm, and the probability of what is left; None: no scale."""
    cameras = [camera for camera in names if camera in seen]
    if not cameras:
        return None
    lengths = [(float(np.linalg.norm(given[c][1])), float(np.linalg.norm(seen[c][1]))) for c in cameras]
    apart = [metres for c, (metres, _) in zip(cameras, lengths, strict=True)
             if metres > _LEAST_BASELINE * float(np.sqrt(np.trace(given[c][2][3:, 3:]) / 3.0))]  # fmt: skip
    unit = sum(unit for _, unit in lengths)
    if not apart or unit <= 0.0:
        return None
    scale = sum(metres for metres, _ in lengths) / unit
    information, squared = 0.0, 0.0
    for _ in range(_ROUNDS):
        top, information, squared = 0.0, 0.0, 0.0
        for camera in cameras:
            (R, c, of_seen), (R_given, c_given, of_given) = seen[camera], given[camera]
            units = np.diag([1.0] * 3 + [scale] * 3)
            inverse = np.linalg.inv(units @ of_seen @ units + of_given)
            error = np.concatenate([Rotation.from_matrix(R_given @ R.T).as_rotvec(), c_given - scale * c])
            by_log = np.concatenate([np.zeros(3), scale * c])
            top += by_log @ inverse @ error
            information += by_log @ inverse @ by_log
            squared += error @ inverse @ error
        if information <= 0.0:
            return None
        step = float(np.clip(top / information, -1.0, 1.0))
        scale *= float(np.exp(step))
        if abs(step) < 1e-9:
            break
    left = max(1, 6 * len(cameras) - 1)
    return scale, float(information**-0.5), float(chdtrc(left, squared))


# Rigs: cameras that took their images together stand as they always do, by what is given or by all frame sets.


_LEAST_SETS = 2  # that tell a mount: of a single one nothing says that it is fixed


@dataclass(frozen=True, eq=False)
class Mount:
    """The pose of a camera on its rig. Lengths are in the registration's unit, after the best scale of the scene."""

    camera_id: str
    T_rig_camera: Array  # (4, 4)
    covariance: Array  # (6, 6) of its turn in the rig's axes, radians, and of its centre; 0 of the rig's own camera
    sets: tuple[int, ...]  # numbers of the frame sets that have it so
    given: bool  # whether what was given holds it, too
    # Standard deviations of a single frame set from it, in each direction: of the turn, radians, and of the centre
    scatter: tuple[float, float] = (0.0, 0.0)

    @property
    def sigma_deg(self) -> float:
        """Standard deviation about the axis in which it is least known, degrees."""
        return float(np.degrees(np.sqrt(max(0.0, np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))))

    @property
    def sigma(self) -> float:
        """Standard deviation of the centre in the direction in which it is least known."""
        return float(np.sqrt(max(0.0, np.linalg.eigvalsh(self.covariance[3:, 3:])[-1])))


@dataclass(frozen=True)
class RigChange:
    """A change of a rig: from a frame set on, a camera stands otherwise than in most others."""

    camera_ids: tuple[str, ...]  # one of these: of two cameras nothing tells which
    first: int  # number of the first of these sets
    count: int  # of sets that have it so
    stamp: Stamp  # of the first
    degrees: float
    shift: float  # in the registration's unit


@dataclass(frozen=True, eq=False)
class RigEstimate:
    """The estimate of the rig that the cameras of a registration are on."""

    mounts: tuple[Mount, ...]  # the rig's own camera first; of a camera that moved, that of the most sets first
    frame_sets: tuple[FrameSet, ...]
    changes: tuple[RigChange, ...]
    refuted: tuple[str, ...]  # camera ids, of which one or more are given where they are not
    metres_per_unit: float | None  # by the given rig; None: it tells none
    scale_sigma: float  # standard deviation of its logarithm
    placed: tuple[int, ...]  # keyframes that the rig alone places
    residuals: tuple[MountResidual, ...] = ()  # of refuted cameras
    is_inverse: bool = False  # the images fit the inverses of all given poses

    @property
    def is_finite(self) -> bool:
        """Whether all is known that is claimed of the mounts."""
        return all(np.isfinite(m.covariance).all() and np.isfinite(m.T_rig_camera).all() for m in self.mounts)

    @property
    def num_given(self) -> int:
        """Returns of how many cameras the given poses count: the rig's own, and those whose mounts it holds."""
        held = {mount.camera_id for mount in self.mounts if mount.given}
        return 1 + len(held) if held else 0

    def rescale(self, unit: float) -> RigEstimate:
        """Returns it in a world whose unit is `unit` of this one's."""
        by = np.diag([1.0] * 3 + [1.0 / unit] * 3)
        mounts = []
        for mount in self.mounts:
            T = mount.T_rig_camera.copy()
            T[:3, 3] /= unit
            scatter = mount.scatter[0], mount.scatter[1] / unit
            mounts.append(replace(mount, T_rig_camera=T, covariance=by @ mount.covariance @ by, scatter=scatter))
        changes = tuple(replace(change, shift=change.shift / unit) for change in self.changes)
        metres = None if self.metres_per_unit is None else self.metres_per_unit * unit
        return replace(self, mounts=tuple(mounts), changes=changes, metres_per_unit=metres)

    def relabel(self, number: Sequence[int]) -> RigEstimate:
        """Returns it with keyframe i being keyframe `number[i]`."""
        return replace(self, placed=tuple(sorted(int(number[i]) for i in self.placed)))


@dataclass(frozen=True, eq=False)
class _Sets:
    """Views by frame set and camera."""

    frame_sets: tuple[FrameSet, ...]
    views: tuple[dict[str, int], ...]  # of each set, by camera id

    def pairs(self, reference: str, other: str, registered: frozenset[int]) -> dict[int, tuple[int, int]]:
        found = {}
        for index, views in enumerate(self.views):
            if {reference, other} <= views.keys() and {views[reference], views[other]} <= registered:
                found[index] = views[reference], views[other]
        return found


def form_sets(keyframes: Sequence[Keyframe], tolerance_s: float) -> tuple[FrameSet, ...]:
    """The frame sets of keyframes that have a camera id and a time."""
    known = [(k.name, k.frame.camera_id, k.frame.captured_at) for k in keyframes]
    formed = form_frame_sets([(n, c, at) for n, c, at in known if at is not None], tolerance_s)
    return tuple(replace(each, names=dict(each.names)) for each in formed)  # which processes can send each other


def adjust_with_rig(
    found: MapperResult, keyframes: Sequence[Keyframe], rig: Rig | None, tolerance_s: float
) -> tuple[MapperResult, RigEstimate] | None:
    """The model whose cameras stand on their rig, and what it tells; None where no two cameras have frame sets.

    Its views are `keyframes`. A view that only the rig places is no view of the model; its pose is in the estimate.
    """
    frame_sets = form_sets(keyframes, tolerance_s)
    number = {keyframe.name: index for index, keyframe in enumerate(keyframes)}
    by_camera = tuple({camera: number[name] for camera, name in each.names.items()} for each in frame_sets)
    sets = _Sets(frame_sets, by_camera)
    covariance = bundle_adjustment.covariance(found.estimate, found.prior, found.loss, found.views[0])
    distance = known_poses.distance(found.estimate, found.views)
    measured = _measure(found, sets, covariance.joint, distance)
    reference = _choose_reference(measured)
    if reference is None:
        return None
    mounts = {camera: poses for (first, camera), poses in measured.items() if first == reference}
    split = {c: [part for part in poses.mounts if len(part) >= _LEAST_SETS] for c, poses in mounts.items()}
    mount_means = {c: [mounts[c].select(part).mean() for part in parts] for c, parts in split.items() if parts}
    if not mount_means:
        return None
    given = fit_given_rig(rig, reference, {camera: means[0] for camera, means in mount_means.items()})
    estimate = replace(
        found.estimate, rotations=found.estimate.rotations.copy(), translations=found.estimate.translations.copy()
    )
    constraint, labels = _constrain(estimate, sets, reference, mounts, split, mount_means, given, distance, found.views)
    estimate = replace(estimate, rig=constraint)
    estimate = bundle_adjustment.adjust(estimate, found.prior, found.loss, found.views[0])
    adjusted = replace(found, estimate=estimate)
    rig_estimate = _describe(adjusted, sets, labels, measured, reference, given)
    return (adjusted, rig_estimate) if rig_estimate.is_finite else None


def _measure(found: MapperResult, sets: _Sets, joint: Array, distance: float) -> dict[tuple[str, str], RelativePoses]:
    """The relative poses of each ordered pair of cameras that are on one rig.

    They are as unsure as they scatter, and no surer than rigs are stiff.
    """
    ids = sorted({camera for views in sets.views for camera in views})
    measured = {}
    for first in ids:
        for other in ids:
            pairs = sets.pairs(first, other, frozenset(found.views))
            if first == other or len(pairs) < _LEAST_SETS:
                continue
            poses = measure_relative_poses(found.estimate, joint, pairs)
            if len(poses.sets) >= _LEAST_SETS:
                stiff = poses.widen(STIFF_TURN**2, (STIFF_SHIFT * distance) ** 2)
                scattered = stiff.widen(*estimate_scatter(stiff))
                if is_mounted(scattered, distance):
                    measured[first, other] = scattered
    return measured


def _choose_reference(measured: dict[tuple[str, str], RelativePoses]) -> str | None:
    """The camera that stands to the others as always in the most sets."""
    kept: dict[str, int] = {}
    for (first, _), poses in measured.items():
        kept[first] = kept.get(first, 0) + len(poses.mounts[0])
    return min(kept, key=lambda camera: (-kept[camera], camera)) if kept else None


def _constrain(
    problem: bundle_adjustment.Problem,
    sets: _Sets,
    reference: str,
    mounts: dict[str, RelativePoses],
    split: dict[str, list[list[int]]],
    mount_means: dict[str, list[tuple[Array, Array, Array]]],
    given: GivenMounts,
    distance: float,
    registered: Sequence[int],
) -> tuple[RigConstraint, list[tuple[str, tuple[int, ...]]]]:
    """The constraint, and of each mount its camera and the sets that have it; the reference's mount is the first.

    Views that are not registered get the pose in `problem` that the rig gives them.
    """
    count, every = len(problem.rotations), tuple(range(len(sets.views)))
    labels: list[tuple[str, tuple[int, ...]]] = [(reference, every)]
    rotations, translations = [np.eye(3)], [np.zeros(3)]
    stiff = STIFF_TURN, STIFF_SHIFT * distance
    of_mount, sigmas = np.full(count, -1), np.full((count, 2), np.inf)
    held = [(np.eye(3), np.zeros(3), (np.inf, np.inf))]
    for views in sets.views:
        if reference in views:
            of_mount[views[reference]], sigmas[views[reference]] = 0, stiff
    for camera, means in mount_means.items():
        poses = mounts[camera]
        scatter = np.sqrt(poses.scatter)
        for at, (part, (rotation, centre, _)) in enumerate(zip(split[camera], means, strict=True)):
            own = tuple(poses.sets[i] for i in part)
            released = {poses.sets[i] for i in range(len(poses.sets))} - set(own)
            also = [] if len(split[camera]) > 1 else [s for s in every if s not in released and camera in sets.views[s]]
            for index in {*own, *also}:
                of_mount[sets.views[index][camera]], sigmas[sets.views[index][camera]] = len(labels), scatter
            labels.append((camera, own))
            rotations.append(rotation.T)
            translations.append(-rotation.T @ centre)
            held.append(given.hold(camera) if at == 0 else held[0])
    of_set = np.full(count, -1)
    poses_of_sets: list[tuple[Array, Array]] = []
    for views in sets.views:
        tied = [view for view in views.values() if of_mount[view] >= 0]
        known = [view for view in tied if view in registered]
        if not known or len(tied) < 2:
            continue
        first = min(known, key=lambda view: (of_mount[view], view))
        R = rotations[of_mount[first]].T
        rig_pose = R @ problem.rotations[first], R @ (problem.translations[first] - translations[of_mount[first]])
        of_set[tied] = len(poses_of_sets)
        poses_of_sets.append(rig_pose)
        for view in tied:
            if view not in registered:
                M, m = rotations[of_mount[view]], translations[of_mount[view]]
                problem.rotations[view], problem.translations[view] = M @ rig_pose[0], M @ rig_pose[1] + m
    of_mount[of_set < 0] = -1
    constraint = RigConstraint(
        of_set, of_mount, np.where(of_set[:, None] < 0, np.inf, sigmas),
        np.reshape([R for R, _ in poses_of_sets], (-1, 3, 3)), np.reshape([t for _, t in poses_of_sets], (-1, 3)),
        np.stack(rotations), np.stack(translations), np.arange(len(labels)) == 0,
        np.stack([R for R, _, _ in held]), np.stack([c for _, c, _ in held]), np.array([s for _, _, s in held]),
    )  # fmt: skip
    return constraint, labels


def _describe(
    adjusted: MapperResult,
    sets: _Sets,
    labels: list[tuple[str, tuple[int, ...]]],
    measured: dict[tuple[str, str], RelativePoses],
    reference: str,
    given: GivenMounts,
) -> RigEstimate:
    problem = adjusted.estimate
    rig = problem.rig
    if rig is None:
        raise AssertionError("the map has a rig")
    covariances = _mount_covariances(adjusted)
    mounts = []
    for at, (camera, own) in enumerate(labels):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rig.mount_rotations[at].T, -rig.mount_rotations[at].T @ rig.mount_translations[at]
        is_held = bool(np.isfinite(rig.given_sigmas[at]).any())
        tied = rig.sigmas[rig.mount_of_camera == at]
        scatter = (float(tied[0, 0]), float(tied[0, 1])) if len(tied) else (0.0, 0.0)
        mounts.append(Mount(camera, T, covariances[at], own, is_held, scatter))
    mount_poses = {}
    for mount in mounts[1:]:
        mount_poses.setdefault(
            mount.camera_id, (mount.T_rig_camera[:3, :3], mount.T_rig_camera[:3, 3], mount.covariance)
        )
    again = given.fit_scale(mount_poses)
    placed = tuple(v for v in range(len(problem.rotations)) if rig.set_of_camera[v] >= 0 and v not in adjusted.views)
    changes = _find_changes(sets, measured, reference)
    contradiction = given.residuals, given.is_inverse
    return RigEstimate(tuple(mounts), sets.frame_sets, changes, given.refuted, *again, placed, *contradiction)


def _mount_covariances(adjusted: MapperResult) -> Array:
    """(M, 6, 6) of the mounts' turns in the rig's axes and centres, after the best scale of the cameras' centres."""
    problem, views = adjusted.estimate, list(adjusted.views)
    found = bundle_adjustment.covariance(problem, adjusted.prior, adjusted.loss, adjusted.views[0])
    rig = problem.rig
    if rig is None or found.rig is None:
        raise AssertionError("the map has a rig")
    count, joint = 6 * len(problem.rotations), found.rig
    _, moves = bundle_adjustment.differentiate_by_pose(problem.rotations, problem.translations)
    centres = bundle_adjustment.centres(problem)
    centred = np.zeros_like(centres)
    centred[views] = centres[views] - centres[views].mean(0)
    by_scale = np.zeros(len(joint))
    by_scale[:count] = centred.ravel() @ moves / max(float((centred**2).sum()), 1e-30)
    covariances = []
    for mount in range(rig.num_mounts):
        R, t = rig.mount_rotations[mount], rig.mount_translations[mount]
        turns, shifts = bundle_adjustment.differentiate_by_pose(R[None], t[None])
        by = np.zeros((6, len(joint)))
        own = slice(count + 6 * mount, count + 6 * mount + 6)
        by[:3, own], by[3:, own] = -turns, shifts
        if not rig.holds_scale:
            by[3:] -= np.outer(-R.T @ t, by_scale)
        covariances.append(by @ joint @ by.T)
    return np.stack(covariances)


def _find_changes(sets: _Sets, measured: dict[tuple[str, str], RelativePoses], reference: str) -> tuple[RigChange, ...]:
    """Says which cameras do not stand as in most sets, and from which set on."""
    found = []
    others = sorted({camera for first, camera in measured if first == reference})
    for camera in others:
        poses = measured[reference, camera]
        usual = poses.select(poses.mounts[0]).mean()
        for part in poses.mounts[1:]:
            rotation, centre, _ = poses.select(part).mean()
            turned = np.trace(rotation @ usual[0].T)
            first = poses.sets[part[0]]
            found.append(
                RigChange(
                    camera_ids=(camera,) if len(others) > 1 else (reference, camera),
                    first=first,
                    count=len(part),
                    stamp=sets.frame_sets[first].stamp,
                    degrees=float(np.degrees(np.arccos(np.clip((turned - 1.0) / 2.0, -1.0, 1.0)))),
                    shift=float(np.linalg.norm(centre - usual[1])),
                )
            )
    return tuple(sorted(found, key=lambda change: (change.first, change.camera_ids)))
