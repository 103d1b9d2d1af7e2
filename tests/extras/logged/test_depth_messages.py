"""Depth in messages: raw, and packed by ROS' compressedDepth; and what is none."""

from __future__ import annotations

import struct
import tracemalloc

import cv2
import numpy as np
import pytest

from splatnode.extras.logged.messages import (
    Layout,
    Picture,
    UnusableMessage,
    decode_depth,
    is_colour_image,
    is_depth_image,
    parse_compressed_image,
    parse_raw_image,
)
from tests.support.mcap_files import START_NS, pack_depth, ros_file, ros_image

MILLIMETRES = np.array([[0, 1, 256, 65_535], [1000, 1001, 1002, 1003]], np.uint16)
METRES = np.array([[0.0, np.nan, 0.5, np.inf], [1.0, 1.25, 2.0, 9.0]], np.float32)


def file(data: bytes, told: str = "16UC1; compressedDepth png") -> Picture:
    return Picture("depth", START_NS, data, None, told)


@pytest.mark.parametrize("values", [MILLIMETRES, METRES], ids=["16UC1", "32FC1"])
@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("gap", [0, 5])
def test_raw_depth_is_what_was_written(values, big_endian, gap):
    encoding = {"uint16": "16UC1", "float32": "32FC1"}[values.dtype.name]
    *_, message = ros_image("/depth", values, encoding, "depth", START_NS, big_endian)
    picture = parse_raw_image(message)
    assert picture.layout is not None and picture.layout.is_big_endian is big_endian
    rows = np.frombuffer(picture.data, np.uint8).reshape(2, -1)
    layout = Layout(4, 2, encoding, picture.layout.step + gap, big_endian)
    picture = Picture("depth", START_NS, np.pad(rows, ((0, 0), (0, gap)), constant_values=7).tobytes(), layout)
    decoded = decode_depth(picture)
    assert decoded.dtype == values.dtype and np.array_equal(decoded, values, equal_nan=values.dtype.kind == "f")
    assert is_depth_image(picture) and not is_colour_image(picture)


@pytest.mark.parametrize("told", ["16UC1; compressedDepth png", "16UC1; compressedDepth", "16UC1;compressedDepth"])
def test_a_packed_file_of_millimetres(told):
    *_, message = ros_file("/depth/compressedDepth", pack_depth(MILLIMETRES), told, "depth", START_NS)
    picture = parse_compressed_image(message)
    assert (decode_depth(picture) == MILLIMETRES).all()
    assert is_depth_image(picture) and not is_colour_image(picture)


def test_a_file_of_depth_without_a_head_is_read_too():
    png = cv2.imencode(".png", MILLIMETRES)[1].tobytes()
    assert (decode_depth(file(png, "16UC1; png compressed ")) == MILLIMETRES).all()


def test_a_packed_file_of_metres_is_a_over_v_minus_b():
    a = 100.0 * 101.0
    b = 1.0 - a / 10.0
    values = np.array([[0, round(a / 2.5 + b)], [round(a / 9.5 + b), round(a / 1.0 + b)]], np.uint16)
    decoded = decode_depth(file(pack_depth(values, a, b), "32FC1; compressedDepth png"))
    assert decoded.dtype == np.float32
    np.testing.assert_allclose(decoded, [[0.0, 2.5], [9.5, 1.0]], rtol=2e-3)


@pytest.mark.parametrize(
    ("picture", "reason"),
    [
        (file(pack_depth(MILLIMETRES), "16UC1; compressedDepth rvl"), "packed by RVL is not read; log the raw topic"),
        (file(b"12345678901"), "must have 12 bytes before its PNG, it has 11 in all"),
        (file(bytes(12)), "must be a PNG, it begins with nothing"),
        (file(bytes(12) + cv2.imencode(".tiff", MILLIMETRES)[1].tobytes()), "must be a PNG, it begins with 49492a00"),
        (file(pack_depth(MILLIMETRES)[:-20]), "truncated|damaged"),
        (file(pack_depth(MILLIMETRES.astype(np.uint8))), "must be .H, W. of 16 bits, it is .2, 4. uint8"),
        (file(pack_depth(np.dstack([MILLIMETRES] * 3))), "must be .H, W. of 16 bits, it is .2, 4, 3. uint16"),
        (file(pack_depth(MILLIMETRES), "32FC1; compressedDepth png"), "must tell how depth was packed, it has a = 0"),
        (file(pack_depth(MILLIMETRES, float("nan")), "32FC1; compressedDepth png"), "it has a = nan"),
        (file(cv2.imencode(".png", MILLIMETRES)[1].tobytes(), "32FC1; png"), "a file of 32FC1 must be compressedDepth"),
        (file(b"", "mono16"), "an encoding of 16UC1 or 32FC1, it has mono16"),
        (Picture("", 0, bytes(16), Layout(4, 2, "mono16", 8)), "an encoding of 16UC1 or 32FC1, it has mono16"),
        (Picture("", 0, bytes(15), Layout(4, 2, "16UC1", 8)), "must have rows of 8 bytes or more"),
        (Picture("", 0, bytes(32), Layout(4, 2, "32FC1", 8)), "must have rows of 16 bytes or more"),
        (Picture("", 0, b"", Layout(2**16, 2**16, "16UC1", 2**17)), "must have 1 to 33554432 pixels"),
    ],
)
def test_what_is_no_depth_image_says_why(picture, reason):
    with pytest.raises(UnusableMessage, match=reason):
        decode_depth(picture)


def test_a_file_that_says_that_it_is_large_takes_no_memory():
    png = bytearray(pack_depth(MILLIMETRES))
    png[12 + 16 : 12 + 24] = struct.pack(">II", 60_000, 60_000)
    tracemalloc.start()
    with pytest.raises(UnusableMessage, match="60000 x 60000|damaged"):
        decode_depth(file(bytes(png)))
    most_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most_bytes < 1 << 20
