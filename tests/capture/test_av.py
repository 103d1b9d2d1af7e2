"""What a video file holds comes as it is there: all frames, their times and numbers, upright, with square pixels."""

from __future__ import annotations

import os
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from splatnode.capture.av import Video, _Timeline
from splatnode.capture.video_process import Span, VideoError, VideoFrame, decode_video
from tests.support.clips import level_images, level_of, packet_times_s, turn, write_clip, write_sound

COUNT, LIMIT = 20, 1_000_000
CONSTANT = [40 * index for index in range(COUNT)]
VARIABLE = [
    0,
    40,
    80,
    1080,
    2080,
    2120,
    2121,
    2160,
    3000,
    3033,
    3066,
    3100,
    3133,
    4000,
    5000,
    5040,
    5080,
    8000,
    8240,
    9000,
]
CODECS = {"libx264": "mp4", "libx265": "mp4", "libsvtav1": "mp4", "libvpx-vp9": "mp4", "mjpeg": "mov"}
FURTHER = [
    ("libx264", "mkv"),
    ("mpeg4", "avi"),
    ("libx264", "ts"),
    ("libx264", "avi"),
    ("libvpx-vp9", "webm"),
    ("mjpeg", "avi"),
]


def read(file: Path, from_s: float = 0.0, to_s: float | None = None, every: int = 1) -> list[VideoFrame]:
    span = Span(round(from_s * 1e9), None if to_s is None else round(to_s * 1e9))
    return list(decode_video(file, every, LIMIT, span))


def read_here(file: Path, from_s: float, to_s: float | None) -> list[VideoFrame]:
    """As `read`, in this process: `video_process` hands on what this gives."""
    video = Video(file, threads=os.cpu_count() or 1)
    try:
        span = video.frames(round(from_s * 1e9), None if to_s is None else round(to_s * 1e9), 1, LIMIT)
        return [VideoFrame(each.index, each.time_ns, each.image, each.pixel_aspect) for each in span]
    finally:
        video.close()


def brightness(frame: VideoFrame) -> float:
    """That of all but the dark quarter, wherever it lies."""
    return float(np.median(frame.image))


def need(codec: str) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"needs PyAV with {codec}")


def check(file: Path, found: list[VideoFrame], size: tuple[int, int] = (96, 64)) -> None:
    """All frames, each with its picture, at the times of the packets."""
    assert [frame.index for frame in found] == list(range(COUNT))
    assert np.allclose([frame.time_ns / 1e9 for frame in found], packet_times_s(file), atol=1e-3, rtol=0)
    assert np.allclose([brightness(frame) for frame in found], [level_of(i, COUNT) for i in range(COUNT)], atol=8)
    assert {frame.image.shape for frame in found} == {(size[1], size[0], 3)}


@pytest.mark.parametrize("times_ms", [CONSTANT, VARIABLE], ids=["constant", "variable"])
@pytest.mark.parametrize("codec", CODECS)
def test_all_frames_come_at_the_containers_times_upright_whole_and_in_part(tmp_path, codec, times_ms):
    need(codec)
    file = write_clip(tmp_path / f"a.{CODECS[codec]}", codec, level_images(COUNT), times_ms)
    assert np.allclose(packet_times_s(file), np.array(times_ms) / 1000, atol=1e-3, rtol=0), "the clip is as it was made"
    check(file, read(file))
    turn(file, (0, 1, -1, 0))
    every = read(file)
    check(file, every, size=(64, 96))
    assert all(frame.image[:40, 40:].max() < 30 for frame in every), "the dark quarter is at the upper right"
    for first, end in ((1, 4), (4, 5), (7, 19), (13, COUNT)):
        from_s, to_s = times_ms[first] / 1000, times_ms[end] / 1000 if end < COUNT else None
        found = read_here(file, from_s, to_s)
        assert [frame.index for frame in found] == list(range(first, end))
        for frame in found:
            assert frame.time_ns == every[frame.index].time_ns
            np.testing.assert_array_equal(frame.image, every[frame.index].image)


@pytest.mark.parametrize(("codec", "kind"), FURTHER)
def test_other_containers_tell_their_times_too(tmp_path, codec, kind):
    need(codec)
    file = write_clip(tmp_path / f"a.{kind}", codec, level_images(COUNT), CONSTANT)
    found = read(file)
    assert [frame.index for frame in found] == list(range(COUNT))
    assert np.allclose([frame.time_ns / 1e9 for frame in found], np.array(CONSTANT) / 1000, atol=1e-3, rtol=0)
    assert np.allclose([brightness(frame) for frame in found], [level_of(i, COUNT) for i in range(COUNT)], atol=8)
    part = read(file, 0.36, 0.6)
    assert [(frame.index, frame.time_ns) for frame in part] == [(i, found[i].time_ns) for i in range(9, 15)]
    for frame in part:
        np.testing.assert_array_equal(frame.image, found[frame.index].image)


def test_a_part_is_decoded_from_the_key_frame_before_it(tmp_path):
    file = write_clip(tmp_path / "a.mp4", "libx264", level_images(COUNT), CONSTANT)
    video = Video(file, threads=1)
    decodes: list[Any] = []
    plain = video._decode
    video._decode = lambda packets, timeline: plain((decodes.append(p) or p for p in packets), timeline)  # type: ignore
    found = [frame.index for frame in video.frames(560_000_000, 600_000_000, 1, LIMIT)]
    video.close()
    assert found == [14] and len(decodes) <= 8, "of 20 packets only those from the twelfth on"


def test_a_long_video_stays_within_the_memory_of_its_decoder(tmp_path):
    """Frames that have to be turned, too, of which PyAV keeps what was asked for beside them."""
    count = 300
    times_ms = [40 * index for index in range(count)]
    file = turn(write_clip(tmp_path / "a.mp4", "libx264", level_images(count), times_ms), (0, 1, -1, 0))
    assert [frame.index for frame in read(file)] == list(range(count))


def test_every_third_frame_of_a_part(tmp_path):
    file = write_clip(tmp_path / "a.mp4", "libx264", level_images(COUNT), VARIABLE)
    assert [frame.index for frame in read(file, every=3)] == [0, 3, 6, 9, 12, 15, 18]
    assert [frame.index for frame in read(file, 0.05, 5.05, every=3)] == [2, 5, 8, 11, 14]


MATRICES = {  # where the dark quarter, upper left as it is stored, is shown: below, right
    (1, 0, 0, 1): (False, False),
    (0, 1, -1, 0): (False, True),
    (-1, 0, 0, -1): (True, True),
    (0, -1, 1, 0): (True, False),
    (-1, 0, 0, 1): (False, True),
    (0, 1, 1, 0): (False, False),
}


@pytest.mark.parametrize(("matrix", "dark"), MATRICES.items())
def test_each_display_matrix_is_obeyed(tmp_path, matrix, dark):
    images = [np.dstack([np.full((64, 96), 200, np.uint8)] * 3) for _ in range(2)]
    for image in images:
        image[:32, :48] = 0
        image[50:, :10] = (255, 0, 0)  # lower left
    file = write_clip(tmp_path / "a.mp4", "libx264", images, [0, 40], options={"crf": "1"})
    if matrix != (1, 0, 0, 1):
        turn(file, matrix)
    image = read(file)[0].image
    right, down = np.array(matrix[:2]), np.array(matrix[2:])
    expected = np.zeros_like(image)
    corner = np.minimum(right * 95, 0) + np.minimum(down * 63, 0)
    for y in range(64):
        for x in range(96):
            column, row = x * right + y * down - corner
            expected[row, column] = images[0][y, x]
    assert image.shape[:2] == ((64, 96) if matrix[0] else (96, 64))
    assert np.abs(image.astype(int) - expected).mean() < 4
    below, at_right = dark
    height, width = image.shape[:2]
    shown = image[height // 2 :] if below else image[: height // 2]
    assert (shown[:, width // 2 :] if at_right else shown[:, : width // 2])[4:20, 4:20].mean() < 20


@pytest.mark.parametrize(("aspect", "size"), [(Fraction(4, 3), (128, 64)), (Fraction(8, 9), (85, 64))])
def test_pixels_become_square_by_their_width(tmp_path, aspect, size):
    file = write_clip(tmp_path / "a.mp4", "libx264", level_images(3), [0, 40, 80], pixel_aspect=aspect)
    for frame in read(file):
        assert frame.image.shape == (size[1], size[0], 3) and frame.pixel_aspect == pytest.approx(float(aspect))
        assert (
            frame.image[8:24, : int(size[0] * 0.45)].max()
            < 30
            < 39
            <= frame.image[8:24, int(size[0] * 0.55) :].min() + 8
        )
    turn(file, (0, 1, -1, 0))
    assert read(file)[0].image.shape == (size[0], size[1], 3), "it is widened before it is turned"


def test_square_pixels_stay_as_they_are(tmp_path):
    for aspect in (Fraction(1), Fraction(1, 1000), Fraction(301, 300)):
        file = write_clip(tmp_path / "a.mp4", "libx264", level_images(2), [0, 40], pixel_aspect=aspect)
        (frame, _) = read(file)
        assert (frame.image.shape, frame.pixel_aspect) == ((64, 96, 3), 1.0)


def test_pixels_that_become_too_many_are_refused(tmp_path):
    file = write_clip(tmp_path / "a.mp4", "libx264", level_images(2), [0, 40], pixel_aspect=Fraction(2))
    with pytest.raises(VideoError, match="its frames are 192 x 64: more than 10000 pixels"):
        list(decode_video(file, 1, 10_000))


def test_a_stream_that_changes_its_size_gives_both_sizes(tmp_path):
    first = write_clip(tmp_path / "1.h264", "libx264", level_images(4), [0, 40, 80, 120])
    second = write_clip(tmp_path / "2.h264", "libx264", level_images(4, (64, 48)), [0, 40, 80, 120])
    file = tmp_path / "both.h264"
    file.write_bytes(first.read_bytes() + second.read_bytes())
    found = read(file)
    assert [frame.image.shape for frame in found] == [(64, 96, 3)] * 4 + [(48, 64, 3)] * 4
    assert [frame.index for frame in found] == list(range(8))
    assert all(before.time_ns < after.time_ns for before, after in pairwise(found))
    assert np.allclose([brightness(frame) for frame in found], [level_of(i % 4, 4) for i in range(8)], atol=8)


def test_joined_streams_go_on_where_the_clock_is_set_back(tmp_path):
    times_ms = [100 * index for index in range(COUNT)]
    clip = write_clip(tmp_path / "a.ts", "libx264", level_images(COUNT), times_ms).read_bytes()
    file = tmp_path / "both.ts"
    file.write_bytes(clip + clip)
    found = read(file)
    assert len(found) == 2 * COUNT and len({frame.index for frame in found}) == 2 * COUNT
    assert [round(frame.time_ns / 1e6) for frame in found[:COUNT]] == times_ms
    gaps = [after.time_ns - before.time_ns for before, after in pairwise(found)]
    assert min(gaps) > 0 and sum(gaps) == pytest.approx(39 * 100_000_000, abs=100_000_000)
    part = read(file, 2.95, 3.45)
    assert [(frame.index, frame.time_ns) for frame in part] == [
        (frame.index, frame.time_ns) for frame in found if 2.95 <= frame.time_ns / 1e9 < 3.45
    ]
    assert len(part) == 5


def test_a_frame_that_cannot_be_decoded_leaves_a_gap_and_is_told(tmp_path):
    file = write_clip(tmp_path / "a.mov", "mjpeg", level_images(COUNT), VARIABLE)
    with av.open(str(file)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    data = bytearray(file.read_bytes())
    for pos, size in (packets[3], packets[9]):
        data[pos : pos + size] = bytes(size)
    file.write_bytes(data)
    for from_s, left in ((0.0, [0, 1, 2, 4, 5, 6, 7, 8, *range(10, COUNT)]), (3.0, [8, *range(10, COUNT)])):
        found, error = read_to_error(file, from_s)
        assert [frame.index for frame in found] == left
        assert [round(frame.time_ns / 1e6) for frame in found] == [VARIABLE[index] for index in left]
        assert f"{2 if from_s == 0 else 1} of its packets could not be decoded: it is damaged" in error


def read_to_error(file: Path, from_s: float = 0.0) -> tuple[list[VideoFrame], str]:
    found: list[VideoFrame] = []
    with pytest.raises(VideoError) as error:
        found.extend(iter_until_error(file, from_s, found))
    return found, str(error.value)


def iter_until_error(file: Path, from_s: float, found: list[VideoFrame]) -> list[VideoFrame]:
    for frame in decode_video(file, 1, LIMIT, Span(round(from_s * 1e9))):
        found.append(frame)
    return []


@pytest.mark.parametrize("kind", ["mkv", "avi"])
def test_a_video_that_was_cut_says_so(tmp_path, kind):
    file = write_clip(tmp_path / f"a.{kind}", "mjpeg", level_images(COUNT), CONSTANT)
    with av.open(str(file)) as whole:  # how long a packet is depends on the cores that encode it
        place = [packet.pos for packet in whole.demux(video=0) if packet.size][COUNT // 2]
    assert place is not None
    file.write_bytes(file.read_bytes()[: place + 10])
    found, error = read_to_error(file)
    assert 3 < len(found) < COUNT and "it ends before the frames that it states" in error
    assert [frame.index for frame in found] == list(range(len(found)))


@pytest.mark.parametrize("begins_ms", [0, 5000])
@pytest.mark.parametrize("kind", ["mkv", "webm", "mp4"])
def test_a_late_start_and_a_long_gap_are_no_cut(tmp_path, kind, begins_ms):
    codec = "libvpx-vp9" if kind == "webm" else "libx264"
    need(codec)
    times_ms = [begins_ms + each for each in (0, 40, 80, 5000, 5040)]
    found = read(write_clip(tmp_path / f"a.{kind}", codec, level_images(5), times_ms))
    assert [round(frame.time_ns / 1e6) for frame in found] == [0, 40, 80, 5000, 5040]


def test_sound_alone_is_no_video(tmp_path):
    with pytest.raises(VideoError, match="no pictures that follow each other, but sound, data or a cover alone"):
        read(write_sound(tmp_path / "a.m4a"))


def test_a_list_of_other_files_is_no_video(tmp_path):
    write_clip(tmp_path / "a.mp4", "libx264", level_images(2), [0, 40])
    (tmp_path / "list.mp4").write_text(f"ffconcat version 1.0\nfile '{tmp_path / 'a.mp4'}'\n")
    assert read(tmp_path / "list.mp4") == []


def place_frames(packets: list[Any], frames: list[int | None]) -> list[tuple[int, int]]:
    """The index and the time in ms of frames, of a timeline that knows these packets (pts, dts)."""
    timeline = _Timeline(Fraction(1, 1000))
    for pts, dts in packets:
        timeline.add(pts, dts)
    return [(index, ns // 10**6) for index, ns in (timeline.place(pts, 40_000_000) for pts in frames)]


def test_frames_of_one_time_have_their_own_numbers():
    assert place_frames([(0, 0), (5, 5), (5, 5), (9, 9)], [0, 5, 5, 9]) == [(0, 0), (1, 5), (2, 5), (3, 9)]


def test_frames_without_times_have_those_of_decoding_or_of_the_rate():
    assert place_frames([(None, 7), (None, 107), (None, 500)], [None] * 3) == [(0, 0), (1, 100), (2, 493)]
    assert place_frames([(None, None)] * 3, [None] * 3) == [(0, 0), (1, 40), (2, 80)]


def test_a_clock_that_is_set_back_goes_on_from_the_last_frame():
    assert [ms for _, ms in place_frames([(5000, 0), (6040, 1)], [5000, 6040, 0, 40])] == [0, 1040, 1080, 1120]


def test_times_in_a_wrong_order_never_fall_and_do_not_add_up():
    frames = [40, 120, 160, 80, 240, 200, 280]
    found = place_frames([(pts, None) for pts in sorted(frames)], frames)
    assert [ms for _, ms in found] == [0, 80, 120, 120, 200, 200, 240]
    assert len({index for index, _ in found}) == len(frames)


def test_a_frame_whose_packet_comes_with_no_frame_leaves_its_number_free():
    assert place_frames([(0, 0), (3, 1), (7, 2), (20, 3)], [0, 7, 20]) == [(0, 0), (2, 7), (3, 20)]
    assert place_frames([(10, 0), (20, 1)], [20]) == [(1, 10)], (
        "the first frame cannot be decoded, and is the beginning"
    )
