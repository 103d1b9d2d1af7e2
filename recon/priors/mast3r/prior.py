"""MASt3R as a prior: matches by its descriptors, depth by global alignment of its point maps."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.capture.process.config_keys import Internal
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.networks.vit import Crop, crop, crop_image
from splatnode.recon.networks.weights import LruCache, find
from splatnode.recon.priors.mast3r.global_alignment import PairPoints, align_views
from splatnode.recon.priors.mast3r.network import EncodedImage, Prediction, load_network
from splatnode.recon.priors.monocular import make_registered_pointmap
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.priors.prior import Prior
from splatnode.recon.registration.registration import Registration

# Photographs through the network: every image is encoded once, every ordered pair decoded once.

PATCH = 16
_KEPT_IMAGES = 32  # in tokens: 100 MB
_KEPT_PAIRS = 160  # with their points, up to 1 GB: 13 frames have 156 ordered pairs


class Network(Protocol):
    """The interface of the prior's network; `Mast3r` implements it."""

    def encode(self, image: Tensor) -> EncodedImage:
        """An image as `prepare_image` gives it, after the encoder."""
        ...

    def decode(self, first: EncodedImage, second: EncodedImage) -> tuple[Prediction, Prediction]:
        """Predicts both images of the ordered pair, in the first camera's frame."""
        ...


class NetworkCache:
    """A cache of the network's predictions for images and pairs of them.

    An image in tokens takes 3 MB and the points of a pair 6 MB at full size; what was asked for lately is kept.
    """

    def __init__(self, network: Network, longer_side: int) -> None:
        self._network, self._longer_side = network, longer_side
        self._encoded: LruCache[str, EncodedImage] = LruCache(_KEPT_IMAGES)
        self._points: LruCache[tuple[str, str], PairPoints] = LruCache(_KEPT_PAIRS)

    def make_crop(self, keyframe: Keyframe) -> Crop:
        """How the keyframe's photograph is scaled and cut for the network."""
        return crop(keyframe.frame.width, keyframe.frame.height, self._longer_side, PATCH)

    @torch.inference_mode()
    def predict_pair(self, first: Keyframe, second: Keyframe) -> tuple[Prediction, Prediction]:
        """Predicts the first and the second image of the ordered pair, in the first camera's frame."""
        predictions = self._network.decode(self._encode(first), self._encode(second))
        self._points.get((first.name, second.name), lambda: _make_pair_points(*predictions))
        return predictions

    def predict_points(self, keyframes: Sequence[Keyframe], max_neighbours: int) -> dict[tuple[int, int], PairPoints]:
        """Predicts points of all ordered pairs at most `max_neighbours` places apart in a circle, by position."""
        count = len(keyframes)
        found = {}
        for i, j in itertools.permutations(range(count), 2):
            if min((i - j) % count, (j - i) % count) <= max_neighbours:
                first, second = keyframes[i], keyframes[j]
                asked = partial(self.predict_pair, first, second)
                found[i, j] = self._points.get(
                    (first.name, second.name), lambda asked=asked: _make_pair_points(*asked())
                )
        return found

    def _encode(self, keyframe: Keyframe) -> EncodedImage:
        def encode_image() -> EncodedImage:
            return self._network.encode(prepare_image(keyframe.frame.image, self.make_crop(keyframe)))

        return self._encoded.get(keyframe.name, encode_image)


def prepare_image(image: npt.NDArray[np.uint8], to: Crop) -> Tensor:
    """(3, H, W) in [-1, 1]: what the network sees of a photograph (h, w, 3)."""
    return crop_image(image, to).permute(2, 0, 1) * 2.0 - 1.0


def _make_pair_points(first: Prediction, second: Prediction) -> PairPoints:
    return PairPoints(*(part.numpy() for view in (first, second) for part in (view.points, view.confidence)))


log = logging.getLogger(__name__)

WEIGHTS = ("mast3r/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth",)
LICENCE = (
    "MASt3R's weights are licensed CC BY-NC-SA 4.0 (with the terms of its training sets, mapfree among them): "
    "for non-commercial use only."
)


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """MASt3R as a prior: matches by its descriptors, depth by global alignment of its point maps."""

    weights: Path | None = None  # file of the network's; None: where `splatnode weights` puts them
    longer_side: int = 512  # of the network's images, pixels: what it was trained with
    max_neighbours: Internal[int] = 6  # places in the circle of frames: of up to 13 frames every pair is asked about
    seed: Internal[int] = 0  # every prior has one; global alignment has a fixed one


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
