"""Images of 16 bits a channel: which of their values are used, and how these become 8 bits, alike for all of a set.

A sensor of 10, 12 or 14 bits fills the lower bits of 16, a thermal camera a narrow band of them. The upper 8 bits of
such images are nearly black, so the used range is stretched. It is one range for all images of a set: their brightness
stays comparable.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Deep = npt.NDArray[np.uint16]

FULL = 65_535
MAX_STRETCHED_BITS = 14  # with 15 or 16 used bits, the upper 8 serve
MAX_BAND = 1 << MAX_STRETCHED_BITS  # width of a band of values that is stretched
MIN_BAND_RATIO = 0.25  # darkest over brightest value, from which on the values lie in a band; else they begin at 0
BAND_MARGIN = 0.05  # of a band's width, on both sides
_OUTLIERS_PERCENT = 0.01  # of the values at both ends: dead and hot pixels
_MAX_SAMPLES = 1_000_000  # values of an image that are looked at


@dataclass(frozen=True)
class Extent:
    """The darkest and the brightest value of images, without outliers."""

    low: int
    high: int


@dataclass(frozen=True)
class ValueRange:
    """The values that become 0 and 255."""

    low: int
    high: int

    def __str__(self) -> str:
        if self.low == 0:
            return f"{self.high.bit_length()} of 16 bits"
        return f"the values {self.low} to {self.high} of 16 bits"


def measure_extent(values: Deep) -> Extent:
    """Measures the extent of the values of an image (H, W) or (H, W, C)."""
    step = max(1, round((values.size / _MAX_SAMPLES) ** 0.5))
    some = values[::step, ::step]
    low, high = np.percentile(some, [_OUTLIERS_PERCENT, 100 - _OUTLIERS_PERCENT], method="nearest")
    return Extent(int(low), int(high))


def find_range(extents: Iterable[Extent]) -> ValueRange | None:
    """Finds the range that images of these extents share; None without images, or where the upper 8 bits show it."""
    known = list(extents)
    if not known:
        return None
    low, high = min(extent.low for extent in known), max(extent.high for extent in known)
    if low >= MIN_BAND_RATIO * high and 0 < high - low < MAX_BAND:
        margin = round(BAND_MARGIN * (high - low)) + 1
        return ValueRange(max(0, low - margin), min(FULL, high + margin))
    bits = max(8, high.bit_length())
    return ValueRange(0, (1 << bits) - 1) if bits <= MAX_STRETCHED_BITS else None


def convert_to_eight_bits(values: Deep, used: ValueRange | None) -> npt.NDArray[np.uint8]:
    """The image with `used` stretched to 0 to 255; None: the upper 8 bits."""
    if used is None:
        return (values >> 8).astype(np.uint8)
    level = np.clip((np.arange(FULL + 1) - used.low) / (used.high - used.low), 0.0, 1.0)
    return np.floor(255.999 * level).astype(np.uint8)[values]
