"""Pictures that a program has, treated as the same pictures in files are."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest

from splatnode.api.photographs import SeveralCameras, load_frames, make_frame, make_rgb_image
from splatnode.capture.frame import Clock, ExposureSettings, Frame, Stamp
from splatnode.capture.image_file import decode_image, encode_png
from splatnode.capture.process.terminal import ignore_progress

PICTURE = np.random.default_rng(0).integers(0, 256, (24, 32, 4)).astype(np.uint8)
DEEP = np.random.default_rng(1).integers(0, 65536, (24, 32)).astype(np.uint16)


def in_a_file(array: np.ndarray) -> np.ndarray:
    """As a PNG is decoded; `array` has its channels as OpenCV has them."""
    return decode_image(cv2.imencode(".png", array)[1].tobytes()).image


@pytest.mark.parametrize(
    ("array", "as_file"),
    [
        (PICTURE[..., :3], PICTURE[..., 2::-1]),
        (PICTURE, PICTURE[..., [2, 1, 0, 3]]),
        (PICTURE[..., 0], PICTURE[..., 0]),
        (PICTURE[..., :1], PICTURE[..., 0]),
        (DEEP, DEEP),
        (np.asfortranarray(PICTURE[::-1, ::-1, :3]), PICTURE[::-1, ::-1, 2::-1]),
    ],
    ids=["rgb", "alpha", "grey", "one channel", "16 bits", "not contiguous"],
)
def test_an_array_is_taken_as_a_file(array, as_file):
    found = make_rgb_image(array)
    assert np.array_equal(found, in_a_file(np.ascontiguousarray(as_file)))
    assert found.flags.c_contiguous and not np.shares_memory(found, array)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "1", "P"])
def test_a_pil_image_is_taken_as_its_file(mode):
    image = pytest.importorskip("PIL.Image")
    picture, file = image.fromarray(PICTURE[..., :3]).convert(mode), io.BytesIO()
    if mode == "RGBA":
        picture.putalpha(77)
    picture.save(file, "png")
    assert np.array_equal(make_rgb_image(picture), decode_image(file.getvalue()).image)


def test_what_alpha_hides_is_no_part_of_a_picture():
    array = PICTURE.copy()
    array[..., 3] = 255
    array[:8, :8, 3] = 0
    made = make_frame(array, 0, "0.png", 0)
    assert made.mask is not None and not made.mask[:8, :8].any() and made.mask.sum() == 24 * 32 - 64
    image = pytest.importorskip("PIL.Image")
    assert np.array_equal(make_frame(image.fromarray(array), 0, "0.png", 0).mask, made.mask)
    nothing = np.dstack([PICTURE[..., :3], np.eye(24, 32, dtype=np.uint8)])
    with pytest.raises(ValueError, match="alpha channel hides 96.9 % of it"):
        make_frame(nothing, 0, "0.png", 0)


def test_pictures_of_twelve_used_bits_are_stretched_alike_and_that_is_told():
    told = []
    dark, bright = DEEP >> 5, DEEP >> 4
    made = [each for each in load_frames([dark, bright], None, True, told.append).frames if isinstance(each, Frame)]
    assert np.abs(made[1].image[..., 0].astype(int) - (bright >> 4)).max() <= 1
    assert np.abs(made[0].image[..., 0].astype(int) - (dark >> 4)).max() <= 1
    assert any("12 of 16 bits" in str(line) for line in told)


def test_a_deep_pil_image_keeps_its_upper_bits():
    image = pytest.importorskip("PIL.Image")
    assert np.array_equal(make_rgb_image(image.fromarray(DEEP)), in_a_file(DEEP))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_pil_image_is_upright_and_tells_its_lens_time_and_exposure(orientation):
    image, rational = pytest.importorskip("PIL.Image"), pytest.importorskip("PIL.TiffImagePlugin")
    smooth = cv2.resize(PICTURE[:3, :4, :3], (320, 240), interpolation=cv2.INTER_CUBIC)
    written, file = image.fromarray(smooth), io.BytesIO()
    exif = written.getexif()
    exif[0x0112] = orientation
    exposed = {0x829A: rational.IFDRational(1, 125), 0x8827: 400}
    exif.get_ifd(0x8769).update({0x9003: "2024:05:06 10:00:07", 0xA405: 28} | exposed)
    written.save(file, "jpeg", exif=exif, quality=95)
    made = make_frame(image.open(file), 0, "a.jpg", 0)
    expected = decode_image(file.getvalue())
    assert made.image.shape == expected.image.shape
    assert np.abs(made.image.astype(int) - expected.image).mean() < 1.0
    assert made.intrinsics == expected.intrinsics is not None
    assert made.captured_at == expected.captured_at is not None
    assert made.exposure == expected.exposure == ExposureSettings(0.008, 400.0)


def test_listed_pictures_of_several_cameras_are_frame_sets():
    pictures = [np.full((48, 64, 3), 40 * number, np.uint8) for number in range(4)]
    stamps = [Stamp(ns, Clock.UTC) for ns in (0, 10**9, 10**9 + 5 * 10**6, 3 * 10**6)]
    told = SeveralCameras(camera_ids=["left", "left", "right", "right"], captured_at=stamps)
    frames = load_frames(pictures, None, False, ignore_progress, told).frames
    assert [(frame.name, frame.camera_id) for frame in frames if isinstance(frame, Frame)] == [
        ("0000.png", "left"),
        ("0003.png", "right"),
        ("0001.png", "left"),
        ("0002.png", "right"),
    ]
    few = load_frames(pictures, 3, False, ignore_progress, told).frames  # whole sets, and at most so many images
    assert [frame.name for frame in few] == ["0000.png", "0003.png"]
    with pytest.raises(ValueError, match="camera_ids must be one for each of the 4 images, got 1"):
        load_frames(pictures, None, False, ignore_progress, SeveralCameras(camera_ids=["left"]))
    with pytest.raises(TypeError, match="each of camera_ids must be a text, got int"):
        load_frames(pictures, None, False, ignore_progress, SeveralCameras(camera_ids=["a", "b", "c", 3]))  # pyright: ignore
    with pytest.raises(ValueError, match=r"camera_ids must be at most 255 printable letters, got 'a\\n'"):
        load_frames(pictures, None, False, ignore_progress, SeveralCameras(camera_ids=["a\n", "b", "c", None]))
    with pytest.raises(TypeError, match="give one of"):
        load_frames(pictures, None, False, ignore_progress, SeveralCameras("all", camera_ids=["a"] * 4))


def test_cameras_are_named_as_on_the_command_line(tmp_path):
    for camera in ("left", "right"):
        (tmp_path / camera).mkdir()
        (tmp_path / camera / "1.png").write_bytes(encode_png(np.zeros((48, 64, 3), np.uint8)))
    source = load_frames(tmp_path, None, False, ignore_progress, SeveralCameras("all"))
    assert [frame.name for frame in source.frames] == ["left/1.png", "right/1.png"]
    assert source.photographs == tmp_path
    both = load_frames(
        [tmp_path / "right", tmp_path / "left"], None, False, ignore_progress, SeveralCameras(["r", "l"])
    )
    found = [frame.camera_id for frame in both.frames if isinstance(frame, Frame)]
    assert found == ["l", "r"] and both.photographs is None
    assert sorted(both.files()) == ["images/l/1.png", "images/r/1.png"]
