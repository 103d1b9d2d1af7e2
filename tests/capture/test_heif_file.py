"""HEIC and AVIF: upright once, in 8 bits and in colour, within bounds; and what a damaged one may do, which is nothing.

The files in tests/support/photographs are of four fields, red, green, blue and yellow, 80 x 60 pixels before they are
turned, and were made with pillow-heif, which can encode HEIC as pi-heif cannot. ten_bits.heic is of noise, 120 x 90.
"""

from __future__ import annotations

import io
import multiprocessing
import resource
import struct

import numpy as np
import pytest

from splatnode.capture import image_file
from splatnode.capture.cameras import folder, watched
from splatnode.capture.frame import Clock, DroppedFrame, ExposureSettings, Frame, Stamp
from splatnode.capture.image_file import UnusableImage, check_whole, decode_any_image, decode_image
from splatnode.capture.pi_heif import BASE_BYTES, BYTES_A_PIXEL
from tests.conftest import ROOT
from tests.support.crafted.bounded import MARGIN

Image = pytest.importorskip("PIL.Image", reason="needs Pillow")
TiffImagePlugin = pytest.importorskip("PIL.TiffImagePlugin", reason="needs Pillow")
pytest.importorskip("pi_heif", reason="needs pi_heif")

PHOTOGRAPHS = ROOT / "tests" / "support" / "photographs"
TURNED = (PHOTOGRAPHS / "turned.heic").read_bytes()
RED, GREEN, BLUE, YELLOW = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0)
TAKEN = Stamp(1_714_989_607_000_000_000, Clock.LOCAL)


def corners(image: np.ndarray) -> list[np.ndarray]:
    """The colours of the four fields: above, then below, from the left."""
    return [image[row, column].astype(int) for row in (5, -5) for column in (5, -5)]


def as_avif(orientation: int, pixels: np.ndarray | None = None) -> bytes:
    exif = Image.Exif()
    exif[0x0112] = orientation
    part = exif.get_ifd(0x8769)
    part[0x9003], part[0xA405] = "2024:05:06 10:00:07", 28
    part[0x829A], part[0x8827] = TiffImagePlugin.IFDRational(1, 125), 400
    fields = np.zeros((60, 80, 3), np.uint8)
    fields[:30, :40], fields[:30, 40:], fields[30:, :40], fields[30:, 40:] = RED, GREEN, BLUE, YELLOW
    written = io.BytesIO()
    Image.fromarray(fields if pixels is None else pixels).save(written, "AVIF", exif=exif.tobytes(), quality=90)
    return written.getvalue()


@pytest.mark.parametrize("data", [TURNED, as_avif(6)], ids=["heic", "avif"])
def test_what_the_file_and_its_exif_both_turn_is_turned_once(data):
    image, intrinsics, captured_at, exposure, *_ = decode_any_image(data)
    assert exposure == (None if data is TURNED else ExposureSettings(0.008, 400.0))
    assert image.shape == (80, 60, 3) and image.dtype == np.uint8
    np.testing.assert_allclose(corners(image), [BLUE, RED, YELLOW, GREEN], atol=12)
    assert captured_at == TAKEN
    assert intrinsics is not None and intrinsics.fx == pytest.approx(28 * 100 / np.hypot(36, 24))
    assert (intrinsics.width, intrinsics.height) == (60, 80)


def test_what_is_not_turned_stays():
    np.testing.assert_allclose(corners(decode_any_image(as_avif(1)).image), [RED, GREEN, BLUE, YELLOW], atol=12)


def test_alpha_is_dropped_and_grey_becomes_colour_and_ten_bits_eight():
    alpha = decode_any_image((PHOTOGRAPHS / "alpha.heic").read_bytes()).image
    np.testing.assert_allclose(corners(alpha), [RED, GREEN, BLUE, YELLOW], atol=12)
    grey = decode_any_image((PHOTOGRAPHS / "grey.heic").read_bytes()).image
    assert grey.shape == (60, 80, 3) and np.array_equal(grey[..., 0], grey[..., 2])
    np.testing.assert_allclose(grey[5, 5], (76, 76, 76), atol=6)
    ten = decode_any_image((PHOTOGRAPHS / "ten_bits.heic").read_bytes()).image
    assert ten.shape == (90, 120, 3) and 60 < ten.mean() < 195 and ten.std() > 20


def test_a_folder_takes_them_beside_others(tmp_path):
    (tmp_path / "a.HEIC").write_bytes(TURNED)
    (tmp_path / "b.avif").write_bytes(as_avif(1))
    (tmp_path / "c.jpg").write_bytes(TURNED)  # as some programs name what they did not convert
    frames = [item for item in folder.stream(folder.Config(tmp_path)) if isinstance(item, Frame)]
    assert [frame.image.shape for frame in frames] == [(80, 60, 3), (60, 80, 3), (80, 60, 3)]


def test_without_the_package_the_message_names_it(tmp_path, monkeypatch):
    (tmp_path / "a.heic").write_bytes(TURNED)
    monkeypatch.setattr(image_file.importlib.util, "find_spec", lambda name: None)
    remedy = "Run: pip install 'splatnode[heic]', or convert it to JPEG"
    with pytest.raises(ValueError) as caught:
        folder.stream(folder.Config(tmp_path))
    assert str(caught.value).endswith(f"holds only .heic files. {remedy}")
    (tmp_path / "b.jpg").write_bytes(TURNED)
    first, second = folder.stream(folder.Config(tmp_path))
    assert first == DroppedFrame("a.heic", f".heic files cannot be read. {remedy}")
    assert second == DroppedFrame("b.jpg", f"HEIC and AVIF need a further package. {remedy}")


def test_a_watched_folder_waits_until_one_is_whole(tmp_path):
    (tmp_path / "a.heic").write_bytes(TURNED[:-100])
    frames = watched.stream(watched.Config(tmp_path, poll_s=0.01, stable_s=0.0, file_timeout_s=0.2))
    given_up = next(frames)
    assert isinstance(given_up, DroppedFrame) and "truncated" in given_up.reason
    (tmp_path / "b.heic").write_bytes(TURNED)
    taken = next(frames)
    assert isinstance(taken, Frame) and taken.captured_at == TAKEN


def test_the_bound_holds_before_anything_is_decoded():
    assert decode_any_image(TURNED, 80 * 60).image.shape == (80, 60, 3)
    with pytest.raises(UnusableImage, match=r"80: more than 4799 pixels; make it smaller"):
        decode_any_image(TURNED, 80 * 60 - 1)


def stating(data: bytes, width: int, height: int) -> bytes:
    """The file with another size in each box that states one."""
    where, changed = data.find(b"ispe"), bytearray(data)
    while where >= 0:
        changed[where + 8 : where + 16] = struct.pack(">II", width, height)
        where = data.find(b"ispe", where + 1)
    return bytes(changed)


@pytest.mark.parametrize("data", [TURNED, as_avif(1)], ids=["heic", "avif"])
def test_whatever_a_file_states_it_is_refused_or_within_its_bounds(data):
    bounds = 1_000_000
    crafted = [stating(data, *size) for size in ((60_000, 60_000), (0, 0), (2**31, 2), (900, 900), (8, 8))]
    crafted += [data[: len(data) * part // 8] for part in range(1, 8)]
    rng = np.random.default_rng(5)
    for _ in range(8):
        changed = bytearray(data)
        for place in rng.integers(12, len(data), 6):
            changed[place] = rng.integers(256)
        crafted.append(bytes(changed))
    with multiprocessing.get_context("spawn").Pool(1) as fresh:  # whose children are the decoders alone
        refused, taken = fresh.apply(decoded, (crafted, bounds))
    assert refused >= 9
    assert taken < BASE_BYTES + BYTES_A_PIXEL * bounds + MARGIN


def decoded(files: list[bytes], bounds: int) -> tuple[int, int]:
    """How many of the files are refused, and the most memory that a decoder took, bytes."""
    refused = 0
    for file in files:
        try:
            image = decode_any_image(file, bounds).image
        except UnusableImage:
            refused += 1
        else:
            assert image.ndim == 3 and image.shape[0] * image.shape[1] <= bounds
    return refused, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024


def test_what_another_process_sends_reaches_no_such_decoder(monkeypatch):
    monkeypatch.setattr(image_file, "decode_heif", lambda *_: pytest.fail("decoded"))
    with pytest.raises(UnusableImage, match="not an image"):
        decode_image(TURNED)


@pytest.mark.parametrize("cut", [1, 20, 300, len(TURNED) - 1])
def test_a_file_that_ends_early_is_told_without_a_decoder(cut):
    check_whole(TURNED)
    with pytest.raises(UnusableImage, match=r"truncated|not an image"):
        check_whole(TURNED[:cut])
