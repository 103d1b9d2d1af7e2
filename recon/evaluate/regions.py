"""Scores by region: of the pixels that two training photographs show, or one, or none.

What no photograph shows can only be guessed, and a mean over whole photographs mixes the guess with what was seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.networks.lpips import Lpips
from splatnode.recon.optimize import photometric_reference

Counts = npt.NDArray[np.uint8]  # (H, W) how many training photographs show a pixel, at most 2; UNKNOWN
Region = Literal["shown", "two", "one", "none"]

UNKNOWN = 255  # nothing tells where the pixel's surface is
REGIONS: tuple[Region, ...] = ("shown", "two", "one", "none")  # "shown": by one or more
_LEAST_SHARE = 0.02  # of a photograph's pixels: a smaller region of it says more about its border than about itself


@dataclass(frozen=True)
class RegionScore:
    """Means over the held-out photographs that have enough of a region; None where none has."""

    share_pct: float  # of all pixels of all held-out photographs
    psnr: float | None = None  # dB
    ssim: float | None = None
    lpips_alex: float | None = None


@dataclass(frozen=True, eq=False)
class ErrorMaps:
    """How one render differs from its photograph, for each pixel (H, W), and what shows the pixel."""

    squared: Tensor  # mean over the colours
    ssim: Tensor
    lpips: Tensor | None
    counts: Counts


def compute_error_maps(image: Tensor, truth: Tensor, counts: Counts, network: Lpips | None) -> ErrorMaps:
    """Maps the errors of a render, (H, W, 3) in [0, 1]. Raises ValueError if `counts` differs in size."""
    if counts.shape != tuple(truth.shape[:2]):
        raise ValueError(f"counts must be {tuple(truth.shape[:2])} like the photograph, got {counts.shape}")
    planes = image.double().permute(2, 0, 1), truth.double().permute(2, 0, 1)
    return ErrorMaps(
        squared=((image.double() - truth.double()) ** 2).mean(2),
        ssim=photometric_reference.ssim(*planes).mean(0),
        lpips=None if network is None else network.map(image, truth),
        counts=counts,
    )


def compute_region_scores(views: Sequence[ErrorMaps]) -> dict[str, RegionScore]:
    """A score a region, over `views`; empty where there are none."""
    return {region: _score_region(views, region) for region in REGIONS} if views else {}


def mask_region(counts: Counts, region: Region) -> npt.NDArray[np.bool_]:
    """(H, W) the pixels of a region."""
    members: Mapping[Region, tuple[int, ...]] = {"shown": (1, 2), "two": (2,), "one": (1,), "none": (0,)}
    return np.isin(counts, members[region])


def _score_region(views: Sequence[ErrorMaps], region: Region) -> RegionScore:
    masks = [mask_region(view.counts, region) for view in views]
    share = 100.0 * sum(int(mask.sum()) for mask in masks) / sum(mask.size for mask in masks)
    enough = [(view, torch.from_numpy(m)) for view, m in zip(views, masks, strict=True) if m.mean() >= _LEAST_SHARE]
    if not enough:
        return RegionScore(share)
    perceptual = [float(view.lpips[mask].mean()) for view, mask in enough if view.lpips is not None]
    return RegionScore(
        share_pct=share,
        psnr=float(np.mean([-10.0 * np.log10(max(float(view.squared[mask].mean()), 1e-10)) for view, mask in enough])),
        ssim=float(np.mean([float(view.ssim[mask].mean()) for view, mask in enough])),
        lpips_alex=float(np.mean(perceptual)) if perceptual else None,
    )
