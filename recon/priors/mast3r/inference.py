"""Photographs through the network: every image is encoded once, every ordered pair decoded once."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.networks.crop import Crop, crop, crop_image
from splatnode.recon.networks.lru_cache import LruCache
from splatnode.recon.priors.mast3r.global_alignment import PairPoints
from splatnode.recon.priors.mast3r.network import EncodedImage, Prediction

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
