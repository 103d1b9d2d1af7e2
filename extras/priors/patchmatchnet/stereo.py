"""Depth maps of views with known cameras by PatchmatchNet, checked against each other like those of our own stereo."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import torch

from splatnode.extras.priors.patchmatchnet.network import PatchmatchNet, Source
from splatnode.recon.priors import multi_view_consistency, stereo
from splatnode.recon.priors.multi_view_consistency import DepthMap
from splatnode.recon.priors.patchmatch import Planes, make_level
from splatnode.recon.priors.stereo import SparsePoints, StereoView

Float32 = npt.NDArray[np.float32]

_STRIDE = 8  # sides of the network's images are multiples of it
_STEP = 0.05  # relative change of inverse depth from pixel to pixel from which on two surfaces meet


@dataclass(frozen=True, eq=False)
class NetworkStereo:
    """`stereo.depth_maps` with a network in place of the search for planes."""

    network: PatchmatchNet

    @torch.inference_mode()
    def estimate_depth_maps(
        self,
        views: Sequence[StereoView],
        config: stereo.StereoConfig,
        *,
        seed: int = 0,
        sparse: Sequence[SparsePoints | None] | None = None,
        pause: Callable[[], None] = lambda: None,
    ) -> list[DepthMap]:
        """A depth map for every view, in order. A view that overlaps with no other comes back without any depth.

        The cross-check gives confidence and normals, and leaves out what no other view confirms.
        """
        levels = [make_level(view.image, view.K, view.T_world_camera, view.depth_range, 0) for view in views]
        images = [_make_source(view) for view in views]
        planes, checked = [], []
        for index, view in enumerate(views):
            pause()
            points = None if sparse is None else sparse[index]
            partners = stereo.rank_partners(views, index, config, points)
            checked.append(stereo.select_check_views(partners, config))
            chosen = stereo.select_sources(partners, config)
            inverse_depth = np.zeros(view.image.shape[:2], np.float32)
            if chosen:
                generator = torch.Generator().manual_seed(seed)
                others = [images[other] for other in chosen]
                depth, _ = self.network(images[index], others, view.depth_range, generator)
                found = _resize_depth(depth.clamp(*view.depth_range).numpy(), view.image)
                inverse_depth = np.reciprocal(found, dtype=np.float32)
            planes.append(_make_planes(inverse_depth))
        return multi_view_consistency.cross_check(levels, planes, checked, config.matching, config.consistency)


def _make_source(view: StereoView) -> Source:
    """The view at a size that fits the network, pixel centres at whole numbers."""
    height, width = (max(1, round(side / _STRIDE)) * _STRIDE for side in view.image.shape[:2])
    image = view.image
    if (height, width) != image.shape[:2]:
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    K = np.diag([width / view.image.shape[1], height / view.image.shape[0], 1.0]) @ view.K
    K[:2, 2] -= 0.5
    return Source(
        torch.from_numpy(image).permute(2, 0, 1).float() / 255.0,
        torch.from_numpy(K),
        torch.from_numpy(np.linalg.inv(view.T_world_camera)),
    )


def _resize_depth(depth: Float32, image: npt.NDArray[np.uint8]) -> Float32:
    height, width = image.shape[:2]
    if depth.shape == (height, width):
        return depth
    return np.asarray(cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST), np.float32)


def _make_planes(inverse_depth: Float32) -> Planes:
    """The depth map as planes: each pixel's slope is that to its nearer neighbour on either side."""
    slopes = [_slope(inverse_depth, axis) for axis in (1, 0)]
    return Planes(np.stack([inverse_depth, *slopes], -1), np.zeros_like(inverse_depth))


def _slope(inverse_depth: Float32, axis: int) -> Float32:
    """Change per pixel along `axis`: of the changes to both sides the mean of those that are no steps, or 0."""
    along = np.moveaxis(inverse_depth, axis, -1)
    change = np.diff(along)
    smooth = np.abs(change) < _STEP * np.minimum(along[:, 1:], along[:, :-1])
    change = np.where(smooth, change, 0)
    total = np.pad(change, ((0, 0), (1, 0))) + np.pad(change, ((0, 0), (0, 1)))
    count = np.pad(smooth, ((0, 0), (1, 0))) * 1 + np.pad(smooth, ((0, 0), (0, 1)))
    return np.moveaxis(total / np.maximum(count, 1), -1, axis).astype(np.float32)
