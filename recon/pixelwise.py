"""One Gaussian a pixel: how InstantSplat and the paper start, and what the size of our scenes is compared with."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import KDTree

from recon.density import Config as DownSampling
from recon.density import redundant
from recon.gaussians import SH_C0, Gaussians
from recon.priors.pointmap import Pointmap


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    down_sampling: DownSampling = DownSampling(coarser=1e9)  # equations 14 to 17 as they are written
    min_confidence: float = 0.05
    opacity: float = 0.1
    neighbours: int = 3  # whose mean squared distance is a new Gaussian's variance


def pixelwise_gaussians(
    pointmaps: Sequence[Pointmap],
    images: Sequence[npt.NDArray[np.uint8]],
    config: Config,
    max_gaussians: int | None = None,
) -> Gaussians:
    """An isotropic Gaussian for every pixel that is confident and that no more confident view covers.

    Beyond `max_gaussians` an even choice of them is kept; their sizes then follow from the distances that are left.
    """
    points, colours, frames = [], [], []
    for pointmap, image, covered in zip(pointmaps, images, redundant(pointmaps, config.down_sampling), strict=True):
        kept = ~covered & (pointmap.depth > 0) & (pointmap.confidence >= config.min_confidence)
        points.append(pointmap.points[kept])
        colours.append(image[kept].astype(np.float32) / 255.0)
        frames.append(np.full(int(kept.sum()), pointmap.frame_id, np.int32))
    means, rgb, source_frame = (np.concatenate(parts) for parts in (points, colours, frames))
    if max_gaussians is not None and len(means) > max_gaussians:
        chosen = np.linspace(0, len(means) - 1, max_gaussians).round().astype(np.int64)
        means, rgb, source_frame = means[chosen], rgb[chosen], source_frame[chosen]
    count = len(means)
    logit = float(np.log(config.opacity / (1 - config.opacity)))
    return Gaussians(
        means=torch.from_numpy(means),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.from_numpy(np.log(_spacing(means, config.neighbours)))[:, None].repeat(1, 3),
        logit_opacities=torch.full((count,), logit),
        sh=torch.from_numpy((rgb - 0.5) / np.float32(SH_C0))[:, None],
        source_frame=torch.from_numpy(source_frame),
    )


def _spacing(points: npt.NDArray[np.float32], neighbours: int) -> npt.NDArray[np.float32]:
    """(N,) root mean squared distance to the nearest other points."""
    if len(points) <= neighbours:
        return np.full(len(points), 1e-2, np.float32)
    distances, _ = KDTree(points).query(points, neighbours + 1, workers=-1)
    return np.sqrt(np.maximum((distances[:, 1:] ** 2).mean(1), 1e-14)).astype(np.float32)
