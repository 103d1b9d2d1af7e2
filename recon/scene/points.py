"""Isotropic Gaussians at points, each as wide as its neighbours are apart: how 3DGS and its successors start."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import KDTree

from splatnode.recon.scene.gaussians import SH_C0, Gaussians, logit

NUM_NEIGHBOURS = 3  # whose mean squared distance is a new Gaussian's variance, as in 3DGS
LONE_SPACING = 1e-2  # of fewer points than neighbours are asked for; the scene's median depth is 1
MIN_SQUARED_SPACING = 1e-14  # of points that coincide: a Gaussian needs an extent


def gaussians_at(
    points: npt.NDArray[np.float32],  # (N, 3) world
    rgb: npt.NDArray[np.float32],  # (N, 3) in [0, 1]
    source_frame: npt.NDArray[np.int32],  # (N,)
    opacity: float,
    neighbours: int = NUM_NEIGHBOURS,
) -> Gaussians:
    """An isotropic Gaussian of degree 0 at each point; its standard deviation is the `spacing` of the points there."""
    count = len(points)
    return Gaussians(
        means=torch.from_numpy(points),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.from_numpy(np.log(spacing(points, neighbours)))[:, None].repeat(1, 3),
        logit_opacities=torch.full((count,), logit(opacity)),
        sh=torch.from_numpy((rgb - 0.5) / np.float32(SH_C0))[:, None],
        source_frame=torch.from_numpy(source_frame),
    )


def spacing(points: npt.NDArray[np.float32], neighbours: int) -> npt.NDArray[np.float32]:
    """(N,) root mean squared distance from each of the points (N, 3) to its nearest `neighbours` other ones."""
    if len(points) <= neighbours:
        return np.full(len(points), LONE_SPACING, np.float32)
    distances, _ = KDTree(points).query(points, neighbours + 1, workers=-1)
    return np.sqrt(np.maximum((distances[:, 1:] ** 2).mean(1), MIN_SQUARED_SPACING)).astype(np.float32)
