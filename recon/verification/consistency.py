"""Cycle consistency: relative poses that single pairs find by themselves, against each other and the registration."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import cross_matrix
from splatnode.recon.keyframes import PLAIN, REFERENCE_SIDE, Features, Keyframe, longer_side, principal_point
from splatnode.recon.matching import features as matching_features
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration import multiview_geometry
from splatnode.recon.registration.registration import Registration
from splatnode.recon.threads import map_parallel_lazily

Array = npt.NDArray[np.float64]

MIN_INLIER_RATIO = 0.5  # of a relative pose to be believed: most of its matches support it
MIN_LENGTH = 1e-12  # of two directions, multiplied: shorter ones have no angle between them, which counts as 90 degrees
MIN_SIGMA_DEG = 0.3  # of a direction: what lens and shutter do otherwise than the model
MIN_NOISE_PX = 0.2  # of a match, at REFERENCE_SIDE
MEDIAN_OF_NORMAL = 0.6745  # median size of a normal error over its standard deviation
OUTLIER = 4.0  # times the noise, from which on a match says nothing
MIN_INFORMATION = 1e-9  # of an eigenvalue, in place of 0
STEP = 1e-5  # of a rotation or a direction, radians, in differences


class CycleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Cycle consistency: relative poses that single pairs find by themselves, against each other and the
    registration."""

    min_matches: int = 40  # least matches of a pair that is used
    partners: int = 3  # of each frame, those with most matches
    max_matches: int = 400  # matches of a pair that are used; more make a relative pose no surer
    max_error_px: float = 2.5  # largest error of a match, pixels at REFERENCE_SIDE


@dataclass(frozen=True)
class CycleConsistency:
    """Triangles of pairs, each with a relative pose of its own (five points, known focal lengths)."""

    triangles: int
    rotation_deg: float  # median angle that is left after going round; 0 without a triangle
    worst_rotation_deg: float
    direction_deg: float  # median angle between the direction in which a pair sees its partner and the registration's
    direction_sigmas: float  # the same over the standard error that the pair's matches leave of it; 0 without a pair


def measure_cycle_consistency(
    keyframes: Sequence[Keyframe],
    registration: Registration,
    pairs: Mapping[tuple[int, int], TwoView],
    config: CycleConfig,
) -> CycleConsistency:
    cameras = {camera.index: camera for camera in registration.cameras}
    rotations: dict[tuple[int, int], Array] = {}
    directions, sigmas = [], []
    for i, j in _select_strongest_pairs(list(cameras), pairs, config):
        scale = max(longer_side(keyframes[k].frame) for k in (i, j)) / REFERENCE_SIDE
        thinned = _thin_matches(pairs[i, j], config.max_matches)
        rays = [
            cameras[k].normalise(points + principal_point(keyframes[k].frame))
            for k, points in ((i, thinned.points1), (j, thinned.points2))
        ]
        focals = [float(np.sqrt(np.prod(cameras[k].focals))) for k in (i, j)]
        straight = replace(thinned, points1=focals[0] * rays[0], points2=focals[1] * rays[1])
        limit = config.max_error_px * scale
        rotation, direction, num_inliers = multiview_geometry.relative_pose(straight, focals[0], focals[1], limit)
        if num_inliers < MIN_INLIER_RATIO * len(thinned.matches):
            continue  # The pair has no rigid answer for these focal lengths; its inlier ratio says so, too.
        rotations[i, j] = rotation
        T_second_first = np.linalg.inv(cameras[j].T_world_camera) @ cameras[i].T_world_camera
        angle = _compute_angle_between(direction, T_second_first[:3, 3])
        directions.append(angle)
        focal = float(np.mean(focals))
        sigma = estimate_direction_sigma_deg(rays[0], rays[1], rotation, direction, MIN_NOISE_PX * scale / focal)
        sigmas.append(angle / float(np.hypot(sigma, MIN_SIGMA_DEG)))
    left = []
    for i, j, k in combinations(sorted(cameras), 3):
        if (i, j) in rotations and (j, k) in rotations and (i, k) in rotations:
            around = rotations[i, k].T @ rotations[j, k] @ rotations[i, j]
            left.append(float(np.degrees(np.arccos(np.clip((np.trace(around) - 1.0) / 2.0, -1.0, 1.0)))))
    return CycleConsistency(
        triangles=len(left),
        rotation_deg=float(np.median(left)) if left else 0.0,
        worst_rotation_deg=float(np.max(left)) if left else 0.0,
        direction_deg=float(np.median(directions)) if directions else 0.0,
        direction_sigmas=float(np.median(sigmas)) if sigmas else 0.0,
    )


def estimate_direction_sigma_deg(
    rays1: Array, rays2: Array, rotation: Array, direction: Array, least_noise: float
) -> float:
    """The standard error of the direction of motion that a pair's matches leave, degrees; 90 where nothing is known.

    `rays1` and `rays2` (M, 2) at depth 1, the pose from the first camera's axes to the second's. By the Sampson errors'
    Jacobian at the pose; their noise is their median size, at least `least_noise`. With little parallax a rotation does
    almost what a motion does, and a pair cannot know its direction well.
    """
    length = max(float(np.linalg.norm(direction)), MIN_LENGTH)
    unit = direction / length
    aside = np.linalg.svd(unit[None])[2][1:]  # two directions across it

    def errors(step: Array) -> Array:
        turned = rotation + cross_matrix(step[None, :3])[0] @ rotation
        moved = unit + step[3] * aside[0] + step[4] * aside[1]
        return _compute_sampson_errors(rays1, rays2, cross_matrix(moved[None])[0] @ turned)

    at = errors(np.zeros(5))
    noise = max(float(np.median(np.abs(at))) / MEDIAN_OF_NORMAL, least_noise)
    near = np.abs(at) < OUTLIER * noise
    jacobian = np.stack([(errors(step) - errors(-step)) / (2 * STEP) for step in STEP * np.eye(5)], 1)[near]
    information = jacobian.T @ jacobian / noise**2
    values, vectors = np.linalg.eigh(information)
    covariance = (vectors / np.maximum(values, MIN_INFORMATION)) @ vectors.T
    return float(min(np.degrees(np.sqrt(np.trace(covariance[3:, 3:]))), 90.0))


def _compute_sampson_errors(rays1: Array, rays2: Array, essential: Array) -> Array:
    """(M,) signed, at depth 1."""
    one, other = (np.column_stack([rays, np.ones(len(rays))]) for rays in (rays1, rays2))
    line2, line1 = one @ essential.T, other @ essential
    gradient = (line1[:, :2] ** 2).sum(1) + (line2[:, :2] ** 2).sum(1)
    return (other * line2).sum(1) / np.sqrt(np.maximum(gradient, MIN_LENGTH))


def _select_strongest_pairs(
    frames: Sequence[int], pairs: Mapping[tuple[int, int], TwoView], config: CycleConfig
) -> list[tuple[int, int]]:
    """Pairs of registered frames that are among the strongest of one of the two."""
    strong = [
        key
        for key, pair in pairs.items()
        if key[0] in frames and key[1] in frames and len(pair.matches) >= config.min_matches
    ]
    strong.sort(key=lambda key: (-len(pairs[key].matches), key))
    chosen: set[tuple[int, int]] = set()
    for frame in frames:
        chosen.update([key for key in strong if frame in key][: config.partners])
    return sorted(chosen)


def _thin_matches(pair: TwoView, count: int) -> TwoView:
    """The pair with about `count` of its matches, spread evenly over their ranks."""
    if len(pair.matches) <= count:
        return pair
    chosen = np.linspace(0, len(pair.matches) - 1, count).astype(int)
    return replace(pair, matches=pair.matches[chosen], points1=pair.points1[chosen], points2=pair.points2[chosen])


def _compute_angle_between(one: Array, other: Array) -> float:
    lengths = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(one @ other / max(lengths, MIN_LENGTH), -1.0, 1.0))))


# Mirror images among the frames: do some look more like the others when they are turned left to right?
#
# Where a place is symmetric, the mirror image of a photograph fits the others as one taken from the other side, to the
# pixel. But it shows the details that are not symmetric, too, the wrong way round: turned back, it matches better.

Bytes = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]


class ReflectionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Mirror images among the frames: do some look more like the others when they are turned left to right."""

    num_features: int = 1500  # of each frame, the strongest
    by_chance: float = 50.0  # matches of frames that have nothing in common, which say nothing
    partners: int = 4  # known frames with which a further one is compared, those that share most points with it
    # Largest gain of a further frame beside them when mirrored; right ones of ten scenes reach 0.08
    max_further_gain: float = 0.1
    nearest_neighbours: matching_features.NearestNeighbourConfig = matching_features.NearestNeighbourConfig()


@dataclass(frozen=True)
class Reflection:
    """The frames that stand out most as mirror images of what the others show."""

    frames: tuple[str, ...]  # at most half of them
    gain: float  # mean logarithm of the matches of mirrored over plain pairs of one of them and one of the others


def measure_reflection(
    keyframes: Sequence[Keyframe], pairs: Collection[tuple[int, int]], config: ReflectionConfig
) -> Reflection:
    """Measures the reflection of two or more frames over `pairs` (i < j) of their positions."""
    plain = [_select_descriptors(keyframe.features, config.num_features) for keyframe in keyframes]
    mirrored = [mirror_descriptors(descriptors) for descriptors in plain]
    gains, compared = np.zeros((len(plain), len(plain))), np.zeros((len(plain), len(plain)))
    ordered = sorted(pairs)
    of_pairs = map_parallel_lazily(
        lambda pair: _compute_gain(plain[pair[0]], mirrored[pair[1]], plain[pair[1]], config), ordered
    )
    for (i, j), gain in zip(ordered, of_pairs, strict=True):
        gains[i, j] = gains[j, i] = gain
        compared[i, j] = compared[j, i] = 1.0
    grown = [_grow_group(gains, compared, first) for first in range(len(plain))]
    group, gain = grown[int(np.argmax([gain for _, gain in grown]))]  # the first NaN, where there is one
    return Reflection(tuple(keyframes[index].name for index in np.flatnonzero(group).tolist()), gain)


def measure_further(further: Keyframe, known: Sequence[Keyframe], config: ReflectionConfig) -> Reflection:
    """Measures the reflection of a further frame beside frames that are the right way round."""
    descriptors = _select_descriptors(further.features, config.num_features)
    mirrored = mirror_descriptors(descriptors)
    others = (_select_descriptors(keyframe.features, config.num_features) for keyframe in known)
    gains = [_compute_gain(other, mirrored, descriptors, config) for other in others]
    return Reflection((further.name,), float(np.mean(gains)))


def select_strongest_reflection(found: Sequence[Reflection]) -> Reflection:
    """The one with the largest gain; the first whose gain is NaN, where there is one."""
    return found[int(np.argmax([each.gain for each in found]))]


def _compute_gain(other: Bytes, mirrored: Bytes, plain: Bytes, config: ReflectionConfig) -> float:
    """The logarithm of the matches that a frame has with another one when it is mirrored, over those as it is."""
    found, expected = (
        len(matching_features.match(other, descriptors, config.nearest_neighbours)) + config.by_chance
        for descriptors in (mirrored, plain)
    )
    return float(np.log(found / expected))


def _select_descriptors(features: Features, count: int) -> Bytes:
    return features.select_tilt(PLAIN).descriptors[:count]


def mirror_descriptors(descriptors: Bytes) -> Bytes:
    """SIFT descriptors (M, 128) as they are in the mirrored image.

    They are histograms of 8 directions in 4 x 4 cells, along and across the direction of the keypoint: mirroring
    reverses the rows of cells across it, and the sense of the directions.
    """
    cells = descriptors.reshape(-1, 4, 4, 8)
    return np.ascontiguousarray(cells[:, ::-1][..., -np.arange(8) % 8].reshape(-1, 128))


def _grow_group(gains: Array, compared: Array, first: int) -> tuple[Flags, float]:
    """The group with the largest mean gain across its border, grown from one frame by the frame that suits best.

    Pairs that are not `compared` (1, else 0) have a gain of 0 and do not count.
    """
    group = np.zeros(len(gains), bool)
    group[first] = True
    total, count = gains[first].sum(), compared[first].sum()
    best = group.copy(), float(_compute_mean(total, count))
    while 2 * (group.sum() + 1) <= len(gains):
        # A frame that joins the group takes its pairs with the group from the border, and adds those with the others.
        totals = total + gains @ ~group - gains @ group
        counts = count + compared @ ~group - compared @ group
        means = np.where(group, -np.inf, _compute_mean(totals, counts))
        other = int(means.argmax())
        group[other], total, count = True, totals[other], counts[other]
        if means[other] > best[1]:
            best = group.copy(), float(means[other])
    return best


def _compute_mean(total: Array, count: Array) -> Any:
    """Minus infinity where nothing was compared."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count > 0, total / count, -np.inf)
