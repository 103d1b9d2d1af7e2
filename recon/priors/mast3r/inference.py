"""Photographs through the network: every image is encoded once, every ordered pair decoded once."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recon.keyframe import Keyframe
from recon.priors.mast3r.alignment import PairPoints
from recon.priors.mast3r.network import Encoded, Prediction

Image = npt.NDArray[np.uint8]
_PATCH = 16


class Network(Protocol):
    """What the prior needs of a network; `Mast3r` is one."""

    def encode(self, image: Tensor) -> Encoded: ...

    def decode(self, first: Encoded, second: Encoded) -> tuple[Prediction, Prediction]: ...


@dataclass(frozen=True)
class Crop:
    """How a photograph became the network's image: scaled, then cut evenly at all sides to whole patches."""

    scale: float  # network pixels per pixel of the photograph
    left: float  # network pixels that were cut
    top: float
    width: int  # of the network's image
    height: int

    def to_network(self, pixels: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(M, 2) pixels of the photograph as pixels of the network's image."""
        return pixels * self.scale - [self.left, self.top]


def crop(width: int, height: int, longer_side: int) -> Crop:
    """The crop of a photograph of `width` x `height`. Raises ValueError where a side would be below one patch."""
    scale = longer_side / max(width, height)
    scaled_width, scaled_height = round(width * scale), round(height * scale)
    cut_width, cut_height = (side // _PATCH * _PATCH for side in (scaled_width, scaled_height))
    if not cut_width * cut_height:
        raise ValueError(f"an image of {width}x{height} is too thin for MASt3R: no side may be below 1/32 of the other")
    left, top = (scaled_width - cut_width) // 2, (scaled_height - cut_height) // 2
    return Crop(scale, left, top, cut_width, cut_height)


def prepared(image: Image, to: Crop) -> Tensor:
    """(3, H, W) in [-1, 1]: what the network sees of a photograph (h, w, 3)."""
    size = (round(image.shape[1] * to.scale), round(image.shape[0] * to.scale))
    resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA if to.scale < 1 else cv2.INTER_CUBIC)
    top, left = int(to.top), int(to.left)
    cut = resized[top : top + to.height, left : left + to.width]
    return torch.from_numpy(cut).permute(2, 0, 1).float() / 127.5 - 1.0


class Asked:
    """What the network has said about photographs and pairs of them, each asked about once."""

    def __init__(self, network: Network, longer_side: int) -> None:
        self._network, self._longer_side = network, longer_side
        self._encoded: dict[str, Encoded] = {}
        self._pairs: dict[tuple[str, str], tuple[Prediction, Prediction]] = {}

    def crop_of(self, keyframe: Keyframe) -> Crop:
        return crop(keyframe.frame.width, keyframe.frame.height, self._longer_side)

    @torch.inference_mode()
    def pair(self, first: Keyframe, second: Keyframe) -> tuple[Prediction, Prediction]:
        """What the ordered pair says about its first and its second photograph, in the first camera's frame."""
        names = first.name, second.name
        if names not in self._pairs:
            self._pairs[names] = self._network.decode(self._encode(first), self._encode(second))
        return self._pairs[names]

    def points(self, keyframes: Sequence[Keyframe], max_neighbours: int) -> dict[tuple[int, int], PairPoints]:
        """By position, all ordered pairs at most `max_neighbours` places apart in a circle. Others are forgotten."""
        names = [keyframe.name for keyframe in keyframes]
        self._pairs = {pair: what for pair, what in self._pairs.items() if pair[0] in names and pair[1] in names}
        count = len(keyframes)
        found = {}
        for i, j in itertools.permutations(range(count), 2):
            if min((i - j) % count, (j - i) % count) <= max_neighbours:
                first, second = self.pair(keyframes[i], keyframes[j])
                found[i, j] = PairPoints(
                    first.points.numpy(), first.confidence.numpy(), second.points.numpy(), second.confidence.numpy()
                )
        return found

    def _encode(self, keyframe: Keyframe) -> Encoded:
        if keyframe.name not in self._encoded:
            to = self.crop_of(keyframe)
            self._encoded[keyframe.name] = self._network.encode(prepared(keyframe.frame.image, to))
        return self._encoded[keyframe.name]
