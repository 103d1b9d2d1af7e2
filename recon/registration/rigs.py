"""Rigs: cameras that took their images together stand as they always do, by what is given or by all frame sets.

Images are registered by themselves first. Then it is tested whether the cameras of each frame set stand alike, and a
joint adjustment gives each set one pose and each camera a mount; images that no match placed are placed by these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Stamp
from splatnode.capture.rig import FrameSet, Rig, form_frame_sets
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.registration import bundle_adjustment, known_poses, rig_poses
from splatnode.recon.registration.given_rig import GivenMounts, MountResidual, fit_given_rig
from splatnode.recon.registration.incremental_mapper import Map
from splatnode.recon.registration.rig_constraint import RigConstraint
from splatnode.recon.registration.rig_poses import RelativePoses

Array = npt.NDArray[np.float64]

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
    found: Map, keyframes: Sequence[Keyframe], rig: Rig | None, tolerance_s: float
) -> tuple[Map, RigEstimate] | None:
    """The map whose cameras stand on their rig, and what it tells; None where no two cameras have frame sets.

    Its views are `keyframes`. A view that only the rig places is no view of the map; its pose is in the estimate.
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
    told = {c: [mounts[c].select(part).mean() for part in parts] for c, parts in split.items() if parts}
    if not told:
        return None
    given = fit_given_rig(rig, reference, {camera: means[0] for camera, means in told.items()})
    estimate = replace(
        found.estimate, rotations=found.estimate.rotations.copy(), translations=found.estimate.translations.copy()
    )
    constraint, labels = _constrain(estimate, sets, reference, mounts, split, told, given, distance, found.views)
    estimate = replace(estimate, rig=constraint)
    estimate = bundle_adjustment.adjust(estimate, found.prior, found.loss, found.views[0])
    adjusted = replace(found, estimate=estimate)
    told_of_rig = _describe(adjusted, sets, labels, measured, reference, given)
    return (adjusted, told_of_rig) if told_of_rig.is_finite else None


def _measure(found: Map, sets: _Sets, joint: Array, distance: float) -> dict[tuple[str, str], RelativePoses]:
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
            poses = rig_poses.measure_relative_poses(found.estimate, joint, pairs)
            if len(poses.sets) >= _LEAST_SETS:
                stiff = poses.widen(rig_poses.STIFF_TURN**2, (rig_poses.STIFF_SHIFT * distance) ** 2)
                scattered = stiff.widen(*rig_poses.estimate_scatter(stiff))
                if rig_poses.is_mounted(scattered, distance):
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
    told: dict[str, list[tuple[Array, Array, Array]]],
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
    stiff = rig_poses.STIFF_TURN, rig_poses.STIFF_SHIFT * distance
    of_mount, sigmas = np.full(count, -1), np.full((count, 2), np.inf)
    held = [(np.eye(3), np.zeros(3), (np.inf, np.inf))]
    for views in sets.views:
        if reference in views:
            of_mount[views[reference]], sigmas[views[reference]] = 0, stiff
    for camera, means in told.items():
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
    adjusted: Map,
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
    told = {}
    for mount in mounts[1:]:
        told.setdefault(mount.camera_id, (mount.T_rig_camera[:3, :3], mount.T_rig_camera[:3, 3], mount.covariance))
    again = given.fit_scale(told)
    placed = tuple(v for v in range(len(problem.rotations)) if rig.set_of_camera[v] >= 0 and v not in adjusted.views)
    changes = _find_changes(sets, measured, reference)
    told_of_given = given.residuals, given.is_inverse
    return RigEstimate(tuple(mounts), sets.frame_sets, changes, given.refuted, *again, placed, *told_of_given)


def _mount_covariances(adjusted: Map) -> Array:
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
