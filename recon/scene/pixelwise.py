"""One Gaussian a pixel: how InstantSplat and the paper start, and what the size of our scenes is compared with."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.scene.gaussians import Gaussians
from splatnode.recon.scene.points import NEIGHBOURS, gaussians_at
from splatnode.recon.scene.seeding import Config as DownSampling
from splatnode.recon.scene.seeding import redundant


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    down_sampling: DownSampling = DownSampling(coarser=1e9)  # equations 14 to 17 as they are written
    min_confidence: float = 0.05
    opacity: float = 0.1
    neighbours: int = NEIGHBOURS  # whose mean squared distance is a new Gaussian's variance


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
    return gaussians_at(means, rgb, source_frame, config.opacity, config.neighbours)
