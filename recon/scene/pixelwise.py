"""Pixelwise seeding, a Gaussian a pixel: how InstantSplat and the paper start; our scenes are compared with it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.scene.gaussians import Gaussians
from splatnode.recon.scene.points import NUM_NEIGHBOURS, gaussians_at
from splatnode.recon.scene.seeding import GaussianInitializationConfig as DownSampling
from splatnode.recon.scene.seeding import find_redundant_pixels


class PixelwiseConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    down_sampling: DownSampling = DownSampling(max_footprint_ratio=1e9)  # equations 14 to 17 as they are written
    min_confidence: float = 0.05  # least confidence of stereo, in [0, 1]: pixels below get no Gaussian
    opacity: float = 0.1  # of a new Gaussian, as in 3DGS
    neighbours: int = NUM_NEIGHBOURS  # points whose mean squared distance is a new Gaussian's variance
    # What lies behind: nothing, as published; our far shell; our filled depths and the shell (MASt3R's have no holes).
    surroundings: Literal["none", "shell", "fill"] = "none"


def pixelwise_gaussians(
    pointmaps: Sequence[Pointmap],
    images: Sequence[npt.NDArray[np.uint8]],
    config: PixelwiseConfig,
    max_gaussians: int | None = None,
) -> Gaussians:
    """An isotropic Gaussian for each pixel whose depth is confident and that no more confident view covers.

    Of more than `max_gaussians` an even choice is kept; sizes then follow from the distances between those.
    """
    points, colours, frames = [], [], []
    redundant = find_redundant_pixels(pointmaps, config.down_sampling)
    for pointmap, image, covered in zip(pointmaps, images, redundant, strict=True):
        kept = ~covered & (pointmap.depth > 0) & (pointmap.confidence >= config.min_confidence)
        points.append(pointmap.points[kept])
        colours.append(image[kept].astype(np.float32) / 255.0)
        frames.append(np.full(int(kept.sum()), pointmap.frame_id, np.int32))
    means, rgb, source_frame = (np.concatenate(parts) for parts in (points, colours, frames))
    if max_gaussians is not None and len(means) > max_gaussians:
        chosen = np.linspace(0, len(means) - 1, max_gaussians).round().astype(np.int64)
        means, rgb, source_frame = means[chosen], rgb[chosen], source_frame[chosen]
    return gaussians_at(means, rgb, source_frame, config.opacity, config.neighbours)
