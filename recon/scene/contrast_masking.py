"""How visible a difference of colour is: in full on a plain surface, the less the stronger the contrast around it."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

PLAIN = 0.03  # standard deviation of colours in [0, 1] around a pixel at which half of a squared difference is seen
REACH_PX = 13.0  # side of the square around a pixel that masks it, in images of the reference's size

Float32 = npt.NDArray[np.float32]


def visibility(image: Float32, scale: float) -> Float32:
    """(h, w) the factors in (0, 1] by which differences from an `image` (h, w, 3) in [0, 1] count.

    This is how SSIM weighs a difference of structure (Wang et al. 2004): by the variance around it. `scale` is the
    image's size in units of the reference's.
    """
    side = 2 * round(REACH_PX * scale / 2) + 1
    mean = cv2.blur(image, (side, side))
    variance = np.maximum(cv2.blur(image**2, (side, side)) - mean**2, 0.0).mean(2)
    return np.asarray(PLAIN / np.sqrt(variance + PLAIN**2), np.float32)
