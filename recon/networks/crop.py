"""Photographs at the size that a network wants: scaled, then cut evenly to whole patches."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor


@dataclass(frozen=True)
class Crop:
    """How a photograph became the network's image."""

    scale: float  # network pixels per pixel of the photograph
    left: int  # network pixels that were cut
    top: int
    width: int  # of the network's image
    height: int

    def map_to_network(self, pixels: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(M, 2) pixels of the photograph as pixels of the network's image."""
        return pixels * self.scale - [self.left, self.top]

    def map_to_image(self, pixels: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(M, 2) pixels of the network's image as pixels of the photograph."""
        return (pixels + [self.left, self.top]) / self.scale

    def crop_centre(self, width: int, height: int) -> Crop:
        """The middle of it, of at most `width` x `height`."""
        width, height = min(width, self.width), min(height, self.height)
        left, top = self.left + (self.width - width) // 2, self.top + (self.height - height) // 2
        return replace(self, left=left, top=top, width=width, height=height)


def crop(width: int, height: int, longer_side: int, patch: int) -> Crop:
    """The crop of a photograph of `width` x `height`. Raises ValueError where a side would be below one patch."""
    scale = longer_side / max(width, height)
    scaled_width, scaled_height = round(width * scale), round(height * scale)
    cut_width, cut_height = (side // patch * patch for side in (scaled_width, scaled_height))
    if not cut_width * cut_height:
        raise ValueError(
            f"an image of {width}x{height} is too thin for the network: "
            f"no side may be below 1/{longer_side // patch} of the other"
        )
    left, top = (scaled_width - cut_width) // 2, (scaled_height - cut_height) // 2
    return Crop(scale, left, top, cut_width, cut_height)


def crop_image(image: npt.NDArray[np.uint8], to: Crop) -> Tensor:
    """(H, W, 3) in [0, 1]: what the network sees of a photograph (h, w, 3)."""
    size = (round(image.shape[1] * to.scale), round(image.shape[0] * to.scale))
    resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA if to.scale < 1 else cv2.INTER_CUBIC)
    cut = resized[to.top : to.top + to.height, to.left : to.left + to.width]
    return torch.from_numpy(np.ascontiguousarray(cut)).float() / 255.0
