"""A small picture of each recording, for the page: its result's preview, or a photograph where there is no scene."""

from __future__ import annotations

import base64
from pathlib import Path

import cv2
import numpy as np

from splatnode.capture.cameras.folder import image_paths
from splatnode.capture.image_file import UnusableImage, read_image_file

PREVIEW = "preview.png"
_WIDTH, _QUALITY = 320, 70  # pixels, of JPEG


def make_data_url(result: Path, source: Path) -> str | None:
    """A `data:` address of a JPEG; None where there is nothing to show."""
    path = result / PREVIEW
    if not path.is_file():
        photographs = image_paths(source) if source.is_dir() else []
        if not photographs:
            return None
        path = photographs[len(photographs) // 2]
    try:
        data = read_image_file(path)
    except (UnusableImage, OSError):
        return None
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_REDUCED_COLOR_2)
    return None if image is None else _encode_preview(image)


def _encode_preview(image: np.ndarray) -> str:
    height, width = image.shape[:2]
    size = min(_WIDTH, width), max(1, round(height * min(_WIDTH, width) / width))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode()
