"""MASt3R as a prior: matches by its descriptors, depth by global alignment of its point maps."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt
import torch

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.networks.crop import Crop
from splatnode.recon.networks.weight_folder import find
from splatnode.recon.priors.mast3r.global_alignment import align_views
from splatnode.recon.priors.mast3r.inference import Network, NetworkCache
from splatnode.recon.priors.mast3r.network import Prediction, load_network
from splatnode.recon.priors.network_depth import make_registered_pointmap
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.priors.prior import Prior
from splatnode.recon.registration.register import Registration

log = logging.getLogger(__name__)

WEIGHTS = ("mast3r/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth",)
LICENCE = (
    "MASt3R's weights are licensed CC BY-NC-SA 4.0 (with the terms of its training sets, mapfree among them): "
    "for non-commercial use only."
)


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    weights: Path | None = None  # file of the network's; None: where `splatnode weights` puts them
    longer_side: int = 512  # of the network's images, pixels: what it was trained with
    max_neighbours: int = 6  # places in the circle of frames: of up to 13 frames every pair is asked about
    seed: int = 0  # every prior has one; global alignment has a fixed one


class Mast3rPrior(Prior):
    """Matches between detected features by the network's descriptors, depth by global alignment.

    A match counts only where it is an inlier of its pair's epipolar geometry: matches that the network invents between
    unrelated photographs agree with none.
    """

    def __init__(self, network: Network, config: Config) -> None:
        self._config = config
        self._asked = NetworkCache(network, config.longer_side)
        self.matcher = DescriptorMatcher(self._asked)

    def pointmaps(
        self, graph: ViewGraph, registration: Registration, pause: Callable[[], None] = lambda: None
    ) -> tuple[Pointmap, ...]:
        """The aligned depth maps, each brought to the scale of the registered points that its camera sees."""
        keyframes = [graph.keyframes[camera.index] for camera in registration.cameras]
        views = align_views(self._asked.predict_points(keyframes, self._config.max_neighbours))
        pause()
        crops = [self._asked.make_crop(keyframe) for keyframe in keyframes]
        return tuple(
            make_registered_pointmap(graph, registration, camera, to, view.depth, view.confidence)
            for camera, view, to in zip(registration.cameras, views, crops, strict=True)
        )


@dataclass(frozen=True, eq=False)
class DescriptorMatcher:
    """A `recon.matching.match.Matcher` by the network's descriptors at the features that keyframes have."""

    asked: NetworkCache

    def add_points(self, keyframe: Keyframe) -> Keyframe:
        return keyframe

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> npt.NDArray[np.int64]:
        first, second = self.asked.predict_pair(keyframe1, keyframe2)
        found1, inside1 = _sample_descriptors(first, self.asked.make_crop(keyframe1), keyframe1)
        found2, inside2 = _sample_descriptors(second, self.asked.make_crop(keyframe2), keyframe2)
        matches = _match_mutual(found1, found2)
        return np.stack([inside1[matches[:, 0]], inside2[matches[:, 1]]], 1)


def load(config: Config) -> Mast3rPrior:
    """Raises WeightsError or FileNotFoundError without weights, ValueError where they are not MASt3R's."""
    network = load_network(config.weights or find(*WEIGHTS))
    log.info("%s", LICENCE)
    return Mast3rPrior(network, config)


def _sample_descriptors(
    prediction: Prediction, crop: Crop, keyframe: Keyframe
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """(F, D) descriptors at those features that the crop shows, and which they are (F,)."""
    pixels = np.floor(crop.map_to_network(keyframe.features.points)).astype(np.int64)
    (inside,) = np.nonzero(((pixels >= 0) & (pixels < [crop.width, crop.height])).all(1))
    descriptors = prediction.descriptors.numpy()[pixels[inside, 1], pixels[inside, 0]]
    return descriptors, inside


def _match_mutual(
    descriptors1: npt.NDArray[np.float32], descriptors2: npt.NDArray[np.float32]
) -> npt.NDArray[np.int64]:
    """(M, 2) mutual nearest neighbours, the most alike first."""
    if not len(descriptors1) or not len(descriptors2):
        return np.zeros((0, 2), np.int64)
    alike = torch.from_numpy(descriptors1) @ torch.from_numpy(descriptors2).T
    score, nearest = alike.max(1)
    (chosen,) = torch.nonzero(alike.argmax(0)[nearest] == torch.arange(len(nearest)), as_tuple=True)
    chosen = chosen[score[chosen].argsort(descending=True, stable=True)]
    return torch.stack([chosen, nearest[chosen]], 1).numpy()
