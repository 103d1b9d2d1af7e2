"""Masks and right images in messages: what is none is refused."""

from __future__ import annotations

import numpy as np
import pytest
import zmq

from splatnode.capture.frame import Baseline, Frame, RightImage
from splatnode.capture.messaging.messages import (
    FrameHeader,
    Key,
    Limits,
    Numbering,
    arrays_of,
    decode,
    decode_frame,
    encode_frame,
    frame_in,
)

IMAGE = np.zeros((5, 11, 3), np.uint8)
MASK = np.random.default_rng(0).random((5, 11)) < 0.5
RIGHT = RightImage(np.arange(55, dtype=np.uint8).reshape(5, 11), Baseline(0.075, 0.001))


def header(right=None) -> FrameHeader:
    """Of a frame with or without a right image."""
    message = encode_frame(Frame(0, "a", 0, IMAGE, None, right=right), Numbering())
    return decode(message, FrameHeader).header


@pytest.mark.parametrize("right", [None, RIGHT])
@pytest.mark.parametrize("mask", [None, MASK])
def test_a_frame_arrives_with_its_mask_and_its_right_image(mask, right):
    numbering = Numbering()
    parts = encode_frame(Frame(3, "a.png", 0, IMAGE, None, mask=mask, right=right), numbering)
    found = decode_frame(Key(numbering.session, 0), [zmq.Frame(bytes(part)) for part in parts], Limits()).frame
    assert isinstance(found, Frame)
    assert found.mask is None if mask is None else np.array_equal(found.mask, mask)
    if right is None:
        assert found.right is None
    else:
        assert found.right is not None and found.right.baseline == right.baseline
        assert np.array_equal(found.right.image, right.image)


def test_a_bit_a_pixel():
    _, bits = arrays_of(Frame(0, "a", 0, IMAGE, None, mask=MASK))
    assert bits.shape == (5, 2) and (bits[2, 0] >> 7) == MASK[2, 0]


@pytest.mark.parametrize(
    "arrays", [[], [IMAGE] * 3, [IMAGE, np.zeros((5, 3), np.uint8)], [IMAGE, np.zeros((5, 2), np.int16)]]
)
def test_what_is_no_mask_is_refused(arrays):
    with pytest.raises(ValueError, match=r"a frame has one image and at most one mask|must be \(5, 2\) uint8"):
        frame_in(header(), 0, arrays)


@pytest.mark.parametrize(
    ("arrays", "why"), [([IMAGE], "with a baseline one right image"), ([IMAGE, IMAGE], r"\(H, W\)")]
)
def test_what_is_no_right_image_is_refused(arrays, why):
    with pytest.raises(ValueError, match=why):
        frame_in(header(RIGHT), 0, arrays)


def test_a_right_image_is_of_the_frames_size():
    with pytest.raises(ValueError, match=r"the right image must be \(5, 11\), got \(11, 5\)"):
        Frame(0, "a", 0, IMAGE, None, right=RightImage(RIGHT.image.T.copy(), RIGHT.baseline))


@pytest.mark.parametrize(("metres", "sigma"), [(0.0, 0.0), (-1.0, 0.0), (float("nan"), 0.0), (0.1, 0.05), (1e3, 0.0)])
def test_what_is_no_baseline_is_refused(metres, sigma):
    with pytest.raises(ValueError, match="baseline must be"):
        Baseline(metres, sigma)
