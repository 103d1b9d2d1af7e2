"""How the cameras of frame sets stand to each other: single measurements, one a set, and where they change.

Whether a camera moved on its rig is a question of time: its pose as the sets before tell it, against that of those
after. Errors of single sets that are larger than they claim, as of cameras that are not triggered together, make each
measurement less sure, and no change of the rig.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from splatnode.recon.geometry import cross_matrix
from splatnode.recon.registration import bundle_adjustment

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
    return float(chi2.sf(error @ np.linalg.solve(one[2] + other[2], error), 6))


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
