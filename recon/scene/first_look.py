"""The first look: Gaussians at the points that registration triangulated, before there is any depth."""

from __future__ import annotations

import numpy as np
import torch

from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.priors.registered_camera import compute_modelled_K
from splatnode.recon.registration.register import Registration
from splatnode.recon.scene.points import gaussians_at
from splatnode.recon.scene.scene import Scene, TrainingView

OPACITY = 0.8  # of each Gaussian: there are few, and what is behind them is not known
MAX_GAUSSIANS = 20_000  # more points make the look slower and hardly better


def create_coarse_scene(graph: ViewGraph, registration: Registration, max_gaussians: int | None = None) -> Scene:
    """A coarse scene of the registered cameras: an isotropic Gaussian at each point, as wide as points are apart.

    Its colour is that of the photograph in which it was observed last. Of more than `max_gaussians`, or MAX_GAUSSIANS,
    an even choice is shown.
    """
    rgb = np.zeros((len(registration.points), 3), np.float32)
    source = np.full(len(registration.points), -1, np.int32)
    views = []
    for camera in registration.cameras:
        keyframe = graph.keyframes[camera.index]
        mine = registration.observed_by == camera.index
        height, width = keyframe.image.shape[:2]
        pixels = (registration.observed_pixels[mine] * keyframe.scale).astype(np.int64)
        x, y = np.clip(pixels, 0, [width - 1, height - 1]).T
        rgb[registration.observed_point[mine]] = keyframe.image[y, x] / np.float32(255)
        source[registration.observed_point[mine]] = keyframe.frame.frame_id
        T_world_camera = torch.tensor(camera.T_world_camera, dtype=torch.float32)
        K = torch.tensor(compute_modelled_K(graph, camera), dtype=torch.float32)
        shown = keyframe.name, keyframe.frame.frame_id, keyframe.image
        views.append(TrainingView(*shown, T_world_camera, K, mask=keyframe.mask, lens=keyframe.lens))
    seen = np.flatnonzero(source >= 0)
    most = min(len(seen), MAX_GAUSSIANS, max_gaussians or MAX_GAUSSIANS)
    chosen = seen[np.linspace(0, len(seen) - 1, most).round().astype(np.int64)]
    points = registration.points[chosen].astype(np.float32)
    return Scene(tuple(views), gaussians_at(points, rgb[chosen], source[chosen], OPACITY))
