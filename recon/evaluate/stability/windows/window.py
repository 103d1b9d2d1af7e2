"""Which windows of consecutive photographs are tried, and how far apart their views are."""

from __future__ import annotations

import logging
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.evaluate.stability.places import TrialScene, classify_motion

logger = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]

COUNTS = (3, 6, 12)  # of photographs
STRIDES = (1, 2, 3, 4)
_PARALLEL = 1e-6  # smallest eigenvalue of the sum over axes of I - d d^T: below, the axes have no nearest point


@dataclass(frozen=True)
class Window:
    """Photographs of one scene, `stride` apart in the order of capture."""

    scene: str
    count: int
    stride: int
    start: int
    names: tuple[str, ...]
    angle_deg: float  # the largest over the views of the angle to the nearest other one


def select_moving_scenes(places: Sequence[TrialScene]) -> list[TrialScene]:
    """The places whose true cameras move; the others are named in the log: without motion no centre is wrong."""
    still = [place.name for place in places if classify_motion(place.Ts_world_camera) == "turned"]
    if still:
        logger.warning("no windows of %s: the true cameras do not move", ", ".join(still))
    return [place for place in places if place.name not in still]


def draw_windows(place: TrialScene, per_kind: int, seed: int, counts: Sequence[int] = COUNTS) -> list[Window]:
    """At most `per_kind` windows of each count and stride, drawn at random, in which the camera moves."""
    Ts, chosen = place.Ts_world_camera, []
    for count in counts:
        for stride in STRIDES:
            spans = {start: Ts[start : start + stride * count : stride] for start in range(len(Ts))}
            starts = [
                start for start, span in spans.items() if len(span) == count and classify_motion(span) != "turned"
            ]
            rng = np.random.default_rng([seed, zlib.crc32(f"{place.name} {count} {stride}".encode())])
            for start in sorted(rng.permutation(starts)[:per_kind].tolist()):
                names = place.names[start : start + stride * count : stride]
                chosen.append(Window(place.name, count, stride, start, tuple(names), compute_angle_deg(spans[start])))
    return chosen


def compute_angle_deg(Ts_world_camera: Array) -> float:
    """The largest over the views (C, 4, 4) of the angle to the nearest other view, seen from the middle of the scene.

    The middle is the point with the least squared distance to all optical axes. Where that is behind a camera, or the
    axes are parallel, nothing is known of it, and angles are those between the viewing directions. Only true cameras
    count, so that the angle is the same for every method.
    """
    rays = Ts_world_camera[:, :3, 2]
    middle = _find_nearest_to_axes(Ts_world_camera)
    if middle is not None:
        towards = middle - Ts_world_camera[:, :3, 3]
        if ((towards * rays).sum(1) > 0).all():
            rays = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    chords = np.linalg.norm(rays[:, None] - rays[None], axis=2)
    np.fill_diagonal(chords, 2.0)
    return float(np.degrees(2.0 * np.arcsin(np.minimum(chords.min(1) / 2.0, 1.0))).max())


def _find_nearest_to_axes(Ts_world_camera: Array) -> Array | None:
    directions, centres = Ts_world_camera[:, :3, 2], Ts_world_camera[:, :3, 3]
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]  # (C, 3, 3) projects off each axis
    total = across.sum(0)
    if np.linalg.eigvalsh(total)[0] < _PARALLEL:
        return None
    return np.linalg.solve(total, np.einsum("cij,cj->i", across, centres))
