"""Initialisation: the scene that has not been optimised, seeded from point maps of registered cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import msgspec
import numpy as np
import numpy.typing as npt
import torch

from splatnode.capture.frame import Intrinsics
from splatnode.recon.frames import border
from splatnode.recon.priors.confirmed import compute_consistent_shares, find_consistent_pixels
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.scene import background, completion, pixelwise, seeding
from splatnode.recon.scene.gaussians import Gaussians, concatenate
from splatnode.recon.scene.scene import Exposure, Scene, TrainingView

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

SHELL_PARTS = 10  # with a limit on the Gaussians, one part in this many may be the far shell


class SceneInitializationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which Gaussians a scene begins with."""

    completion: completion.DepthCompletionConfig = completion.DepthCompletionConfig()
    seeding: seeding.GaussianInitializationConfig = seeding.GaussianInitializationConfig()
    background: background.BackgroundConfig = background.BackgroundConfig()
    pixelwise: pixelwise.PixelwiseConfig | None = None  # in place of seeding: a Gaussian a pixel that stereo knows
    max_gaussians: int | None = None  # None: as many as the photographs call for


def initialize_scene(
    pointmaps: Sequence[Pointmap],
    images: Mapping[str, Image],
    config: SceneInitializationConfig,
    masks: Mapping[str, Mask | None] = MappingProxyType({}),
    exposures: Mapping[str, Exposure] = MappingProxyType({}),
    lenses: Mapping[str, Intrinsics | None] = MappingProxyType({}),
) -> Scene:
    """The scene with a training view for each point map, and Gaussians seeded from all of them.

    `images` (h, w, 3) are found by the point maps' names. Pixels of a dark rim, which do not show the
    scene, seed nothing. Nor do those that `masks` (h, w) hide, of which the point maps know nothing; where no view
    sees behind them, the fill goes on there. `exposures`, and the distortion of `lenses`, were taken out of the
    images.
    """
    pictures = [images[pointmap.name] for pointmap in pointmaps]
    valid = border.valid_masks(pictures)
    known_masks = [masks.get(pointmap.name) for pointmap in pointmaps]
    pointmaps = tuple(map(Pointmap.apply_image_mask, map(Pointmap.apply_mask, pointmaps, valid), known_masks))
    used = [rim if mask is None else rim & mask for rim, mask in zip(valid, known_masks, strict=True)]
    sure = find_consistent_pixels(pointmaps)
    shares = compute_consistent_shares(sure, used)
    usable = [each.apply_mask(each.confidence >= config.completion.min_usable_confidence) for each in pointmaps]
    surroundings = "fill" if config.pixelwise is None else config.pixelwise.surroundings
    shells = [] if surroundings == "none" else [_shell(usable, pictures, config)]
    limit = None if config.max_gaussians is None else config.max_gaussians - sum(map(len, shells))
    dense = pointmaps
    if surroundings == "fill":
        dense = list(
            map(Pointmap.apply_mask, completion.complete(usable, pictures, config.completion, known_masks), valid)
        )
    del usable
    if config.pixelwise is not None:
        surfaces = pixelwise.pixelwise_gaussians(dense, pictures, config.pixelwise, limit)
        return Scene(_views(dense, shares, images, masks, exposures, lenses), concatenate([surfaces, *shells]))
    surfaces = seeding.initialize_gaussians(dense, pictures, config.seeding)
    num_unlimited = len(surfaces) + sum(map(len, shells))
    if limit is not None and len(surfaces) > limit:
        surfaces = seeding.initialize_gaussians(dense, pictures, config.seeding, limit)
    return Scene(
        _views(pointmaps, shares, images, masks, exposures, lenses),
        concatenate([surfaces, *shells]),
        num_unlimited=num_unlimited,
    )


def _shell(pointmaps: Sequence[Pointmap], pictures: Sequence[Image], config: SceneInitializationConfig) -> Gaussians:
    limit = None if config.max_gaussians is None else config.max_gaussians // SHELL_PARTS
    return background.far_shell(pointmaps, pictures, config.background, limit)


def _views(
    pointmaps: Sequence[Pointmap],
    shares: Sequence[float],
    images: Mapping[str, Image],
    masks: Mapping[str, Mask | None],
    exposures: Mapping[str, Exposure],
    lenses: Mapping[str, Intrinsics | None],
) -> tuple[TrainingView, ...]:
    return tuple(
        TrainingView(
            name=pointmap.name,
            frame_id=pointmap.frame_id,
            image=images[pointmap.name],
            T_world_camera=torch.tensor(pointmap.T_world_camera, dtype=torch.float32),
            K=torch.tensor(pointmap.K, dtype=torch.float32),
            pointmap=pointmap,
            mask=masks.get(pointmap.name),
            exposure=exposures.get(pointmap.name),
            lens=lenses.get(pointmap.name),
            consistent_depth=share,
        )
        for pointmap, share in zip(pointmaps, shares, strict=True)
    )
