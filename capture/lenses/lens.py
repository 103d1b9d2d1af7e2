"""Through which pixel a ray is seen, and which ray a pixel shows, whatever the model of the lens."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics
from splatnode.capture.lenses import fisheye, opencv

Array = npt.NDArray[np.float64]

_MODELS = {"opencv": opencv, "fisheye": fisheye}


def project(rays: Array, lens: Intrinsics) -> Array:
    """(M, 2) pixels of rays (M, 3) of any length, camera frame; the top-left pixel's centre is at (0.5, 0.5).

    Not a number where the lens does not see the ray.
    """
    if rays.ndim != 2 or rays.shape[1] != 3:
        raise ValueError(f"rays must be (M, 3), got {rays.shape}")
    return _MODELS[lens.model].project(np.asarray(rays, np.float64), lens)


def unproject(pixels: Array, lens: Intrinsics) -> Array:
    """(M, 3) unit rays, camera frame, of pixels (M, 2); not a number where no ray meets the pixel."""
    if pixels.ndim != 2 or pixels.shape[1] != 2:
        raise ValueError(f"pixels must be (M, 2), got {pixels.shape}")
    return _MODELS[lens.model].unproject(np.asarray(pixels, np.float64), lens)
