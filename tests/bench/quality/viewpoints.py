"""Where a scene is looked at that nobody photographed: between the cameras, beside, above and behind their path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import compute_rms_radius
from splatnode.recon.optimize.regularizers import interpolate, order_cameras
from tests.bench.quality.known_surfaces import KnownView

Array = npt.NDArray[np.float64]

COUNT = 30
# Right, down and forward in the camera's frame, in units of how far a viewpoint may lie from the cameras' path.
ASIDE = ((0, 0, 0), (1, 0, 0), (0, -1, 0), (-1, 0, 0), (0, 0, -1), (0.5, 0.5, 0))
FARTHEST = 0.25  # of the median depth: no viewpoint lies farther from the path than that, or than the cameras' spread


@dataclass(frozen=True, eq=False)
class Viewpoint:
    T_world_camera: Array  # (4, 4)
    K: Array  # (3, 3)
    width: int
    height: int


def viewpoints(views: Sequence[KnownView]) -> list[Viewpoint]:
    """COUNT viewpoints, evenly along the path that joins the cameras of C >= 2 `views`, each moved aside by ASIDE.

    Whatever is moved is turned back to what it had before it at the median depth. Nothing is drawn by chance.
    """
    order = [views[i] for i in order_cameras([view.T_world_camera for view in views])]
    apart = compute_rms_radius(np.stack([view.T_world_camera[:3, 3] for view in views]))
    found = []
    for index in range(COUNT):
        start, share = divmod((index + 0.5) / COUNT * (len(order) - 1), 1.0)
        one, other = order[int(start)], order[int(start) + 1]
        T = interpolate(one.T_world_camera, other.T_world_camera, share)
        near = one if share < 0.5 else other
        depth = float(np.median(near.depth[near.depth > 0]))
        aside = min(apart, FARTHEST * depth) * np.array(ASIDE[index % len(ASIDE)], np.float64)
        height, width = near.depth.shape
        found.append(Viewpoint(_moved(T, aside, depth), near.K, width, height))
    return found


def _moved(T_world_camera: Array, aside: Array, depth: float) -> Array:
    """The camera (4, 4) moved by `aside` in its own frame, then turned to what it had before it at `depth`."""
    forward = np.array([0.0, 0.0, depth]) - aside
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    motion = np.eye(4)
    motion[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    motion[:3, 3] = aside
    return T_world_camera @ motion
