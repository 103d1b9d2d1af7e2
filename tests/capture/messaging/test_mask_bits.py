"""Masks in messages: a bit a pixel, and what is none is refused."""

from __future__ import annotations

import numpy as np
import pytest
import zmq

from splatnode.capture.frame import Frame
from splatnode.capture.messaging.keyframe_messages import received, to_message
from splatnode.capture.messaging.mask_bits import arrays_of, mask_in
from splatnode.capture.messaging.spool import Key
from splatnode.capture.messaging.wire import Limits, Numbering

IMAGE = np.zeros((5, 11, 3), np.uint8)
MASK = np.random.default_rng(0).random((5, 11)) < 0.5


@pytest.mark.parametrize("mask", [None, MASK])
def test_a_frame_arrives_with_its_mask(mask):
    numbering = Numbering()
    parts = to_message(Frame(3, "a.png", 0, IMAGE, None, mask=mask), numbering)
    found = received(Key(numbering.session, 0), [zmq.Frame(bytes(part)) for part in parts], Limits())
    assert isinstance(found.frame, Frame)
    assert found.frame.mask is None if mask is None else np.array_equal(found.frame.mask, mask)


def test_a_bit_a_pixel():
    _, bits = arrays_of(Frame(0, "a", 0, IMAGE, None, mask=MASK))
    assert bits.shape == (5, 2) and (bits[2, 0] >> 7) == MASK[2, 0]


@pytest.mark.parametrize(
    "arrays", [[], [IMAGE] * 3, [IMAGE, np.zeros((5, 3), np.uint8)], [IMAGE, np.zeros((5, 2), np.int16)]]
)
def test_what_is_no_mask_is_refused(arrays):
    with pytest.raises(ValueError, match=r"a frame has one image and at most one mask|must be \(5, 2\) uint8"):
        mask_in(arrays)
