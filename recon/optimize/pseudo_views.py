"""Pseudo views: cameras where no photograph was taken, between the training views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import torch
from scipy.linalg import expm, logm

from splatnode.recon.rasterize.dispatch import Camera
from splatnode.recon.scene.scene import TrainingView

_SHARES = (0.15, 0.85)  # of the motion between two training views, within which a pseudo view lies

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PseudoView:
    """A camera between two training views, or beside the path that joins them."""

    T_world_camera: Array  # (4, 4)
    K: Array  # (3, 3)
    width: int
    height: int
    nearest: int  # index of the training view it is closest to

    @property
    def camera(self) -> Camera:
        """The same in float32 tensors, to render it."""
        return Camera(
            torch.from_numpy(self.T_world_camera).float(), torch.from_numpy(self.K).float(), self.width, self.height
        )


def interpolate(T_start: Array, T_end: Array, share: float) -> Array:
    """(4, 4) camera at `share` of the screw motion from one camera (4, 4) to another: a geodesic of SE(3)."""
    motion = np.real(logm(np.linalg.inv(T_start) @ T_end))
    moved = T_start @ expm(share * motion)
    u, _, vt = np.linalg.svd(moved[:3, :3])  # logm's rounding would let the rotation drift
    moved[:3, :3] = u @ vt
    return moved


def order_cameras(Ts_world_camera: Sequence[Array]) -> list[int]:
    """The order that visits all cameras in small steps: the shortest of the greedy paths from each of them."""
    centres = np.array([T[:3, 3] for T in Ts_world_camera])
    steps = np.linalg.norm(centres[:, None] - centres[None], axis=-1)

    def greedy(start: int) -> list[int]:
        order, left = [start], set(range(len(centres))) - {start}
        while left:
            order.append(min(left, key=lambda candidate: (steps[order[-1], candidate], candidate)))
            left.remove(order[-1])
        return order

    def length(order: list[int]) -> float:
        return float(sum(steps[a, b] for a, b in pairwise(order)))

    return min((greedy(start) for start in range(len(centres))), key=length)


def pseudo_views(
    Ts_world_camera: Sequence[Array],
    Ks: Sequence[Array],
    sizes: Sequence[tuple[int, int]],
    count: int,
    *,
    off_path: float,
    rng: np.random.Generator,
) -> list[PseudoView]:
    """`count` cameras, spread over the steps of the path through C >= 2 training cameras.

    Each lies at a random share between two neighbours, and then beside their path by a random part of up to `off_path`
    of their distance, in the image plane of the camera there. K and size (width, height) are those of the nearer one.
    """
    if len(Ts_world_camera) < 2:
        raise ValueError(
            f"pseudo views lie between training cameras: at least 2 are needed, got {len(Ts_world_camera)}"
        )
    order = order_cameras(Ts_world_camera)
    steps = list(pairwise(order))
    views = []
    for index in range(count):
        start, end = steps[index % len(steps)]
        share = float(rng.uniform(*_SHARES))
        T_world_camera = interpolate(Ts_world_camera[start], Ts_world_camera[end], share)
        distance = float(np.linalg.norm(Ts_world_camera[end][:3, 3] - Ts_world_camera[start][:3, 3]))
        aside = rng.uniform(-off_path, off_path, 2) * distance
        T_world_camera[:3, 3] += T_world_camera[:3, :2] @ aside
        nearest = start if share < 0.5 else end
        views.append(PseudoView(T_world_camera, Ks[nearest], *sizes[nearest], nearest))
    return views


def sample_pseudo_views(
    cameras: Sequence[Camera | TrainingView], count: int, *, off_path: float, rng: np.random.Generator
) -> list[PseudoView]:
    """`count` pseudo views between these cameras, as `pseudo_views` spreads them; none between fewer than two."""
    if len(cameras) < 2:
        return []
    return pseudo_views(
        [camera.T_world_camera.double().numpy() for camera in cameras],
        [camera.K.double().numpy() for camera in cameras],
        [(camera.width, camera.height) for camera in cameras],
        count,
        off_path=off_path,
        rng=rng,
    )
