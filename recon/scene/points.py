"""Isotropic Gaussians at points, as wide as the points are apart: how 3DGS and what follows it start."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import KDTree

from splatnode.recon.scene.gaussians import SH_C0, Gaussians

NEIGHBOURS = 3  # whose mean squared distance is a new Gaussian's variance


def gaussians_at(
    points: npt.NDArray[np.float32],  # (N, 3) world
    rgb: npt.NDArray[np.float32],  # (N, 3) in [0, 1]
    source_frame: npt.NDArray[np.int32],  # (N,)
    opacity: float,
    neighbours: int = NEIGHBOURS,
) -> Gaussians:
    count = len(points)
    return Gaussians(
        means=torch.from_numpy(points),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.from_numpy(np.log(spacing(points, neighbours)))[:, None].repeat(1, 3),
        logit_opacities=torch.full((count,), float(np.log(opacity / (1 - opacity)))),
        sh=torch.from_numpy((rgb - 0.5) / np.float32(SH_C0))[:, None],
        source_frame=torch.from_numpy(source_frame),
    )


def spacing(points: npt.NDArray[np.float32], neighbours: int) -> npt.NDArray[np.float32]:
    """(N,) root mean squared distance to the nearest other points."""
    if len(points) <= neighbours:
        return np.full(len(points), 1e-2, np.float32)
    distances, _ = KDTree(points).query(points, neighbours + 1, workers=-1)
    return np.sqrt(np.maximum((distances[:, 1:] ** 2).mean(1), 1e-14)).astype(np.float32)
