"""A map as a message: what is sent is what comes; what is none is refused with a sentence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import asdict
from msgspec.structs import replace as with_fields

from splatnode.capture.messaging.messages import Message, Numbering, WireError, decode, encode
from splatnode.recon.occupancy import MapHeader, decode_map, encode_map, no_map
from splatnode.recon.result.verdict import Scale
from tests.support.occupied import small_map

STATES = np.arange(24).reshape(2, 3, 4) % 3


def sent(states=STATES):
    metric = Scale(True, "a marker", (0.98, 1.02))
    header, arrays = encode_map(replace(small_map(states), scale=metric), "scene-0001", 7, Numbering().next())
    return decode(encode(header, arrays), MapHeader)


def test_a_map_comes_as_it_was_sent():
    message = sent()
    made, was = decode_map(message), small_map(STATES)
    assert made is not None and np.array_equal(made.states, was.states) and made.states.dtype == np.uint8
    assert made.voxel == was.voxel and np.array_equal(made.origin, was.origin)
    assert np.array_equal(made.T_world_map, was.T_world_map) and made.upright.source == "the floor"
    assert made.scale == Scale(True, "a marker", (0.98, 1.02)) and message.header.map.scene_sequence == 7
    assert made.at([was.origin + 0.1]).tolist() == [0]


def test_that_there_is_none_comes_with_the_reason():
    message = decode(encode(no_map("none", "the camera is lost", Numbering().next())), MapHeader)
    assert decode_map(message) is None and message.header.why == "the camera is lost"
    with pytest.raises(WireError, match="without a map has no array"):
        decode_map(Message(message.header, (np.zeros((1, 1, 1), np.uint8),)))


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ((), "one array, states"),
        ((np.zeros((2, 3), np.uint8),), "one array, states"),
        ((np.zeros((2, 3, 4), np.float32),), "one array, states"),
        ((np.zeros((0, 3, 4), np.uint8),), "one array, states"),
        ((np.full((2, 3, 4), 3, np.uint8),), "states must be 0 to 2, got 3"),
    ],
)
def test_what_is_no_map_is_refused(arrays, said):
    with pytest.raises(WireError, match=said):
        decode_map(Message(sent().header, arrays))


def test_a_frame_that_is_bent_is_refused():
    header = sent().header
    record = asdict(header.map) | {"T_world_map": (2.0, *header.map.T_world_map[1:])}
    with pytest.raises(WireError, match="T_world_map must be a rigid motion"):
        decode(encode(with_fields(header, map=record)), MapHeader)
