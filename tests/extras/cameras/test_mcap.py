"""Image topics of MCAP files."""

from __future__ import annotations

import struct
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import CompressionType

from splatnode.capture import film
from splatnode.capture.frame import Clock, DroppedFrame, Frame, Stamp
from splatnode.extras.cameras.mcap import Config, image_topics, stream
from splatnode.extras.logged import mcap
from splatnode.extras.logged.mcap import UnusableLog, unpack_chunk
from tests.support.mcap_files import START_NS, STEP_NS, as_json, calibration, compressed, raw, write

K = (100.0, 0.0, 31.5, 0.0, 110.0, 23.5, 0.0, 0.0, 1.0)
SIZE = 64, 48
SCHEMA = struct.pack("<BQHI1sII", 3, 15, 1, 1, b"a", 0, 0)  # a record, of a schema called a


def flat(level: int) -> np.ndarray:
    return np.full((48, 64, 3), (level, 100, 50), np.uint8)


def frames(file: Path, **options: Any) -> list[Any]:
    return list(stream(Config(file, **options)))


@pytest.fixture
def drive(tmp_path):
    """Three pictures of a front camera with its lens, one of a rear camera, and depth."""
    depth = raw("/front/depth", 64, 48, "16UC1", 128, bytes(128 * 48))
    seen = [compressed("/front/image_raw", flat(80 * index), "front") for index in range(3)]
    lens = calibration("/front/camera_info", SIZE, K, (0.1, -0.2, 0.0, 0.0, 0.0), sensor="front")
    other = calibration("/rear/camera_info", SIZE, (50.0, *K[1:]), sensor="rear")
    told = [lens, other, seen[0], depth, as_json("/log", "Log", {}), *seen[1:], compressed("/rear/image", flat(9))]
    return write(tmp_path / "drive.mcap", told, chunk_size=2000)


def test_a_topic_gives_its_images_at_their_times_with_the_lens_of_its_camera(drive):
    assert [topic.name for topic in image_topics(drive)] == ["/front/image_raw", "/rear/image"]
    found = frames(drive, topic="/front/image_raw")
    assert [frame.name for frame in found] == [f"front_image_raw_{index:06d}.png" for index in range(3)]
    assert [frame.stamp_ns for frame in found] == [START_NS + STEP_NS * index for index in (2, 5, 6)]
    assert found[0].captured_at == Stamp(START_NS + 500, Clock.UTC)
    assert np.allclose([frame.image[24, 32, 0] for frame in found], (0, 80, 160), atol=4)
    lens = found[0].intrinsics
    assert (lens.fx, lens.fy, lens.cx, lens.cy, lens.source) == (100.0, 110.0, 32.0, 24.0, "calibration")
    assert lens.distortion == (0.1, -0.2, 0.0, 0.0, 0.0) and lens.model == "opencv"
    assert frames(drive, topic="/rear/image")[0].intrinsics.fx == 50.0


def test_one_of_several_topics_must_be_named(drive):
    with pytest.raises(ValueError, match="2 topics of images: /front/image_raw, /rear/image; name one"):
        stream(Config(drive))
    with pytest.raises(ValueError, match="no images of a topic '/front/depth'; there are: /front/image_raw, /rear"):
        stream(Config(drive, topic="/front/depth"))
    with pytest.raises(FileNotFoundError, match="give an MCAP file"):
        stream(Config(drive.with_name("lost.mcap")))


def test_a_file_without_images_says_what_it_holds(tmp_path):
    file = write(tmp_path / "a.mcap", [as_json("/log", "Log", {})])
    with pytest.raises(ValueError, match=r"must have a topic of images .*; it holds foxglove\.Log"):
        stream(Config(file))


@pytest.mark.parametrize("content", [b"", b"no log", b"\x89MCAP0\r\n" + bytes(100)])
def test_what_is_no_mcap_file_says_so(tmp_path, content):
    file = tmp_path / "a.mcap"
    file.write_bytes(content)
    with pytest.raises(ValueError, match="cannot be read|must have a topic of images"):
        frames(file)


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_a_file_that_ends_early_is_read_as_far_as_it_goes(tmp_path, compression):
    noise = np.random.default_rng(0).integers(0, 256, (8, 48, 64, 3)).astype(np.uint8)
    seen = [compressed("/image", picture) for picture in noise]
    file = write(tmp_path / "a.mcap", seen, compression=compression, chunk_size=20_000)
    whole = len(frames(file))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    *read, last = frames(file)
    assert whole == 8 and 0 < len(read) < 8 and all(isinstance(each, Frame) for each in read)
    assert isinstance(last, DroppedFrame) and last.name == "image_rest" and "cannot be read" in last.reason


def chunk(compression, data, size):
    return Chunk(compression, data, 0, 0, uncompressed_crc=0, uncompressed_size=size)


@pytest.mark.parametrize("name, compress", [("lz4", lz4.frame.compress), ("zstd", zstandard.compress)])
def test_a_chunk_is_decompressed_as_far_as_it_says_that_it_goes(name, compress):
    (told,) = unpack_chunk(chunk(name, compress(SCHEMA), len(SCHEMA)))
    assert told.name == "a"
    bomb = compress(bytes(1 << 26))
    tracemalloc.start()
    with pytest.raises(UnusableLog, match="says that it holds 1000 bytes, and holds more or fewer"):
        list(unpack_chunk(chunk(name, bomb, 1000)))
    most_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most_bytes < 1 << 22
    with pytest.raises(UnusableLog, match="more or fewer"):
        list(unpack_chunk(chunk(name, compress(SCHEMA), len(SCHEMA) + 1)))


@pytest.mark.parametrize("indexed", [True, False])
def test_chunks_that_together_hold_more_than_any_log_does_are_refused(tmp_path, monkeypatch, indexed):
    seen = [as_json("/image", "CompressedImage", {"data": "0" * 100_000}) for _ in range(8)]
    file = write(tmp_path / "a.mcap", seen, compression=CompressionType.ZSTD, chunk_size=150_000)
    assert len(chunk_places(file)) == 4 and file.stat().st_size < 2500
    if not indexed:
        indexed_anew(file, [])
    monkeypatch.setattr(mcap, "_MOST_BYTES", 250_000)
    monkeypatch.setattr(mcap, "_MOST_TIMES", 100)
    read = []
    with pytest.raises(UnusableLog, match=r"may be decompressed to \d+, its chunks say that they hold \d+ or more"):
        for each in mcap.messages(file, {"/image"}):
            read.append(each)
    assert 2 <= len(read) < 8  # those before it were given
    monkeypatch.setattr(mcap, "_MOST_TIMES", 1000)
    assert len(list(mcap.messages(file, {"/image"}))) == 8


def test_an_index_that_leads_nowhere_is_told(tmp_path):
    file = write(tmp_path / "a.mcap", [compressed("/image", flat(1))])
    with file.open("rb") as opened:
        summary = make_reader(opened).get_summary()
    (chunk,) = summary.chunk_indexes
    times = chunk.message_start_time, chunk.message_end_time
    entry, wrong = (struct.pack("<QQQ", *times, at) for at in (chunk.chunk_start_offset, 2**63 + 5))
    assert file.read_bytes().count(entry) == 1
    file.write_bytes(file.read_bytes().replace(entry, wrong))
    with pytest.raises(ValueError, match=f"its index leads to byte {2**63 + 5}, it has {file.stat().st_size}"):
        frames(file)


def indexed_anew(file: Path, offsets: list[int]) -> None:
    """The file with an index that names chunks at these places, of any channel."""
    data, told = file.read_bytes(), b""
    with file.open("rb") as opened:
        summary = make_reader(opened).get_summary()
    for record in (*summary.schemas.values(), *summary.channels.values()):
        told += record_bytes(record)
    first = summary.chunk_indexes[0]
    for offset in offsets:
        told += record_bytes(replace(first, chunk_start_offset=offset, message_index_offsets={}))
    end = data.rindex(b"\x0f" + struct.pack("<Q", 4))  # the end of the data
    start = end + 13
    footer = b"\x02" + struct.pack("<QQQI", 20, start, 0, 0)
    file.write_bytes(data[:start] + told + footer + b"\x89MCAP0\r\n")


def record_bytes(record: Any) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def chunk_places(file: Path) -> list[int]:
    with file.open("rb") as opened:
        return [each.chunk_start_offset for each in make_reader(opened).get_summary().chunk_indexes]


def test_a_chunk_that_an_index_names_often_is_unpacked_once(tmp_path, monkeypatch):
    file = write(tmp_path / "a.mcap", [compressed("/image", flat(10 * n)) for n in range(6)], chunk_size=2000)
    places = chunk_places(file)
    assert len(places) > 1
    indexed_anew(file, places * 3000)
    read, asked = mcap.unpack_chunk, []
    monkeypatch.setattr(mcap, "unpack_chunk", lambda record: asked.append(record) or read(record))
    assert len(list(mcap.messages(file, {"/image"}))) == 6
    assert len(asked) == len(places)


def test_a_chunk_within_another_one_is_refused(tmp_path):
    seen = [compressed("/image", flat(10 * n)) for n in range(6)]
    file = write(tmp_path / "a.mcap", seen, chunk_size=2000, compression=CompressionType.NONE)
    places = chunk_places(file)
    indexed_anew(file, [*places, places[0] + 9])
    with pytest.raises(UnusableLog, match=f"its index leads to byte {places[0] + 9}, within a chunk that goes on to"):
        list(mcap.messages(file, {"/image"}))


def test_the_records_of_a_chunk_are_not_in_memory_at_once():
    data = SCHEMA * 10_000
    tracemalloc.start()
    assert sum(1 for _ in unpack_chunk(chunk("", data, len(data)))) == 10_000
    most_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most_bytes < 2 * len(data)


def test_a_chunk_that_was_changed_is_refused():
    with pytest.raises(UnusableLog, match="its checksum is another one"):
        list(unpack_chunk(replace(chunk("", SCHEMA, len(SCHEMA)), uncompressed_crc=5)))
    with pytest.raises(UnusableLog, match="compressed by lz4, zstd or not, it is by 'bz2'"):
        list(unpack_chunk(chunk("bz2", SCHEMA, len(SCHEMA))))


def test_an_image_that_cannot_be_decoded_costs_only_itself(tmp_path):
    broken = as_json("/image", "CompressedImage", {"data": 5})
    file = write(tmp_path / "a.mcap", [compressed("/image", flat(1)), compressed("/image", b"x"), broken])
    good, first, second = frames(file)
    assert isinstance(good, Frame) and isinstance(first, DroppedFrame) and isinstance(second, DroppedFrame)
    assert "must be JSON of Foxglove's schema" in second.reason


def test_raw_images_of_every_encoding_are_the_picture(tmp_path):
    image = flat(200)
    bgr, grey = image[:, :, ::-1], np.full((48, 64), 77, np.uint8)
    padded = np.pad(image.reshape(48, 192), ((0, 0), (0, 8)))
    alpha = np.dstack([image, grey])
    uyvy = np.tile(np.array([128, 90, 128, 90], np.uint8), (48, 32))
    rows = {
        "rgb8": (200, padded.tobytes(), image),
        "bgr8": (192, bgr.tobytes(), image),
        "8UC3": (192, bgr.tobytes(), image),
        "rgba8": (256, alpha.tobytes(), image),
        "bgra8": (256, np.dstack([bgr, grey]).tobytes(), image),
        "mono8": (64, grey.tobytes(), np.dstack([grey] * 3)),
        "uyvy": (128, uyvy.tobytes(), np.full((48, 64, 3), 86, np.uint8)),
        "yuyv": (128, uyvy.reshape(-1, 2)[:, ::-1].tobytes(), np.full((48, 64, 3), 86, np.uint8)),
        "bayer_rggb8": (64, bayer(image, 0, 0), image),
        "bayer_bggr8": (64, bayer(image, 1, 1), image),
        "bayer_grbg8": (64, bayer(image, 0, 1), image),
        "bayer_gbrg8": (64, bayer(image, 1, 0), image),
    }
    told = [raw(f"/{name}", 64, 48, name, step, data) for name, (step, data, _) in rows.items()]
    file = write(tmp_path / "a.mcap", told)
    for name, (_, _, expected) in rows.items():
        (frame,) = frames(file, topic=f"/{name}")
        assert np.abs(frame.image.astype(int) - expected).max() <= 2, name


def bayer(image: np.ndarray, row: int, column: int) -> bytes:
    """What a sensor sees of an image whose red filters are in this row and column of each 2 x 2 pixels."""
    seen = image[:, :, 1].copy()
    seen[row::2, column::2] = image[row::2, column::2, 0]
    seen[1 - row :: 2, 1 - column :: 2] = image[1 - row :: 2, 1 - column :: 2, 2]
    return seen.tobytes()


@pytest.mark.parametrize(
    ("told", "said"),
    [((64, 48, "rgb8", 100, bytes(9000)), "rows of 192 bytes"), ((0, 48, "rgb8", 0, b""), "must have 1 to")],
)
def test_a_raw_image_must_have_its_bytes(tmp_path, told, said):
    (dropped,) = frames(write(tmp_path / "a.mcap", [raw("/image", *told)]))
    assert isinstance(dropped, DroppedFrame) and said in dropped.reason


def test_rectified_images_have_the_lens_without_distortion(tmp_path):
    P = (90.0, 0.0, 30.5, 0.0, 0.0, 95.0, 22.5, 0.0, 0.0, 0.0, 1.0, 0.0)
    lens = calibration("/cam/camera_info", SIZE, K, (0.1, 0.1, 0.0, 0.0), P=P)
    told = [lens, compressed("/cam/image_rect", flat(1)), compressed("/cam/image_raw", flat(1))]
    file = write(tmp_path / "a.mcap", told)
    (rectified,), (taken,) = frames(file, topic="/cam/image_rect"), frames(file, topic="/cam/image_raw")
    assert (rectified.intrinsics.fx, rectified.intrinsics.cy, rectified.intrinsics.distortion) == (90.0, 23.0, ())
    assert (taken.intrinsics.fx, taken.intrinsics.distortion) == (100.0, (0.1, 0.1, 0.0, 0.0))


def test_a_fisheye_is_a_fisheye_and_what_is_no_lens_is_said(tmp_path, caplog):
    fish = calibration("/a/camera_info", SIZE, K, (0.1, 0.0, 0.0, 0.01), "equidistant")
    strange = calibration("/b/camera_info", SIZE, K, (0.1,), "of my own")
    none = calibration("/c/camera_info", SIZE, (0.0,) * 9)
    square = calibration("/d/camera_info", (64, 64), K)
    images = [compressed(f"/{name}/image", flat(1)) for name in "abcd"]
    file = write(tmp_path / "a.mcap", [fish, strange, none, square, *images])
    lenses = [frames(file, topic=f"/{name}/image")[0].intrinsics for name in "abcd"]
    assert lenses[0].model == "fisheye" and lenses[1:] == [None, None, None]
    assert "calibration_unusable" in caplog.text and "of my own" in caplog.text
    assert "lens_of_another_size" in caplog.text


def test_a_part_of_a_file_is_named_by_its_path(drive, tmp_path):
    for topic in ("/front/image", "plain", "/a//b", "/../x", "/with space#%", "/ends/"):
        path = film.part_of(drive, topic)
        assert film.file_and_part(Path(str(path))) == (drive, topic) and film.is_film(path.resolve())
    odd = drive.rename(tmp_path / "a#b.mcap")
    assert film.file_and_part(odd) == (odd, "") and film.file_and_part(film.part_of(odd, "/x")) == (odd, "/x")
    assert not film.is_film(tmp_path / "lost.mcap#/x") and not film.is_film(tmp_path)
    assert len(list(film.stream(film.part_of(odd, "/front/image_raw")))) == 3
