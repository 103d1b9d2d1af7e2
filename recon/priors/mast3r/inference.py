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


@dataclass(frozen=True, eq=False)
class Answers:
    """What the network says about a set of photographs."""

    crops: tuple[Crop, ...]
    pairs: dict[tuple[int, int], tuple[Prediction, Prediction]]  # by position (first, second)

    def points(self) -> dict[tuple[int, int], PairPoints]:
        return {
            pair: PairPoints(
                first.points.numpy(), first.confidence.numpy(), second.points.numpy(), second.confidence.numpy()
            )
            for pair, (first, second) in self.pairs.items()
        }


@torch.inference_mode()
def ask(network: Network, images: Sequence[Image], longer_side: int, max_neighbours: int) -> Answers:
    """Every ordered pair of photographs at most `max_neighbours` places apart in the (circular) order they came in."""
    crops = tuple(crop(image.shape[1], image.shape[0], longer_side) for image in images)
    encoded = [network.encode(prepared(image, to)) for image, to in zip(images, crops, strict=True)]
    count = len(images)
    pairs = {
        (i, j): network.decode(encoded[i], encoded[j])
        for i, j in itertools.permutations(range(count), 2)
        if min((i - j) % count, (j - i) % count) <= max_neighbours
    }
    return Answers(crops, pairs)
