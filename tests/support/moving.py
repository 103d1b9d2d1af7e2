"""A thing that moves: one look, pasted elsewhere over each photograph."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame


@lru_cache(maxsize=2)
def look_of(seed: int, width: int = 640, height: int = 480) -> np.ndarray:
    """(height, width, 3) of the built-in place of this seed."""
    config = synthetic.Config(seed=seed, width=width, height=height)
    return synthetic.render_image(config, synthetic.scene_cameras(config)[0])


def pasted(frame: Frame, share: float, seed: int, look: np.ndarray) -> tuple[Frame, np.ndarray]:
    """The frame with an ellipse of `look` over `share` of it, and the mask (H, W) of what it leaves free."""
    place = np.random.default_rng(seed)
    height, width = frame.image.shape[:2]
    radius = np.sqrt(share / np.pi) * np.array([width, height])
    centre = place.uniform(radius, np.array([width, height]) - radius)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    inside = ((x - centre[0]) / radius[0]) ** 2 + ((y - centre[1]) / radius[1]) ** 2 <= 1.0
    rows, columns = np.nonzero(inside)
    top, left = rows.min(), columns.min()
    size = int(columns.max() - left + 1), int(rows.max() - top + 1)
    thing = cv2.resize(look, size, interpolation=cv2.INTER_AREA)
    image = frame.image.copy()
    image[rows, columns] = thing[rows - top, columns - left]
    return replace(frame, image=image, encoded=None), ~inside
