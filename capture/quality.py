"""Blur, exposure, duplicate: is this frame worth sending?

Pure functions give numbers; why_unusable and why_redundant compare them with limits. The limits are wide: a poor frame
is better judged by the reconstruction, and only a hopeless or redundant one is kept from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]  # (H, W, 3) RGB

MEASURED_SIDE = 640  # blur is measured with the longer side at most this
THUMBNAIL_SIDE = 160
BOX = 15  # texels of the box that blurs again; wider edges cannot be told apart
EDGE_STEP = 6.0  # grey levels a pixel; weaker gradients may be noise
LEAST_EDGES = 0.001  # share of the pixels


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    blur_px: float = 8.0  # real sharp photographs reach 7, of smooth objects
    relative_blur: float = 3.0  # times the sharpest of the stream
    exposed: float = 0.03  # least share of pixels that are neither black nor white; dark backgrounds are common
    contrast: float = 3.0  # grey levels; noise leaves up to 2, real photographs have 20
    novelty: float = 0.05  # half a pixel of motion, at 640 pixels


@dataclass(frozen=True)
class Quality:
    blur_px: float | None  # width of the image's edges in its most blurred direction; None: it has no edges
    dark: float  # share of pixels without detail because they are black
    bright: float  # the same for white
    contrast: float  # standard deviation of the grey levels, noise averaged out


def assess(image: Image) -> Quality:
    grey = _grey(image, THUMBNAIL_SIDE)
    red, green, blue = cv2.split(image)
    return Quality(
        blur_px=blur_width(image),
        dark=float((cv2.max(cv2.max(red, green), blue) < 8).mean()),
        bright=float((cv2.min(cv2.min(red, green), blue) > 250).mean()),
        contrast=float(grey.std()),
    )


def blur_width(image: Image) -> float | None:
    """Width of the strongest edges in pixels, at a longer side of 640, in the direction where they are widest.

    The image is blurred again by a box along each of four directions, and the loss of gradient is compared with the
    gradient (after Crete et al., "The blur effect", 2007): an edge `w` wide keeps w / BOX of its slope, whatever its
    contrast is. Motion blur widens edges in one direction only, hence the maximum. None: no edge to measure.
    """
    grey = _grey(image, MEASURED_SIDE)
    widths = [_edge_width(grey, step) for step in ((0, 1), (1, 1), (1, 0), (1, -1))]
    return max((width for width in widths if width is not None), default=None)


def _edge_width(grey: npt.NDArray, step: tuple[int, int]) -> float | None:
    """Pixels along `step` (rows, columns)."""
    slope = _slope(grey, step)
    strong = slope >= max(float(np.quantile(slope[::2, ::2], 0.9)), EDGE_STEP)  # a sample tells as much
    if strong.mean() < LEAST_EDGES:
        return None
    lost = np.maximum(slope - _slope(_box_mean(grey, step), step), 0)
    return float(BOX * (1 - lost[strong].sum() / slope[strong].sum()))


def _box_mean(grey: npt.NDArray, step: tuple[int, int]) -> npt.NDArray[np.float32]:
    """Mean of BOX pixels along `step`: a sum of shifted images, faster than a filter with a sparse kernel."""
    half = BOX // 2
    padded = cv2.copyMakeBorder(grey, half, half, half, half, cv2.BORDER_REFLECT_101)
    rows, columns = grey.shape
    total = np.zeros_like(grey)
    for along in range(-half, half + 1):
        top, left = half + along * step[0], half + along * step[1]
        total += padded[top : top + rows, left : left + columns]
    return np.divide(total, BOX, dtype=np.float32)


def _slope(grey: npt.NDArray, step: tuple[int, int]) -> npt.NDArray[np.float32]:
    """Absolute difference between each pixel and the next one along `step` (rows, columns)."""
    down, right, left = step[0], max(step[1], 0), max(-step[1], 0)
    rows, columns = grey.shape
    return np.abs(grey[down:, right : columns - left] - grey[: rows - down, left : columns - right])


def novelty(image: Image, other: Image) -> float:
    """How much of `image` is not `other`: the RMS difference of thumbnails of unit contrast, about 0 to 1.5.

    Measured: 0 for a copy, up to 0.025 for one with sensor noise, 0.1 to 0.2 after a pixel of motion at 640 pixels,
    above 0.25 between neighbours of a capture. Saturated pixels, which a change of exposure alters, do not count.
    """
    if image.shape != other.shape:
        return float("inf")
    a, b = _grey(image, THUMBNAIL_SIDE), _grey(other, THUMBNAIL_SIDE)
    valid = (np.minimum(a, b) > 4) & (np.maximum(a, b) < 245)
    if valid.mean() < 0.05:
        valid[:] = True
    a, b = a[valid], b[valid]
    difference = (a - a.mean()) / (a.std() + 1) - (b - b.mean()) / (b.std() + 1)
    return float(np.sqrt(np.mean(difference**2)))


def why_unusable(quality: Quality, limits: Limits, sharpest_px: float | None = None) -> str | None:
    """Why a frame should be left out; None where it is usable. `sharpest_px`: the least blur of its stream so far."""
    exposed = 1 - quality.dark - quality.bright
    if exposed < limits.exposed:
        what, share = ("under", quality.dark) if quality.dark > quality.bright else ("over", quality.bright)
        return f"{what}exposed: {share:.0%} of its pixels show nothing"
    if quality.contrast < limits.contrast:
        return f"blank: its contrast is {quality.contrast:.1f} grey levels, at least {limits.contrast} are needed"
    if quality.blur_px is None:
        return "blank or out of focus: it has no edges"
    if quality.blur_px > limits.blur_px:
        return f"blurred: its edges are {quality.blur_px:.1f} px wide, at most {limits.blur_px} are allowed"
    if sharpest_px is not None and quality.blur_px > limits.relative_blur * max(sharpest_px, 1):
        return f"blurred: its edges are {quality.blur_px:.1f} px wide, those of the sharpest frame {sharpest_px:.1f}"
    return None


def why_redundant(measured: float, limits: Limits) -> str | None:
    """Why a frame of this `measured` novelty adds nothing to the frame it was compared with; None for a new view."""
    if measured < limits.novelty:
        return f"duplicate: it differs from an earlier frame by {measured:.3f}, at least {limits.novelty} is a new view"
    return None


def _grey(image: Image, longer_side: int) -> npt.NDArray[np.float32]:
    """(h, w) grey levels, area-resampled to at most `longer_side`."""
    scale = min(1.0, longer_side / max(image.shape[:2]))
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    grey = cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    return grey.astype(np.float32)
