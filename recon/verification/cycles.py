"""Cycle consistency: the relative rotations of three pairs, each found by itself, multiply to the identity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import REFERENCE_SIDE, Keyframe, longer_side
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.registration import epipolar
from splatnode.recon.registration.register import Registration

Array = npt.NDArray[np.float64]

MIN_INLIER_RATIO = 0.5  # of a relative pose to be believed: most of its matches support it
MIN_LENGTH = (
    1e-12  # of two directions, multiplied: shorter ones have no angle between them, and it counts as 90 degrees
)


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    min_matches: int = 40  # least matches of a pair that is used
    partners: int = 3  # of each frame, those with most matches
    max_matches: int = 400  # matches of a pair that are used; more make a relative pose no surer
    max_error_px: float = 2.5  # largest error of a match, pixels at REFERENCE_SIDE


@dataclass(frozen=True)
class Cycles:
    """Triangles of pairs, each with a relative pose of its own (five points, known focal lengths)."""

    triangles: int
    rotation_deg: float  # median angle that is left after going round; 0 without a triangle
    worst_rotation_deg: float
    direction_deg: float  # median angle between the direction in which a pair sees its partner and the registration's


def measure(
    keyframes: Sequence[Keyframe],
    registration: Registration,
    pairs: Mapping[tuple[int, int], TwoView],
    config: Config,
) -> Cycles:
    cameras = {camera.index: camera for camera in registration.cameras}
    rotations: dict[tuple[int, int], Array] = {}
    directions = []
    for i, j in _strongest_pairs(list(cameras), pairs, config):
        scale = max(longer_side(keyframes[k].frame) for k in (i, j)) / REFERENCE_SIDE
        thinned = _thinned(pairs[i, j], config.max_matches)
        limit = config.max_error_px * scale
        rotation, direction, num_inliers = epipolar.relative_pose(thinned, cameras[i].focal, cameras[j].focal, limit)
        if num_inliers < MIN_INLIER_RATIO * len(thinned.matches):
            continue  # The pair has no rigid answer for these focal lengths; its inlier ratio says so, too.
        rotations[i, j] = rotation
        T_second_first = np.linalg.inv(cameras[j].T_world_camera) @ cameras[i].T_world_camera
        directions.append(_angle_between(direction, T_second_first[:3, 3]))
    left = []
    for i, j, k in combinations(sorted(cameras), 3):
        if (i, j) in rotations and (j, k) in rotations and (i, k) in rotations:
            around = rotations[i, k].T @ rotations[j, k] @ rotations[i, j]
            left.append(float(np.degrees(np.arccos(np.clip((np.trace(around) - 1.0) / 2.0, -1.0, 1.0)))))
    return Cycles(
        triangles=len(left),
        rotation_deg=float(np.median(left)) if left else 0.0,
        worst_rotation_deg=float(np.max(left)) if left else 0.0,
        direction_deg=float(np.median(directions)) if directions else 0.0,
    )


def _strongest_pairs(
    frames: Sequence[int], pairs: Mapping[tuple[int, int], TwoView], config: Config
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


def _thinned(pair: TwoView, count: int) -> TwoView:
    """The pair with about `count` of its matches, spread evenly over their ranks."""
    if len(pair.matches) <= count:
        return pair
    chosen = np.linspace(0, len(pair.matches) - 1, count).astype(int)
    return replace(pair, matches=pair.matches[chosen], points1=pair.points1[chosen], points2=pair.points2[chosen])


def _angle_between(one: Array, other: Array) -> float:
    lengths = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(one @ other / max(lengths, MIN_LENGTH), -1.0, 1.0))))
