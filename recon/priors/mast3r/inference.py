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
from splatnode.recon.networks.crop import Crop, crop, cropped
from splatnode.recon.networks.lru_cache import LruCache
from splatnode.recon.priors.mast3r.global_alignment import PairPoints
from splatnode.recon.priors.mast3r.network import Encoded, Prediction

PATCH = 16
_KEPT_IMAGES = 32  # in tokens: 100 MB
_KEPT_PAIRS = 160  # with their points, up to 1 GB: 13 frames have 156 ordered pairs


class Network(Protocol):
    """What the prior needs of a network; `Mast3r` is one."""

    def encode(self, image: Tensor) -> Encoded:
        """An image as `prepared` gives it, after the encoder."""
        ...

    def decode(self, first: Encoded, second: Encoded) -> tuple[Prediction, Prediction]:
        """What the ordered pair says of its two images, in the first camera's frame."""
        ...


class Asked:
    """What the network says about photographs and pairs of them.

    An image in tokens takes 3 MB and the points of a pair 6 MB at full size; what was asked for lately is kept.
    """

    def __init__(self, network: Network, longer_side: int) -> None:
        self._network, self._longer_side = network, longer_side
        self._encoded: LruCache[str, Encoded] = LruCache(_KEPT_IMAGES)
        self._points: LruCache[tuple[str, str], PairPoints] = LruCache(_KEPT_PAIRS)

    def crop_of(self, keyframe: Keyframe) -> Crop:
        """How the keyframe's photograph is scaled and cut for the network."""
        return crop(keyframe.frame.width, keyframe.frame.height, self._longer_side, PATCH)

    @torch.inference_mode()
    def pair(self, first: Keyframe, second: Keyframe) -> tuple[Prediction, Prediction]:
        """What the ordered pair says about its first and its second photograph, in the first camera's frame."""
        predictions = self._network.decode(self._encode(first), self._encode(second))
        self._points.get((first.name, second.name), lambda: _points_of(*predictions))
        return predictions

    def points(self, keyframes: Sequence[Keyframe], max_neighbours: int) -> dict[tuple[int, int], PairPoints]:
        """By position, all ordered pairs at most `max_neighbours` places apart in a circle."""
        count = len(keyframes)
        found = {}
        for i, j in itertools.permutations(range(count), 2):
            if min((i - j) % count, (j - i) % count) <= max_neighbours:
                first, second = keyframes[i], keyframes[j]
                asked = partial(self.pair, first, second)
                found[i, j] = self._points.get((first.name, second.name), lambda asked=asked: _points_of(*asked()))
        return found

    def _encode(self, keyframe: Keyframe) -> Encoded:
        def encoded() -> Encoded:
            return self._network.encode(prepared(keyframe.frame.image, self.crop_of(keyframe)))

        return self._encoded.get(keyframe.name, encoded)


def prepared(image: npt.NDArray[np.uint8], to: Crop) -> Tensor:
    """(3, H, W) in [-1, 1]: what the network sees of a photograph (h, w, 3)."""
    return cropped(image, to).permute(2, 0, 1) * 2.0 - 1.0


def _points_of(first: Prediction, second: Prediction) -> PairPoints:
    return PairPoints(*(part.numpy() for view in (first, second) for part in (view.points, view.confidence)))
