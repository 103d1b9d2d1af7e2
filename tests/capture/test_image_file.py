"""What an image file may make the decoder do: no more than its measured size, whatever its parts say."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatnode.capture.image_file import BYTES_A_PIXEL, UnusableImage, decode_image, read_header, read_image_file
from splatnode.capture.image_header import MAX_SIDE
from tests.conftest import ROOT
from tests.support.crafted import Crafted
from tests.support.crafted.bounded import MARGIN, readings
from tests.support.crafted.images import png

LIMIT = 1_000_000  # pixels
ENCODINGS = (".jpg", ".png", ".webp", ".tif", ".bmp", ".ppm")


def read(file: Crafted) -> str:
    """For the process that reads the corpus."""
    return str(decode_image(file.data, LIMIT)[0].shape)


def test_every_crafted_image_is_refused_or_within_the_limit_and_so_is_the_memory():
    for reading in readings("tests.support.crafted:images", f"{__name__}:read"):
        assert reading.outcome.startswith(("UnusableImage: ", "(")), reading
        assert reading.taken <= BYTES_A_PIXEL * LIMIT + reading.size + MARGIN, reading


def test_of_what_opencv_prints_nothing_is_a_strangers_text():
    """In a process as a verb's is: libjpeg and libpng have sentences of their own, and all else is silent."""
    code = f"import splatnode.command_line; from {__name__} import _decode_all; _decode_all()"
    environment = {name: value for name, value in os.environ.items() if name != "OPENCV_LOG_LEVEL"}
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, timeout=300)
    assert run.returncode == 0, run.stderr[-1000:]
    said = {line for line in run.stderr.splitlines() if not line.startswith((b"libpng ", b"Corrupt JPEG data: "))}
    known = {b"", b"Premature end of JPEG file", b"Invalid SOS parameters for sequential JPEG"}
    assert {line for line in said - known if not line.startswith(b"Unsupported marker type")} == set()
    assert run.stderr.replace(b"\n", b"").decode("ascii").isprintable()


def _decode_all() -> None:
    """For the process whose lines are looked at: files with damage in them, and the escapes of a terminal."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (32, 32, 3)).astype(np.uint8)
    for suffix in ENCODINGS:
        whole = cv2.imencode(suffix, image)[1].tobytes()
        for number in range(30):
            damaged = bytearray(whole if number % 3 else whole[: len(whole) // 2])
            for place in rng.integers(2, len(damaged), 4):
                damaged[place : place + 4] = b"\x1b[2J"
            cv2.imdecode(np.frombuffer(bytes(damaged), np.uint8), cv2.IMREAD_COLOR)


@pytest.mark.parametrize("suffix", ENCODINGS)
@given(data=st.data())
def test_a_decoder_never_finds_another_size_than_the_one_that_was_measured(suffix, data):
    image = bytearray(cv2.imencode(suffix, np.zeros((6, 7, 3), np.uint8))[1].tobytes())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(image) - 1))
        image[place] = data.draw(st.sampled_from([0, 1, 2, 7, 127, 128, 255]) | st.integers(0, 255))
    try:
        header = read_header(bytes(image))
    except UnusableImage:
        return
    if header.width * header.height > LIMIT:
        return
    decoded = cv2.imdecode(np.frombuffer(header.decodable, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    assert decoded is None or decoded.shape[1::-1] == (header.width, header.height)


@pytest.mark.parametrize("suffix", ENCODINGS)
def test_the_pixels_are_those_that_opencv_decodes_from_the_file(suffix):
    image = np.random.default_rng(3).integers(0, 255, (30, 40, 3), np.uint8)
    data = cv2.imencode(suffix, image)[1].tobytes()
    np.testing.assert_array_equal(decode_image(data)[0], cv2.imdecode(np.frombuffer(data, np.uint8), 1)[..., ::-1])


def test_what_a_png_says_beside_its_pixels_changes_none_of_them():
    header = (b"IHDR", struct.pack(">IIBBBBB", 4, 4, 16, 6, 0, 0, 0))
    pixels = (b"IDAT", zlib.compress(b"".join(b"\0" + bytes(range(32)) for _ in range(4))))
    remarks = [
        (b"gAMA", struct.pack(">I", 20_000)),
        (b"sRGB", b"\0"),
        (b"sBIT", b"\5\5\5\5"),
        (b"bKGD", bytes(6)),
        (b"tEXt", b"Comment\0none"),
        (b"tIME", struct.pack(">HBBBBB", 2020, 1, 1, 1, 1, 1)),
    ]
    told, plain = png([header, *remarks, pixels, (b"IEND", b"")]), png([header, pixels, (b"IEND", b"")])
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(told, np.uint8), 1)[..., ::-1], decode_image(plain)[0])
    np.testing.assert_array_equal(decode_image(told)[0], decode_image(plain)[0])


def test_a_side_that_no_decoder_needs_is_refused_with_the_bound():
    with pytest.raises(UnusableImage, match=f"70000 x 1: each side must have 1 to {MAX_SIDE} pixels"):
        read_header(cv2.imencode(".png", np.zeros((1, 70_000, 3), np.uint8))[1].tobytes())


def test_a_file_that_is_too_large_for_its_pixels_is_not_read(tmp_path):
    path = tmp_path / "photo.jpg"
    with path.open("wb") as file:
        file.truncate(50_000_000_000)  # sparse: it takes no disk
    with pytest.raises(UnusableImage, match="the file has 50000000000 bytes; at most 864000000 are read"):
        read_image_file(path)


def test_a_pipe_and_a_device_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "pipe.jpg")
    (tmp_path / "zero.jpg").symlink_to("/dev/zero")
    (tmp_path / "folder.jpg").mkdir()
    for path in tmp_path.iterdir():
        with pytest.raises(UnusableImage, match="must be a file, is a"):
            read_image_file(path)
