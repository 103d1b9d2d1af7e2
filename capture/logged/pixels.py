"""A message's picture as an RGB image."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.image_file import UnusableImage, decode_image
from splatnode.capture.logged.message import Layout, Picture, UnusableMessage
from splatnode.capture.process.printable import sanitize_text

_CODES = {  # bytes a pixel, and OpenCV's conversion to RGB; None: it is RGB
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    # OpenCV names a pattern by its second row's second and third pixels, the others by its first two.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
}


def is_colour_image(picture: Picture) -> bool:
    """Whether its pixels are those of a photograph; depth, such as 16UC1 and 32FC1, are not."""
    return picture.layout is None or picture.layout.encoding in _CODES


def rgb(picture: Picture, max_pixels: int) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB. Raises UnusableMessage."""
    if picture.layout is None:
        try:
            return decode_image(picture.data, max_pixels).image
        except UnusableImage as error:
            raise UnusableMessage(str(error)) from error
    return _decode_rows(picture.data, picture.layout, max_pixels)


def _decode_rows(data: bytes, layout: Layout, max_pixels: int) -> npt.NDArray[np.uint8]:
    if layout.encoding not in _CODES:
        raise UnusableMessage(
            f"an image must have an encoding of {', '.join(_CODES)}, it has {sanitize_text(layout.encoding, 40) or 'none'}"
        )
    channels, code = _CODES[layout.encoding]
    width, height, row = layout.width, layout.height, layout.width * channels
    if not 0 < width * height <= max_pixels:
        raise UnusableMessage(f"{width} x {height}: an image must have 1 to {max_pixels} pixels")
    if layout.step < row or len(data) < layout.step * (height - 1) + row:
        raise UnusableMessage(
            f"{width} x {height} of {channels} bytes must have rows of {row} bytes or more, it has rows of "
            f"{layout.step} and {len(data)} bytes in all"
        )
    padded = np.frombuffer(data[: layout.step * height].ljust(layout.step * height, b"\0"), np.uint8)
    pixels = np.ascontiguousarray(padded.reshape(height, layout.step)[:, :row]).reshape(height, width, channels)
    try:
        image = pixels if code is None else cv2.cvtColor(pixels, code)
    except cv2.error as error:  # such as a Bayer pattern of one row
        raise UnusableMessage(f"{width} x {height} of {layout.encoding} cannot be converted: {error.err}") from error
    return image.astype(np.uint8, copy=False)
