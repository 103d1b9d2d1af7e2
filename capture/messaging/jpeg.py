"""Photographs in messages: JPEG files, with a bound on what a sender may have the receiver decode."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.capture.image_file import UnusableImage, decode_image, encode_jpeg
from splatnode.capture.messaging.wire import WireError


def make_jpeg_array(image: npt.NDArray[np.uint8], quality: int) -> npt.NDArray[np.uint8]:
    """`image` (H, W, 3) RGB as the bytes (N,) of a JPEG file; `quality` is 1 to 100."""
    return np.frombuffer(encode_jpeg(image, quality), np.uint8)


def decode_jpeg(jpeg: npt.NDArray, largest_side: int) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB. Raises WireError where it is no JPEG, or one with a side of more than `largest_side` pixels."""
    if jpeg.dtype != np.uint8 or jpeg.ndim != 1 or jpeg.size == 0:
        raise WireError(f"a photograph must be the bytes of a JPEG file, got {jpeg.dtype} {jpeg.shape}")
    try:
        image = decode_image(jpeg.tobytes(), largest_side**2)[0]
    except UnusableImage as error:
        raise WireError(f"a photograph that cannot be shown: {error}") from error
    if max(image.shape) > largest_side:
        raise WireError(f"a photograph must be at most {largest_side} pixels long, got {image.shape}")
    return image
