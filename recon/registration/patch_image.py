"""The image of a view as patches are taken from it: grey, smoothed, and of limited size."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.registration.patch_alignment import Grey

Array = npt.NDArray[np.float64]


class PatchImageConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    max_longer_side: int = 1600  # larger images are shrunk, pixels
    blur_px: float = 0.7  # sigma of the smoothing, after shrinking: interpolation errs less in a smooth image


@dataclass(frozen=True, eq=False)
class PatchImage:
    """A grey image of a frame; the frame's pixels are relative to its nominal principal point."""

    grey: Grey  # (h, w) 0 to 255
    scale: Array  # (2,) its pixels per pixel of the frame, horizontally and vertically
    principal: Array  # (2,) nominal principal point, pixels of the frame
    size: Array  # (2,) width and height of the frame, pixels

    def map_to_grey(self, pixels: Array) -> Array:
        """(M, 2) pixels of the grey image, from `pixels` (M, 2) of the frame relative to its principal point."""
        return (pixels + self.principal) * self.scale

    def map_from_grey(self, pixels: Array) -> Array:
        """(M, 2) the inverse of `map_to_grey`."""
        return pixels / self.scale - self.principal

    def rescale(self, scale: float) -> PatchImage:
        """The same image, as that of the frame resized by this factor."""
        return PatchImage(self.grey, self.scale / scale, scale * self.principal, scale * self.size)


def patch_image(image: npt.NDArray[np.uint8], principal: Array, config: PatchImageConfig) -> PatchImage:
    """The patch image of a frame's `image` (H, W, 3) RGB with its principal point (2,) in pixels."""
    height, width = image.shape[:2]
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    shrink = min(1.0, config.max_longer_side / max(width, height))
    if shrink < 1.0:
        grey = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    grey = cv2.GaussianBlur(grey, (0, 0), config.blur_px).astype(np.float32)
    size = np.array([width, height], np.float64)
    return PatchImage(grey, np.array(grey.shape[::-1]) / size, principal, size)
