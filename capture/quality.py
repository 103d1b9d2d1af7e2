"""Image quality: blur, exposure, and whether a frame is a duplicate.

Pure functions measure; why_unusable and why_redundant compare what they measure with limits. The limits are wide: only
a frame that is useless or redundant is left out, and all others are the reconstruction's to judge.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.config import Internal

Image = npt.NDArray[np.uint8]  # (H, W, 3) RGB
Plane = npt.NDArray  # (H, W) grey levels, uint8, or sums of at most BOX of them, uint16

MEASURED_SIDE = 640  # blur is measured with the longer side at most this
THUMBNAIL_SIDE = 160
BOX = 15  # pixels of the box that blurs again, a multiple of 3; wider edges cannot be told apart
MIN_GRADIENT = 6  # grey levels a pixel; weaker gradients may be noise
WEAK_SHARE = 0.9  # of the pixels: those with the weakest gradients are no edges
MIN_EDGE_SHARE = 0.001  # of the pixels; an image with fewer on edges has none to measure
BLACK, WHITE = 7, 251  # grey levels from which on a pixel shows no detail
MIN_UNSATURATED, MAX_UNSATURATED = 4, 245  # grey levels between which a change of exposure leaves the contrast
MIN_COMPARED_SHARE = 0.05  # of the pixels: with fewer that are unsaturated in both images, all are compared


THUMBNAIL_PX = 128  # longer side of an image below which it is taken for a thumbnail, beside larger ones
THUMBNAIL_RATIO = 3.0  # of the largest image's longer side over a thumbnail's: a scaled set is none


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    # Widest edges of a usable frame, pixels at 640; sharp photographs of smooth objects reach 7
    max_blur_px: float = 8.0
    # A frame is unusable when its edges are so many times as wide as the sharpest frame's
    relative_blur: Internal[float] = 3.0
    # Least share of pixels that are neither black nor white; dark backgrounds are common
    min_exposed_share: float = 0.03
    # Least standard deviation, grey levels; noise leaves up to 2, real photographs have 20
    contrast: Internal[float] = 3.0
    # A frame is a copy when it differs by less from another; 0.05 is half a pixel of motion, at 640 pixels
    min_novelty: float = 0.05


@dataclass(frozen=True)
class Quality:
    blur_px: float | None  # width of the image's edges in its most blurred direction; None: it has no edges
    dark: float  # share of pixels that are black and so without detail
    bright: float  # share of pixels that are white
    contrast: float  # standard deviation of the grey levels, noise averaged out


def assess(image: Image) -> Quality:
    """Blur, exposure and contrast of `image`."""
    pixels = image.shape[0] * image.shape[1]
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return Quality(
        blur_px=_blur_width(grey),
        dark=cv2.countNonZero(cv2.inRange(image, (0,) * 3, (BLACK,) * 3)) / pixels,
        bright=cv2.countNonZero(cv2.inRange(image, (WHITE,) * 3, (255,) * 3)) / pixels,
        contrast=float(_shrink(grey, THUMBNAIL_SIDE).std()),
    )


def blur_width(image: Image) -> float | None:
    """Width of the strongest edges in pixels, at a longer side of 640, in the direction where they are widest.

    The image is blurred again by a box along each of four directions, and the loss of gradient is compared with the
    gradient (after Crete et al., "The blur effect", 2007): an edge `w` wide keeps w / BOX of its slope, whatever its
    contrast is. Motion blur widens edges in one direction only, hence the maximum. None: no edge to measure.
    """
    return _blur_width(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def _blur_width(grey: Plane) -> float | None:
    small = _shrink(grey, MEASURED_SIDE)
    if min(small.shape) < 2:
        return None
    widths = [_edge_width(small, step) for step in ((0, 1), (1, 1), (1, 0), (1, -1))]
    return max((width for width in widths if width is not None), default=None)


def _edge_width(grey: Plane, step: tuple[int, int]) -> float | None:
    """Pixels along `step` (rows, columns). Whole numbers of 16 bits hold all of it, in a third of floats' time."""
    slope = _slope(grey, step)
    up_to = np.cumsum(cv2.calcHist([slope], [0], None, [256], [0, 256]))  # pixels whose slope is at most 0, 1, ...
    weakest = max(int(np.searchsorted(up_to, WEAK_SHARE * slope.size)), MIN_GRADIENT)
    strong = (slope >= weakest).view(np.uint8)
    if cv2.countNonZero(strong) < MIN_EDGE_SHARE * slope.size:
        return None
    before = np.multiply(slope, BOX, dtype=np.uint16)
    lost = cv2.subtract(before, _slope(_box_sum(grey, step), step))  # 0 where a slope grows
    return BOX * (1 - cv2.mean(lost, strong)[0] / cv2.mean(before, strong)[0])


def _box_sum(grey: Plane, step: tuple[int, int]) -> Plane:
    """Sum of the BOX pixels along `step` around each: five sums of three."""
    down, aside = BOX // 2 * abs(step[0]), BOX // 2 * abs(step[1])
    padded = cv2.copyMakeBorder(grey, down, down, aside, aside, cv2.BORDER_REFLECT_101)
    return _sums(_sums(padded, step, 3, 1), step, BOX // 3, 3)


def _sums(values: Plane, step: tuple[int, int], count: int, apart: int) -> Plane:
    """Sums of `count` values, each `apart` times `step` (rows, columns) from the last, where all are there."""
    reach = (count - 1) * apart
    left = max(-step[1], 0) * reach
    rows, columns = values.shape[0] - step[0] * reach, values.shape[1] - abs(step[1]) * reach
    total = np.zeros((rows, columns), np.uint16)
    for along in range(0, reach + 1, apart):
        top, start = along * step[0], left + along * step[1]
        total += values[top : top + rows, start : start + columns]
    return total


def _slope(values: Plane, step: tuple[int, int]) -> Plane:
    """Absolute difference between each value and the next one along `step` (rows, columns)."""
    down, right, left = step[0], max(step[1], 0), max(-step[1], 0)
    rows, columns = values.shape
    return cv2.absdiff(values[down:, right : columns - left], values[: rows - down, left : columns - right])


def novelty(image: Image, other: Image) -> float:
    """How much of `image` is not `other`: the RMS difference of thumbnails of unit contrast, about 0 to 1.5.

    Measured: 0 for a copy, up to 0.025 for one with sensor noise, 0.1 to 0.2 after a pixel of motion at 640 pixels,
    above 0.25 between neighbours of a capture. Saturated pixels, which a change of exposure alters, do not count.
    """
    if image.shape != other.shape:
        return float("inf")
    a, b = _grey(image, THUMBNAIL_SIDE), _grey(other, THUMBNAIL_SIDE)
    valid = (np.minimum(a, b) > MIN_UNSATURATED) & (np.maximum(a, b) < MAX_UNSATURATED)
    if valid.mean() < MIN_COMPARED_SHARE:
        valid[:] = True
    a, b = a[valid], b[valid]
    difference = (a - a.mean()) / (a.std() + 1) - (b - b.mean()) / (b.std() + 1)
    return float(np.sqrt(np.mean(difference**2)))


def why_unusable(quality: Quality, limits: Limits, sharpest_px: float | None = None) -> str | None:
    """Why a frame should be left out; None where it is usable. `sharpest_px`: the least blur of its stream so far."""
    exposed = 1 - quality.dark - quality.bright
    if exposed < limits.min_exposed_share:
        what, share = ("under", quality.dark) if quality.dark > quality.bright else ("over", quality.bright)
        return f"{what}exposed: {share:.0%} of its pixels show nothing"
    if quality.contrast < limits.contrast:
        return f"blank: its contrast is {quality.contrast:.1f} grey levels, at least {limits.contrast} are needed"
    if quality.blur_px is None:
        return "blank or out of focus: it has no edges"
    if quality.blur_px > limits.max_blur_px:
        return f"blurred: its edges are {quality.blur_px:.1f} px wide, at most {limits.max_blur_px} are allowed"
    if sharpest_px is not None and quality.blur_px > limits.relative_blur * max(sharpest_px, 1):
        return f"blurred: its edges are {quality.blur_px:.1f} px wide, those of the sharpest {sharpest_px:.1f}"
    return None


def why_too_small(size: tuple[int, int], largest: int) -> str | None:
    """Why an image of this (width, height) is left out beside one whose longer side is `largest`; None: it is used.

    SIFT finds a few dozen features in so few pixels, whose pixel is as wide as a step between two photographs.
    """
    longer = max(size)
    if longer >= THUMBNAIL_PX or longer * THUMBNAIL_RATIO > largest:
        return None
    shown = f"{size[0]} x {size[1]} pixels, beside others of up to {largest}"
    return f"too small, as thumbnails are: {shown}; give it in full size"


def why_redundant(measured: float, limits: Limits) -> str | None:
    """Why a frame of this `measured` novelty adds nothing to the frame it was compared with; None for a new view."""
    if measured < limits.min_novelty:
        return (
            f"duplicate: it differs from an earlier one by {measured:.3f}, a new view by at least {limits.min_novelty}"
        )
    return None


def _grey(image: Image, longer_side: int) -> npt.NDArray[np.float32]:
    """(h, w) grey levels, area-resampled to at most `longer_side`."""
    return _shrink(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), longer_side).astype(np.float32)


def _shrink(grey: Plane, longer_side: int) -> Plane:
    """Area-resampled to at most `longer_side`."""
    scale = min(1.0, longer_side / max(grey.shape))
    size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
