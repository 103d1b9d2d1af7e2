import io
import math
import os
import struct

import cv2
import numpy as np
import pytest

from splatnode.capture.cameras.folder import Config, stream
from splatnode.capture.frame import Clock, DroppedFrame, Frame, Intrinsics, Stamp
from splatnode.capture.image_file import UnusableImage, decode_image
from splatnode.capture.image_header import exif_intrinsics, read_header, read_tags

# Left half red, right half blue, the top left corner white: tells every orientation and channel order apart.
PICTURE = np.zeros((48, 64, 3), np.uint8)
PICTURE[:, :32], PICTURE[:, 32:], PICTURE[:16, :16] = (200, 20, 30), (20, 40, 210), (250, 250, 250)

ORIENTATION = 0x0112


def encoded(suffix=".jpg", image=PICTURE, *options):
    channels = {2: None, 3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}[image.shape[-1] if image.ndim == 3 else 2]
    ok, data = cv2.imencode(suffix, image if channels is None else cv2.cvtColor(image, channels), options)
    assert ok
    return data.tobytes()


def tiff(tags, exif_tags=None, order=">"):
    """A TIFF structure in one or two directories: tag -> int (SHORT), (numerator, denominator) (RATIONAL) or text."""
    directories = [dict(tags)] + ([exif_tags] if exif_tags else [])
    if exif_tags:
        directories[0][0x8769] = 8 + 2 + 12 * len(directories[0]) + 12 + 4
    entries, values = b"", b""
    end = 8 + sum(2 + 12 * len(directory) + 4 for directory in directories)
    for directory in directories:
        entries += struct.pack(order + "H", len(directory))
        for tag, value in sorted(directory.items()):
            if isinstance(value, tuple):
                entries += struct.pack(order + "HHII", tag, 5, 1, end + len(values))
                values += struct.pack(order + "II", *value)
            elif isinstance(value, str):
                text = value.encode() + b"\0"
                inside = text.ljust(4, b"\0") if len(text) <= 4 else struct.pack(order + "I", end + len(values))
                entries += struct.pack(order + "HHI", tag, 2, len(text)) + inside
                values += text if len(text) > 4 else b""
            elif tag == 0x8769:
                entries += struct.pack(order + "HHII", tag, 4, 1, value)
            else:
                entries += struct.pack(order + "HHIHH", tag, 3, 1, value, 0)
        entries += bytes(4)
    return (b"MM\0*" if order == ">" else b"II*\0") + struct.pack(order + "I", 8) + entries + values


def with_exif(jpeg, tags, exif_tags=None, order=">"):
    segment = b"Exif\0\0" + tiff(tags, exif_tags, order)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


def read_one(folder, name, data, **options):
    (folder / name).write_bytes(data)
    (result,) = stream(Config(folder, **options))
    assert result.name == name
    return result


def read_frame(folder, name, data):
    frame = read_one(folder, name, data)
    assert isinstance(frame, Frame)
    return frame


def frames_in(folder, **options):
    items = list(stream(Config(folder, **options)))
    frames = [item for item in items if isinstance(item, Frame)]
    assert len(frames) == len(items)
    return frames


def reasons_in(folder, **options):
    """Of what is left out, by name."""
    return {item.name: item.reason for item in stream(Config(folder, **options)) if isinstance(item, DroppedFrame)}


@pytest.mark.parametrize("suffix", [".jpg", ".JPEG", ".png", ".bmp", ".tif", ".webp"])
def test_every_format_gives_the_same_rgb(tmp_path, suffix):
    frame = read_frame(tmp_path, "a" + suffix, encoded(suffix.lower()))
    assert frame.intrinsics is None
    assert np.abs(frame.image[24:46:4, 4:28:4].astype(int) - [200, 20, 30]).max() < 12
    assert np.abs(frame.image[4:46:4, 40:60:4].astype(int) - [20, 40, 210]).max() < 12


def test_progressive_and_grey_jpeg(tmp_path):
    progressive = read_frame(tmp_path, "a.jpg", encoded(".jpg", PICTURE, cv2.IMWRITE_JPEG_PROGRESSIVE, 1))
    assert progressive.image.shape == (48, 64, 3)
    grey = read_frame(tmp_path, "a.jpg", encoded(".jpg", PICTURE[..., 0]))
    assert grey.image.shape == (48, 64, 3)
    assert np.array_equal(grey.image[..., 0], grey.image[..., 2])


def test_sixteen_bits_become_eight(tmp_path):
    deep = PICTURE.astype(np.uint16) * 257
    assert np.array_equal(read_frame(tmp_path, "a.png", encoded(".png", deep)).image, PICTURE)
    deep_grey = read_frame(tmp_path, "a.png", encoded(".png", deep[..., 0]))
    assert np.array_equal(deep_grey.image, np.repeat(PICTURE[..., :1], 3, 2))


def test_an_alpha_channel_that_hides_all_says_nothing(tmp_path):
    transparent = np.dstack([PICTURE, np.zeros_like(PICTURE[..., 0])])
    assert np.array_equal(read_frame(tmp_path, "a.png", encoded(".png", transparent)).image, PICTURE)


LOSSLESS = {".webp": (cv2.IMWRITE_WEBP_QUALITY, 101)}
SHAPE = np.ones(PICTURE.shape[:2], bool)
SHAPE[:20, 10:40] = False  # its middle is in no symmetry of the picture


def with_alpha(deep: bool = False, half: int = 255) -> np.ndarray:
    """The picture with an alpha of 0 in a corner and of `half` beside it."""
    alpha = np.where(SHAPE, 255, 0).astype(np.uint8)
    alpha[:20, 40:50] = half
    both = np.dstack([PICTURE, alpha])
    return both.astype(np.uint16) * 257 if deep else both


@pytest.mark.parametrize(
    ("suffix", "deep"), [(".png", False), (".png", True), (".tif", False), (".tif", True), (".webp", False)]
)
def test_what_alpha_hides_is_no_part_of_the_photograph(tmp_path, suffix, deep):
    frame = read_frame(tmp_path, "a" + suffix, encoded(suffix, with_alpha(deep), *LOSSLESS.get(suffix, ())))
    assert frame.mask is not None and np.array_equal(frame.mask, SHAPE)
    assert np.array_equal(frame.image[SHAPE], PICTURE[SHAPE])
    assert frame.encoded is None
    opaque = np.dstack([PICTURE, np.full_like(PICTURE[..., 0], 255)])
    assert read_frame(tmp_path, "a" + suffix, encoded(suffix, opaque)).mask is None


@pytest.mark.parametrize(("extra", "hidden_half"), [(2, False), (1, True), (0, None)])
def test_the_alpha_of_a_tiff_is_what_its_extra_sample_says(tmp_path, extra, hidden_half):
    """libtiff multiplies the colours by an alpha that is not associated: they came out black where it is 0."""
    image = pytest.importorskip("PIL.Image")
    file = io.BytesIO()
    image.fromarray(with_alpha(half=128)).save(file, "tiff")
    data = bytearray(file.getvalue())
    place = data.index(struct.pack("<HHI", 338, 3, 1))
    struct.pack_into("<H", data, place + 8, extra)
    frame = read_frame(tmp_path, "a.tif", bytes(data))
    if hidden_half is None:
        assert frame.mask is None and np.array_equal(frame.image, PICTURE)
        return
    used = SHAPE.copy()
    used[:20, 40:50] = not hidden_half
    assert frame.mask is not None and np.array_equal(frame.mask, used)
    assert np.array_equal(frame.image[used], PICTURE[used])


@pytest.mark.parametrize("orientation", range(1, 9))
def test_alpha_is_turned_as_its_photograph_is(tmp_path, orientation):
    image = pytest.importorskip("PIL.Image")
    marked = with_alpha()
    marked[SHAPE] = [250, 250, 250, 255]
    marked[~SHAPE] = [0, 0, 0, 0]
    for suffix in ("png", "tiff", "webp"):
        file, exif = io.BytesIO(), image.Exif()
        exif[ORIENTATION] = orientation
        options = {"lossless": True, "exact": True} if suffix == "webp" else {}
        image.fromarray(marked).save(file, suffix, exif=exif, **options)
        decoded = decode_image(file.getvalue())
        assert decoded.mask is not None and decoded.mask.shape == decoded.image.shape[:2], suffix
        assert np.array_equal(decoded.mask, decoded.image.max(2) > 128), suffix


def test_a_photograph_of_which_alpha_leaves_next_to_nothing_is_named(tmp_path):
    alpha = np.zeros_like(PICTURE[..., 0])
    alpha[:4, :4] = 255
    dropped = read_one(tmp_path, "a.png", encoded(".png", np.dstack([PICTURE, alpha])))
    assert isinstance(dropped, DroppedFrame) and dropped.reason == "its alpha channel hides 99.5 % of it"


@pytest.mark.parametrize("suffix", [".png", ".tif", ".ppm"])
def test_images_of_sixteen_bits_with_twelve_used_are_stretched_alike_and_that_is_told(tmp_path, suffix, caplog):
    dark = PICTURE.astype(np.uint16) * 257 >> 6  # of a darker photograph: up to 10 bits
    bright = PICTURE.astype(np.uint16) * 257 >> 4
    (tmp_path / f"1{suffix}").write_bytes(encoded(suffix, dark))
    (tmp_path / f"2{suffix}").write_bytes(encoded(suffix, bright))
    (tmp_path / "3.jpg").write_bytes(encoded())
    first, second, third = frames_in(tmp_path)
    assert np.abs(second.image.astype(int) - PICTURE).max() <= 1
    assert np.abs(first.image.astype(int) - PICTURE // 4).max() <= 1
    assert np.abs(third.image.astype(int) - PICTURE).mean() < 4
    assert first.encoded is None, "a recording would store the file, whose upper 8 bits are nearly black"
    (told,) = [record.message for record in caplog.records]
    assert told == "16-bit photographs use only 12 of 16 bits: this range is stretched to 8 bits, alike for all of them"


def test_a_narrow_band_of_sixteen_bits_is_stretched_though_a_pixel_is_hot(tmp_path, caplog):
    thermal = 7000 + 8 * np.tile(PICTURE[..., 0].astype(np.uint16), (4, 4))
    thermal[3, 3] = 65_535
    frame = read_frame(tmp_path, "a.png", encoded(".png", thermal))
    assert frame.image.min() < 20 and np.percentile(frame.image, 99) > 220
    assert "use only the values 7" in caplog.text


@pytest.mark.parametrize("suffix", [".jpe", ".jfif", ".JFIF", ".mpo", ".ppm", ".pgm", ".jp2", ".dib"])
def test_rarer_suffixes_are_read(tmp_path, suffix):
    kind = {".jpe": ".jpg", ".jfif": ".jpg", ".mpo": ".jpg", ".dib": ".bmp"}.get(suffix.lower(), suffix)
    picture = PICTURE[..., 0] if suffix == ".pgm" else PICTURE
    frame = read_frame(tmp_path, "a" + suffix, encoded(kind, picture))
    expected = np.repeat(PICTURE[..., :1], 3, 2) if suffix == ".pgm" else PICTURE
    assert np.abs(frame.image[24:46:4, 4:28:4].astype(int) - expected[24:46:4, 4:28:4]).max() < 12


def test_a_jpeg_2000_file_is_refused_where_it_is_cut_or_too_large(tmp_path):
    data = encoded(".jp2")
    for bad, reason in ((data[: len(data) // 2], "truncated"), (data[:200] + data[-2:], "its decoder ended")):
        dropped = read_one(tmp_path, "a.jp2", bad)
        assert isinstance(dropped, DroppedFrame) and reason in dropped.reason
    dropped = read_one(tmp_path, "a.jp2", data, max_pixels=64 * 48 - 1)
    assert isinstance(dropped, DroppedFrame) and "64 x 48: more than" in dropped.reason


@pytest.mark.parametrize(
    "header", [b"P6 64 48 255\n", b"P6\n# a remark\n64 # another\n48\n255\n", b"P6\t64\r\n48 255 "]
)
def test_a_ppm_with_remarks_is_read_and_a_cut_one_is_not(tmp_path, header):
    frame = read_frame(tmp_path, "a.ppm", header + PICTURE.tobytes())
    assert np.array_equal(frame.image, PICTURE)
    dropped = read_one(tmp_path, "a.ppm", header + PICTURE.tobytes()[:-1])
    assert dropped == DroppedFrame("a.ppm", "truncated: the file ends early")


def test_images_that_cannot_be_read_are_named_whatever_their_suffix(tmp_path):
    (tmp_path / "1.jpg").write_bytes(encoded())
    (tmp_path / "2.psd").write_bytes(b"8BPS\0\1")
    (tmp_path / "3.jpg_original").write_bytes(encoded())
    (tmp_path / "4").write_bytes(encoded(".png"))
    (tmp_path / "notes.txt").write_text("no image")
    (tmp_path / "cameras.json").write_text("{}")
    assert reasons_in(tmp_path) == {
        "2.psd": ".psd files cannot be read. Convert it to JPEG or PNG",
        "3.jpg_original": ".jpg_original is no suffix of photographs, and its content is JPEG: give it that suffix",
        "4": "its name has no suffix, and its content is PNG: give it that suffix",
    }
    assert len(list(stream(Config(tmp_path, names=("1.jpg",))))) == 1


@pytest.mark.parametrize("order", [">", "<"])
def test_exif_orientation_is_applied(tmp_path, order):
    upright = {1: PICTURE, 3: PICTURE[::-1, ::-1], 6: np.rot90(PICTURE, -1), 8: np.rot90(PICTURE)}
    for orientation, expected in upright.items():
        frame = read_frame(tmp_path, "a.jpg", with_exif(encoded(), {ORIENTATION: orientation}, order=order))
        assert frame.image.shape == expected.shape
        assert np.abs(frame.image.astype(int) - expected).mean() < 4


def test_focal_length_from_35mm_equivalent_compares_diagonals(tmp_path):
    frame = read_frame(tmp_path, "a.jpg", with_exif(encoded(), {ORIENTATION: 6}, {0xA405: 28}))
    expected = 28 * 80 / math.hypot(36, 24)  # a diagonal of 80 pixels
    assert frame.intrinsics.fx == pytest.approx(expected)
    focal = frame.intrinsics.fx
    assert frame.intrinsics == Intrinsics(48, 64, focal, focal, 24.0, 32.0, source="exif")


def test_focal_length_from_sensor_resolution_follows_a_resized_image():
    # 8 mm on a sensor of 500 pixels a centimetre is 400 pixels at the taken size of 640, 40 pixels at 64.
    tags = {0x920A: (8, 1), 0xA20E: (500, 1), 0xA210: 3, 0xA002: 640, 0xA003: 480}
    intrinsics = exif_intrinsics(read_tags(tiff({}, tags)), 64, 48)
    assert intrinsics is not None
    assert intrinsics.fx == pytest.approx(40.0)


@pytest.mark.parametrize(
    ("tags", "why"),
    [
        ({0xA405: 0}, "zero means unknown"),
        ({0xA405: 2000}, "no lens is that long"),
        ({0xA405: 28, 0xA002: 640, 0xA003: 640}, "cropped after it was taken"),
        ({0x920A: (8, 0), 0xA20E: (500, 1)}, "0 in a denominator"),
        ({0x920A: (8, 1)}, "a focal length without a sensor"),
        ({0x920A: (8, 1), 0xA20E: (500, 1), 0xA210: 9}, "an unknown unit"),
    ],
)
def test_focal_lengths_that_are_not_believed(tags, why):
    assert exif_intrinsics(read_tags(tiff({}, tags)), 64, 48) is None, why


def test_photographs_tell_which_camera_took_them_and_how_far_it_zoomed(tmp_path):
    told = {0x010F: "Maker", 0x0110: "Model"}
    cameras = {}
    for name, tags, exif_tags in (
        ("wide", told, {0xA405: 28}),
        ("wide_too", told, {0xA405: 28}),
        ("zoomed", told, {0xA405: 28, 0xA404: (2, 1)}),
        ("other", told | {0x0110: "Another"}, {0xA405: 28}),
        ("unknown", {}, {0xA405: 28}),
    ):
        (folder := tmp_path / name).mkdir()
        cameras[name] = read_frame(folder, "a.jpg", with_exif(encoded(), tags, exif_tags)).camera
    assert cameras["wide"] == cameras["wide_too"] != ""
    assert len({cameras["wide"], cameras["zoomed"], cameras["other"]}) == 3
    assert cameras["unknown"] == ""


def test_damaged_exif_is_ignored(tmp_path):
    broken = tiff({}, {0xA405: 28})[:-8]
    for data in (broken, b"MM\0*\xff\xff\xff\xff", b"nonsense"):
        assert exif_intrinsics(read_tags(data), 64, 48) is None


def test_zero_over_zero_in_a_pointer_or_a_size_is_no_number():
    nothing_over_nothing = tiff({0x8769: (0, 0)}, {})
    assert 0x8769 in read_tags(nothing_over_nothing)
    with pytest.raises(UnusableImage, match="ImageWidth"):
        read_header(tiff({0x0100: (0, 0), 0x0101: 48}, {}))


def test_given_intrinsics_are_scaled_to_images_of_their_shape(tmp_path):
    (tmp_path / "a.png").write_bytes(encoded(".png"))
    (tmp_path / "b.png").write_bytes(encoded(".png", PICTURE[:40]))
    given = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0, source="given")
    same, other = stream(Config(tmp_path, intrinsics=given))
    assert isinstance(same, Frame) and same.intrinsics == given.resized(64, 48)
    assert isinstance(other, Frame) and other.intrinsics is None


def test_natural_order_ids_stamps_and_choice(tmp_path):
    for name in ("img10.png", "img2.png", "IMG1.png", "img2b.png", "b.png"):
        (tmp_path / name).write_bytes(encoded(".png"))
    frames = [frame for frame in stream(Config(tmp_path, fps=4)) if isinstance(frame, Frame)]
    assert [frame.name for frame in frames] == ["b.png", "IMG1.png", "img2.png", "img2b.png", "img10.png"]
    assert [frame.frame_id for frame in frames] == [0, 1, 2, 3, 4]
    assert [frame.stamp_ns for frame in frames] == [0, 250_000_000, 500_000_000, 750_000_000, 1_000_000_000]
    assert [frame.name for frame in stream(Config(tmp_path, names=("img10", "img2.png")))] == ["img2.png", "img10.png"]


def test_a_photograph_has_the_time_that_its_exif_tells_and_another_one_has_none(tmp_path):
    (tmp_path / "a.jpg").write_bytes(with_exif(encoded(), {}, {0x9003: "2024:05:06 10:00:07", 0x9291: "25"}))
    (tmp_path / "b.jpg").write_bytes(encoded())
    told, silent = (item for item in stream(Config(tmp_path)) if isinstance(item, Frame))
    assert told.captured_at == Stamp(1_714_989_607_250_000_000, Clock.LOCAL)
    assert silent.captured_at is None and (told.stamp_ns, silent.stamp_ns) == (0, 100_000_000)


def test_a_name_tells_the_time_where_exif_does_not(tmp_path):
    (tmp_path / "1341847980.722988.jpg").write_bytes(with_exif(encoded(), {}, {0x9003: "2024:05:06 10:00:07"}))
    (tmp_path / "1341847981.726650.png").write_bytes(encoded(".png"))
    by_exif, by_name = (item for item in stream(Config(tmp_path)) if isinstance(item, Frame))
    assert by_exif.captured_at == Stamp(1_714_989_607_000_000_000, Clock.LOCAL)
    assert by_name.captured_at == Stamp(1_341_847_981_726_650_000, Clock.UTC)


def test_a_photograph_that_is_shown_again_was_captured_when_it_was(tmp_path):
    (tmp_path / "a.jpg").write_bytes(with_exif(encoded(), {}, {0x9003: "2024:05:06 10:00:07"}))
    once, again = (item for item in stream(Config(tmp_path, loops=2)) if isinstance(item, Frame))
    assert once.captured_at == again.captured_at is not None and once.stamp_ns < again.stamp_ns


def truncated(suffix):
    data = encoded(suffix)
    return {"half": data[: len(data) // 2], "last bytes": data[:-2], "zero tail": data[:-40] + bytes(40)}


@pytest.mark.parametrize("cut", ["half", "last bytes"])
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp", ".bmp"])
def test_truncated_files_are_named_and_left_out(tmp_path, suffix, cut):
    dropped = read_one(tmp_path, "a" + suffix, truncated(suffix)[cut])
    assert isinstance(dropped, DroppedFrame)
    assert "truncated" in dropped.reason or "damaged" in dropped.reason


def test_a_jpeg_whose_end_was_never_written(tmp_path):
    dropped = read_one(tmp_path, "a.jpg", truncated(".jpg")["zero tail"])
    assert dropped == DroppedFrame("a.jpg", "truncated: the JPEG has no end-of-image marker")


def test_an_end_marker_inside_a_thumbnail_does_not_hide_truncation(tmp_path):
    jpeg = encoded()
    thumbnail = b"\xff\xec" + struct.pack(">H", 2 + len(jpeg)) + jpeg
    whole = jpeg[:2] + thumbnail + jpeg[2:]
    assert isinstance(read_one(tmp_path, "a.jpg", whole), Frame)
    assert isinstance(read_one(tmp_path, "a.jpg", whole[:-40]), DroppedFrame)
    assert isinstance(read_one(tmp_path, "a.jpg", whole + b"camera's own data"), Frame)


def test_a_damaged_png_chunk(tmp_path):
    data = bytearray(encoded(".png"))
    data[len(data) // 2] ^= 0x55
    assert isinstance(read_one(tmp_path, "a.png", bytes(data)), DroppedFrame)


@pytest.mark.parametrize(
    ("name", "data", "reason"),
    [
        ("empty.jpg", b"", "empty file"),
        ("text.png", b"hello, this is text", "not an image"),
        ("sound.webp", b"RIFF\x10\0\0\0WAVEfmt \0\0\0\0", "not an image"),
        ("headless.jpg", b"\xff\xd8\xff\xe0\0\x04ab\xff\xd9", "without an image"),
        ("short.png", b"\x89PNG\r\n\x1a\n", "truncated"),
        ("short.tif", b"II*\0\xff\0\0\0", "truncated"),
        ("short.bmp", b"BM123", "truncated"),
    ],
)
def test_foreign_content_is_named_and_left_out(tmp_path, name, data, reason):
    dropped = read_one(tmp_path, name, data)
    assert isinstance(dropped, DroppedFrame)
    assert reason in dropped.reason


def test_a_photograph_in_a_foreign_format_is_named_beside_others(tmp_path):
    (tmp_path / "1.jpg").write_bytes(encoded())
    (tmp_path / "2.jxl").write_bytes(b"\xff\x0a")
    _, dropped = stream(Config(tmp_path))
    assert dropped == DroppedFrame("2.jxl", ".jxl files cannot be read. Convert it to JPEG or PNG")


def test_too_many_pixels_are_refused_before_they_are_decoded(tmp_path):
    huge = bytearray(encoded(".png"))
    huge[16:24] = struct.pack(">II", 200_000, 200_000)
    dropped = read_one(tmp_path, "a.png", bytes(huge))
    assert isinstance(dropped, DroppedFrame)
    assert "200000 x 200000" in dropped.reason
    for suffix in (".jpg", ".webp", ".tif", ".bmp"):
        other = tmp_path / suffix[1:]
        other.mkdir()
        dropped = read_one(other, "a" + suffix, encoded(suffix), max_pixels=64 * 48 - 1)
        assert isinstance(dropped, DroppedFrame)
        assert "64 x 48" in dropped.reason


def test_a_bad_file_takes_no_frame_id(tmp_path):
    (tmp_path / "1.jpg").write_bytes(encoded())
    (tmp_path / "2.jpg").write_bytes(b"")
    (tmp_path / "3.jpg").symlink_to(tmp_path / "nowhere.jpg")
    (tmp_path / "4.jpg").write_bytes(encoded())
    first, empty, gone, last = stream(Config(tmp_path))
    assert isinstance(first, Frame) and isinstance(last, Frame)
    assert (first.frame_id, last.frame_id) == (0, 1)
    assert empty == DroppedFrame("2.jpg", "empty file")
    assert isinstance(gone, DroppedFrame) and "cannot be read" in gone.reason


def test_other_files_are_not_for_us(tmp_path):
    for name in ("cameras.json", "notes.txt", ".hidden.jpg", "._a.jpg"):
        (tmp_path / name).write_text("{}")
    (tmp_path / "folder.jpg").mkdir()
    read_one(tmp_path, "a.jpg", encoded())


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.jpg")
    read_one(tmp_path, "a.jpg", encoded())


def test_names_become_text_of_one_line(tmp_path):
    for name in (b"\xff\xfe1.jpg", b"2\n.jpg", b"2\\n.jpg", "3 \u5199\u771f.jpg".encode()):
        (tmp_path / os.fsdecode(name)).write_bytes(encoded())
    names = {frame.name for frame in stream(Config(tmp_path))}
    assert names == {"\\udcff\\udcfe1.jpg", "2\\n.jpg", "2\\\\n.jpg", "3 \u5199\u771f.jpg"}


def test_nothing_to_stream_says_what_to_do(tmp_path):
    with pytest.raises(FileNotFoundError, match="is not there; give a folder"):
        stream(Config(tmp_path / "nowhere"))
    with pytest.raises(ValueError, match="no photographs"):
        stream(Config(tmp_path))
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.jpg").write_bytes(encoded())
    with pytest.raises(ValueError, match="give one of its folders: images"):
        stream(Config(tmp_path))
    with pytest.raises(FileNotFoundError, match="is a file, not a folder"):
        stream(Config(tmp_path / "images" / "a.jpg"))
    (tmp_path / "phone").mkdir()
    (tmp_path / "phone" / "IMG_1.DNG").write_bytes(b"II*\0")
    with pytest.raises(ValueError, match=r"holds only .dng files\. Convert it to JPEG"):
        stream(Config(tmp_path / "phone"))
    with pytest.raises(ValueError, match="no photograph named b.jpg"):
        stream(Config(tmp_path / "images", names=("b.jpg",)))
