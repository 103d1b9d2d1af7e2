"""What fits the schema to the last byte comes back as it was; everything else is refused."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from splatnode.capture.messaging.messages import MAGIC, Header, Limits, Numbering, WireError, decode, encode

EDGES = st.sampled_from([-1, 0, 1, 2, 4, 31, 2**16, 2**31, 2**32, 2**62, 2**63]) | st.integers(0, 8)


class Apple(Header, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="apple"):
    weight: float


class Pear(Header, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="pear"):
    name: str


HEADER = Pear(**Numbering().next(), name="birne")
PIXELS = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)


def parts_of(*arrays):
    return [bytes(part) for part in encode(HEADER, arrays)]


@pytest.mark.parametrize("dtype", ["u1", "u2", "u4", "i4", "i8", "f4", "f8", ">f4"])
@pytest.mark.parametrize("shape", [(), (0,), (0, 3), (5,), (2, 3), (2, 3, 4)])
def test_arrays_come_back(dtype, shape):
    array = np.random.default_rng(0).integers(0, 200, shape).astype(dtype)
    message = decode(parts_of(array, array), Apple | Pear)
    assert message.header == HEADER
    for received in message.arrays:
        assert received.shape == shape and np.array_equal(received, array)
        assert not received.flags.writeable and received.flags.aligned


def test_what_is_not_contiguous_is_sent_as_it_looks():
    (received,) = decode(parts_of(PIXELS[:, ::-1]), Pear).arrays
    assert np.array_equal(received, PIXELS[:, ::-1])


def test_contiguous_arrays_are_not_copied():
    assert np.shares_memory(np.frombuffer(encode(HEADER, [PIXELS])[2], np.uint8), PIXELS)


def test_an_array_that_begins_anywhere_is_aligned():
    array = np.arange(5, dtype=np.float64)
    shifted = memoryview(b"x" + array.tobytes())[1:]
    (received,) = decode([*parts_of(array)[:2], shifted], Pear).arrays
    assert received.flags.aligned and np.array_equal(received, array)


def test_zmq_frames_are_parts():
    assert decode([zmq.Frame(part) for part in parts_of(PIXELS)], Pear).header == HEADER


@pytest.mark.parametrize("array", [np.array(["text"]), np.array([None]), np.array([True]), np.zeros(2, np.complex64)])
def test_other_dtypes_are_not_sent(array):
    with pytest.raises(ValueError, match="cannot be sent"):
        encode(HEADER, [array])


def envelope(header, table):
    return msgspec.msgpack.encode([header, table])


RAW = msgspec.to_builtins(HEADER)
ENDLESS = ([0, 2**62, 4], [2**62, 0], [0, 2**31, 2**31], [0, 2**27, 1], [2**32, 2**32, 0], [0, 2**61, 2**61, 2**61])


@pytest.mark.parametrize(
    "parts",
    [
        [],
        [MAGIC],
        [b"SPLAT\x01", parts_of()[1]],
        [b"SPLAT\x02", parts_of()[1]],
        [b"SPLAT\x03", parts_of()[1]],
        [b"SPLAT\x04", parts_of()[1]],
        [b"SPLAT\x06", parts_of()[1]],
        [parts_of()[1], MAGIC],
        [MAGIC, b""],
        [MAGIC, parts_of()[1] + b"\0"],
        [MAGIC, parts_of()[1][:-1]],
        [*parts_of(), b"one too many"],
        parts_of(PIXELS)[:2],
        [*parts_of(PIXELS)[:2], PIXELS.tobytes()[:-1]],
        [*parts_of(PIXELS)[:2], PIXELS.tobytes() + b"\0"],
        [MAGIC, envelope({**RAW, "extra": 1}, [])],
        [MAGIC, envelope({**RAW, "type": "stone"}, [])],
        [MAGIC, envelope({**RAW, "name": 7}, [])],
        [MAGIC, envelope({**RAW, "sequence": -1}, [])],
        [MAGIC, envelope({**RAW, "sequence": 2**63}, [])],
        [MAGIC, envelope({**RAW, "session": "../../etc/passwd"}, [])],
        [MAGIC, envelope(RAW, [["O8", [1]]]), b"12345678"],
        [MAGIC, envelope(RAW, [["u1", [1, 1, 1, 1, 1]]]), b"1"],
        [MAGIC, envelope(RAW, [["u1", [-1, -1]]]), b"1"],
        [MAGIC, envelope(RAW, [["u1", [2**62, 4]]]), b""],
        *([MAGIC, envelope(RAW, [["f4", shape]]), b""] for shape in ENDLESS),
        [MAGIC, b"\xdd\xff\xff\xff\xff"],
        [MAGIC, b"\x91" * 100_000],
        [MAGIC, b"\x92\x82\xa4type\xa4pear\xa4name\xa1\xff\x90"],
    ],
)
def test_malformed_messages_are_refused(parts):
    with pytest.raises(WireError):
        decode(parts, Apple | Pear)


@pytest.mark.parametrize("name", ["a\nevent=keyframe name=forged", "\x1b[2J", "x" * 100_000])
def test_a_refusal_is_one_line_that_only_shows_whatever_a_stranger_names(name):
    head = msgspec.msgpack.encode([{**Numbering().next(), "type": "pear", "name": "birne", name: 0}, []])
    with pytest.raises(WireError) as refused:
        decode([MAGIC, head], Pear)
    text = str(refused.value)
    assert text.startswith("header refused: ") and text.isprintable() and len(text) < 1100


def test_another_version_is_told_what_to_do():
    with pytest.raises(WireError, match="of version 1, and this splatnode speaks version 5: update the older one"):
        decode([b"SPLAT\x01", parts_of()[1]], Pear)


class Anything(msgspec.Struct, forbid_unknown_fields=True):
    value: Any


NESTED: Any = 1
for _ in range(20):
    NESTED = [NESTED]


@pytest.mark.parametrize(
    "value",
    [
        float("nan"), float("inf"), -float("inf"), 2**63, 2**62 + 1, -(2**63), "\x1b[2J", "a\nb", "\u202e", "\u2028",
        "x" * 1001, b"bytes", [["", "\x07"]], {"a\n": 1}, {"a": {"b": "\r"}}, NESTED, list(range(10**4)),
        msgspec.msgpack.Ext(1, b""), msgspec.msgpack.Ext(-1, bytes(4)), {1.5: float("nan")},
    ],
)  # fmt: skip
def test_no_header_holds_what_a_terminal_or_a_sum_cannot_take(value):
    with pytest.raises(WireError):
        decode([MAGIC, msgspec.msgpack.encode([{"value": value}, []])], Anything)


@pytest.mark.parametrize("value", [None, True, 0, -(2**62), 2**62, 5e-324, -1e300, "", "ä 中", [], {"a": [1.5, None]}])
def test_a_header_holds_everything_else(value):
    assert decode([MAGIC, msgspec.msgpack.encode([{"value": value}, []])], Anything).header.value == value


@given(
    st.lists(st.tuples(st.sampled_from(["u1", "f4", "f8", "i8", "x"]), st.lists(EDGES, max_size=6)), max_size=3),
    st.lists(st.binary(max_size=32), max_size=3),
)
def test_whatever_shapes_are_announced_is_refused_or_there(table, buffers):
    try:
        message = decode([MAGIC, envelope(RAW, table), *buffers], Pear)
    except WireError:
        return
    for array, buffer, (_, shape) in zip(message.arrays, buffers, table, strict=True):
        assert list(array.shape) == shape and array.nbytes == len(buffer)


def test_limits():
    parts = parts_of(PIXELS, PIXELS)
    total = sum(map(len, parts))
    decode(parts, Pear, Limits(header_bytes=len(parts[1]), arrays=2, dimensions=3, total_bytes=total))
    for limits in (
        Limits(header_bytes=len(parts[1]) - 1),
        Limits(arrays=1),
        Limits(dimensions=2),
        Limits(total_bytes=total - 1),
    ):
        with pytest.raises(WireError):
            decode(parts, Pear, limits)


@given(st.lists(st.binary(max_size=64), max_size=4))
def test_chance_is_refused(parts):
    with pytest.raises(WireError):
        decode([MAGIC, *parts], Apple | Pear)


@given(st.integers(0, len(parts_of(PIXELS)[1]) - 1), st.integers(1, 255))
def test_a_changed_byte_is_refused_or_changes_a_value(position, change):
    parts = parts_of(PIXELS)
    head = bytearray(parts[1])
    head[position] ^= change
    try:
        message = decode([parts[0], bytes(head), parts[2]], Apple | Pear)
    except WireError:
        return
    assert message.arrays[0].nbytes == PIXELS.nbytes
    assert message.header != HEADER or message.arrays[0].shape != PIXELS.shape


def test_numbers_count_up_and_sessions_differ():
    numbering, other = Numbering(), Numbering()
    first, second = numbering.next(), numbering.next()
    assert (first["sequence"], second["sequence"]) == (0, 1)
    assert first["session"] == second["session"] != other.next()["session"]
    assert first["mono_ns"] <= second["mono_ns"]
