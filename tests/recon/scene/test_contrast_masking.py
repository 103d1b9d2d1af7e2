"""How visible a difference is, on a plain surface and beside contrast."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.scene.initialization import MASKING_STD, visibility


def stripes(contrast: float) -> np.ndarray:
    """64 x 64 pixels of stripes one pixel wide, of this standard deviation around a half."""
    signs = np.tile([1.0, -1.0], 32)[None, :, None]
    return np.broadcast_to(0.5 + contrast * signs, (64, 64, 3)).astype(np.float32)


def test_on_a_plain_surface_a_difference_counts_in_full():
    assert visibility(stripes(0.0), 1.0) == pytest.approx(1.0)


def test_contrast_masks_a_difference_as_in_ssim():
    assert visibility(stripes(MASKING_STD), 1.0) == pytest.approx(2**-0.5, rel=0.01)
    assert visibility(stripes(10 * MASKING_STD), 1.0) == pytest.approx(101**-0.5, rel=0.01)


def test_what_masks_reaches_as_far_in_every_size_of_an_image():
    half = np.full((64, 64, 3), 0.5, np.float32)
    half[:, 32:] = stripes(0.3)[:, 32:]
    masked = visibility(half, 1.0)[32] < 0.9
    assert 32 - 8 < np.argmax(masked) < 32
    double = np.repeat(np.repeat(half, 2, 0), 2, 1)
    assert abs(np.argmax(visibility(double, 2.0)[64] < 0.9) - 2 * np.argmax(masked)) <= 2
