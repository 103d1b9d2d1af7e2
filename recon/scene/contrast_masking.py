"""Contrast masking: a difference of colour is visible in full on a plain surface, and less where contrast is strong."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

# Standard deviation of the colours, in [0, 1], around a pixel at which half of a squared difference is visible.
# Half as much changed nothing (`PLAIN` in docs/tried.md).
MASKING_STD = 0.03
WINDOW_PX = 13.0  # side of the square around a pixel that masks it, at the reference's size: SSIM's window has 11

Float32 = npt.NDArray[np.float32]


def visibility(image: Float32, scale: float) -> Float32:
    """(h, w) factors in (0, 1] by which differences from an `image` (h, w, 3) in [0, 1] count.

    SSIM weighs a difference of structure in the same way (Wang et al. 2004): by the variance around it. `scale` is the
    image's size over the reference's (`seeding.REFERENCE_PX`).
    """
    side = 2 * round(WINDOW_PX * scale / 2) + 1
    mean = cv2.blur(image, (side, side))
    variance = np.maximum(cv2.blur(image**2, (side, side)) - mean**2, 0.0).mean(2)
    return np.asarray(MASKING_STD / np.sqrt(variance + MASKING_STD**2), np.float32)
