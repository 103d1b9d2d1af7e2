"""Keyframes: the size at which images are modelled."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatnode.capture.frame import Frame
from splatnode.recon.keyframes import Features, Keyframe, compute_model_size, resize_image

NO_FEATURES = Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8), np.zeros(0, np.int64), np.zeros(0))


@pytest.mark.parametrize(
    ("size", "longer_side", "expected"),
    [
        ((1024, 768), 512, (512, 384)),
        ((768, 1024), 512, (384, 512)),
        ((640, 480), 512, (512, 384)),
        ((320, 240), 512, (320, 240)),
        ((512, 300), 512, (512, 300)),
        ((1000, 1), 10, (10, 1)),
    ],
)
def test_modelled_size(size, longer_side, expected):
    assert compute_model_size(*size, longer_side) == expected


@given(st.integers(1, 5000), st.integers(1, 5000), st.integers(16, 1024))
def test_sizes_are_never_enlarged_and_keep_their_proportions(width, height, longer_side):
    w, h = compute_model_size(width, height, longer_side)
    assert 1 <= w <= width and 1 <= h <= height and max(w, h) == min(longer_side, max(width, height))
    assert abs(w * height - h * width) <= 0.51 * max(width, height) or min(w, h) == 1


def test_pixels_are_averaged_over_the_area_that_they_replace():
    image = np.zeros((2, 4, 3), np.uint8)
    image[:, :2] = [[[0, 0, 0], [40, 80, 120]], [[80, 120, 160], [120, 200, 0]]]
    small = resize_image(image, 2)
    assert small.shape == (1, 2, 3) and small.dtype == np.uint8
    assert small[0].tolist() == [[60, 100, 70], [0, 0, 0]]


def test_a_small_image_is_modelled_as_it_is():
    image = np.zeros((24, 32, 3), np.uint8)
    assert resize_image(image, 32) is image


def test_a_keyframe_knows_its_name_and_scale():
    frame = Frame(0, "a.png", 0, np.zeros((480, 641, 3), np.uint8), None)
    keyframe = Keyframe(frame, resize_image(frame.image, 320), NO_FEATURES)
    assert keyframe.name == "a.png"
    assert keyframe.scale == (320 / 641, 240 / 480)
