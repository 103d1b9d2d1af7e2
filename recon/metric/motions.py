"""The unit by how odometry says that the camera moved from one photograph to the next: wheels, an IMU.

Each motion is compared with what the photographs say of the same two cameras, in the frame of the first of them. So an
error of one motion is in no other, and turns that add up along the way bend nothing. A motion that does not fit is
named and left out. Neither the photographs' cameras nor the scene are changed by them otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from splatnode.capture.motion import Motion
from splatnode.recon.geometry import angles_deg
from splatnode.recon.metric.measurement import TWO_SIDED_95, Measurement
from splatnode.recon.metric.views import MetricView

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
            f"motions between {_format_pair_count(count)} were given, of which no more than {kept.sum()} fit the cameras of the "
            "scene: are they of the camera, with x right, y down and z forward, and in metres?"
        ]
    sigma = _estimate_sigma(steps, scale, kept)
    if sigma > _LEAST_KNOWN:
        return [f"motions between {_format_pair_count(count)} were given, which are not longer than they are unsure"]
    off = np.linalg.norm(scale * steps.scene - steps.given, axis=1)
    told = [
        f"the motion from {first} to {second} was left out: it is {off[i]:.2g} m and {steps.turned_deg[i]:.2g} degrees "
        "off"
        for i, (first, second) in enumerate(steps.names)
        if not kept[i]
    ]
    unit = Measurement(scale, math.hypot(sigma, shared), f"motions between {_format_pair_count(int(kept.sum()))}")
    return [unit, *told]


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
