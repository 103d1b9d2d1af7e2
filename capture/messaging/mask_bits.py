"""The mask of a frame as an array of a message, a bit a pixel: a frame without one has its image alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame


def arrays_of(frame: Frame) -> list[npt.NDArray]:
    """The image (H, W, 3) and, where it has a mask, that (H, ceil(W / 8)), the first pixel in the highest bit."""
    return [frame.image] if frame.mask is None else [frame.image, np.packbits(frame.mask, axis=1)]


def mask_in(arrays: Sequence[npt.NDArray]) -> npt.NDArray[np.bool_] | None:
    """The mask (H, W) in what `arrays_of` gave. Raises ValueError where it is none of that image."""
    if len(arrays) not in (1, 2):
        raise ValueError(f"a frame has one image and at most one mask, got {len(arrays)} arrays")
    if len(arrays) == 1:
        return None
    image, bits = arrays
    height, width = image.shape[:2] if image.ndim >= 2 else (0, 0)
    if bits.dtype != np.uint8 or bits.shape != (height, (width + 7) // 8):
        raise ValueError(
            f"the mask of an image {width} x {height} must be ({height}, {(width + 7) // 8}) uint8, a bit a pixel, "
            f"got {bits.shape} {bits.dtype}"
        )
    return np.unpackbits(bits, axis=1, count=width).astype(bool)
