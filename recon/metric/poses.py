"""Unit and orientation by poses that others estimated: odometry, a tracker, a drone's log.

The cameras of the scene are carried onto the poses by the similarity that most of them agree on. A pose that does not
fit is named and left out. Neither the photographs' cameras nor the scene are changed by them otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from splatnode.recon.geometry import Similarity, align_cameras, angles_deg, compute_rms_radius
from splatnode.recon.metric.measurement import TWO_SIDED_95, Measurement
from splatnode.recon.metric.views import MetricView

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_FARTHEST = 3.76  # standard deviations in three dimensions: what one has within 3 in one dimension, 99.7 %
# What poses that scatter more than was given are believed to scatter at most: as a share of their spread, and degrees.
_MOST_SHARE, _MOST_DEG = 0.05, 15.0
_DRIFT_LEFT = 0.5  # of the drift at the end of the way, in one direction: what is left of it beside the best similarity
_TO_SIGMA = 0.65  # standard deviation in one dimension over the median length in three
_LEAST_FITTING = 0.6  # of the poses
_MOST_PAIRS = 500  # of cameras, each of which proposes a similarity
_ROUNDS = 10


@dataclass(frozen=True, eq=False)
class PoseAlignment:
    """The alignment of a scene to given poses."""

    unit: Measurement
    to_world: Similarity  # from the scene to the world of the poses
    centre: Array  # (3,) mean of the cameras that count, in the scene: by which another unit turns and moves it, too
    told: tuple[str, ...]  # a sentence for each pose that was left out

    def rescale(self, scale: float) -> Similarity:
        """The similarity with another scale, which keeps the middle of the cameras where it is."""
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
    scene = np.stack([views[name].T_world_camera for name in names])
    pairs = _CameraPairs(
        names, scene, np.stack([poses[name] for name in names]), np.array([views[n].bound for n in names])
    )
    usual = sigmas.position_m, sigmas.rotation_deg
    position_m, rotation_deg = np.array([own.get(name, usual) for name in names]).T
    if compute_rms_radius(pairs.given[:, :3, 3]) <= np.median(position_m):
        return f"poses of {len(names)} photographs were given, which are not farther apart than they are unsure"
    by, kept, scattered_deg = _find_consensus(pairs, position_m, rotation_deg, sigmas.drift)
    if kept.sum() < _count_required(len(names)):
        return (
            f"poses of {len(names)} photographs were given, of which no more than {kept.sum()} fit the cameras of the "
            "scene: are they of the cameras, with x right, y down and z forward, and in metres?"
        )
    by, sigma = _refine_similarity(pairs, by, kept, position_m, scattered_deg, sigmas.drift)
    off_m, off_deg = pairs.compute_errors(by)
    told = tuple(
        f"the pose of {name} was left out: it is {_format_error(off_m[i], off_deg[i], scattered_deg[i])} off"
        for i, name in enumerate(names)
        if not kept[i]
    )
    unit = Measurement(by.scale, sigma, f"poses of {kept.sum()} photographs")
    return PoseAlignment(unit, by, pairs.scene[kept, :3, 3].mean(0), told)


def _format_error(metres: float, degrees: float, rotation_deg: float) -> str:
    turned = f"{degrees:.2g} degrees" if degrees > _FARTHEST * rotation_deg else ""
    return " and ".join(filter(None, (f"{metres:.2g} m", turned)))


def _find_consensus(
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
        fits = (off_m < _FARTHEST * pairs.sigma_m(by, position_m)) & (off_deg < _FARTHEST * rotation_deg)
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
        return float(np.median(squares) if by_most else np.minimum(squares, 2.0 * _FARTHEST**2).sum())

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
