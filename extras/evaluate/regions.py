"""Scores by region: of the pixels that two training photographs show, or one, or none.

What no photograph shows can only be guessed, and a mean over whole photographs mixes the guess with what was seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.networks.lpips import Lpips
from splatnode.recon.optimize import photometric_losses
from splatnode.recon.rasterize.reference import Render
from splatnode.recon.result.export import sanitize_gaussians
from splatnode.recon.result.export.formats.ply import compute_ply_bytes
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import GaussianArrays, Snapshot

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
        ssim=photometric_losses.ssim(*planes).mean(0),
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


# What a benchmark asks of a scene: how it looks from a camera. Gaussians are one answer, a radiance field another.

Array = npt.NDArray[np.float64]
Rasterize = Callable[..., Render]


class Appearance(Protocol):
    """A finished scene as a function from cameras to images."""

    @property
    def num_gaussians(self) -> int | None:
        """None for a scene that is not made of them."""
        ...

    @property
    def num_bytes(self) -> int:
        """Returns the size of the scene as it would be published."""
        ...

    def depth(self, T_world_camera: Array) -> float:
        """The median depth of what a camera has before it."""
        ...

    def difference(self, image: Tensor, T_world_camera: Tensor, K: Tensor, used: Tensor | None = None) -> Tensor:
        """Mean absolute difference to `image` (H, W, 3), scalar, differentiable with respect to the pose (4, 4).

        Where `used` (H, W) says so, which it does somewhere; None: everywhere.
        """
        ...

    def render(self, T_world_camera: Array, K: Array, width: int, height: int) -> Tensor:
        """(H, W, 3) the image; above 1 where it is brighter than white."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class FieldSnapshot(Snapshot):
    """The snapshot of a method without Gaussians; `appearance` is pickled from process to process."""

    appearance: Appearance


def make_appearance(snapshot: Snapshot, rasterize: Rasterize) -> Appearance | None:
    """How a snapshot's scene looks; None where its verdict forbids publishing it, or it has none."""
    if not snapshot.verdict.publishable:
        return None
    if isinstance(snapshot, FieldSnapshot):
        return snapshot.appearance
    gaussians = sanitize_gaussians(snapshot.gaussians)
    return GaussianAppearance(gaussians, rasterize) if len(gaussians) else None


class GaussianAppearance:
    """Gaussians on black."""

    def __init__(self, gaussians: GaussianArrays, rasterize: Rasterize) -> None:
        self._gaussians, self._rasterize = gaussians, rasterize
        arrays = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh
        self._tensors = [torch.from_numpy(array) for array in arrays]

    @property
    def num_gaussians(self) -> int:
        return len(self._gaussians)

    @property
    def num_bytes(self) -> int:
        return compute_ply_bytes(len(self._gaussians), self._gaussians.sh.shape[1])

    def depth(self, T_world_camera: Array) -> float:
        """The median depth of the Gaussians in front of the camera; 1 where there are none."""
        z = (self._gaussians.means - T_world_camera[:3, 3]) @ T_world_camera[:3, 2]
        ahead = z[z > 0]
        return float(np.median(ahead)) if len(ahead) else 1.0

    def difference(self, image: Tensor, T_world_camera: Tensor, K: Tensor, used: Tensor | None = None) -> Tensor:
        height, width = image.shape[:2]
        rgb = self._rasterize(*self._tensors, T_world_camera, K, width, height, channels=("rgb",)).rgb
        if rgb is None:
            raise ValueError("the rasteriser was asked for the channel rgb and gave none")
        off = (rgb - image).abs()
        return (off if used is None else off[used]).mean()

    def render(self, T_world_camera: Array, K: Array, width: int, height: int) -> Tensor:
        return torch.from_numpy(render_arrays(self._gaussians, T_world_camera, K, width, height).rgb)
