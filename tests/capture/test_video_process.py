"""What a video may make its decoder do: take the memory of its limit, or end; never more, and never with us."""

from __future__ import annotations

import itertools
import resource
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode.capture.cameras.video import Config, stream
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.video_process import BASE_BYTES, BYTES_A_PIXEL, Span, VideoError, VideoFrame, decode_video
from tests.support.crafted import Crafted, videos
from tests.support.crafted.bounded import MARGIN, readings

LIMIT = 1_000_000  # pixels


def read(file: Crafted) -> str:
    """For the process that reads the corpus: what came, and the largest memory of a decoder so far."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, file.name)
        path.write_bytes(file.data)
        try:
            items = list(stream(Config(path, max_pixels=LIMIT)))
        except ValueError as error:
            assert file.name in str(error)
            items = [DroppedFrame(file.name, str(error))]
    taken = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    assert taken < BASE_BYTES + BYTES_A_PIXEL * LIMIT + MARGIN
    assert all(item.image.shape == (48, 64, 3) for item in items if isinstance(item, Frame))
    return " ".join(type(item).__name__ for item in items)


def test_every_crafted_video_is_refused_or_its_frames_have_one_size_in_bounded_memory():
    found = {reading.name: reading for reading in readings("tests.support.crafted:videos", f"{__name__}:read")}
    for reading in found.values():
        assert set(reading.outcome.split()) <= {"Frame", "DroppedFrame"}, reading
        assert reading.taken < MARGIN, reading
    refused = {"large.avi", "hidden.avi", "png.avi", "raw.avi"}
    refused |= {file.name for file in videos() if file.name.endswith(".mp4")}
    assert {name for name, reading in found.items() if reading.outcome == "DroppedFrame"} >= refused
    for name in ("container.avi", "fast.avi", "slow.avi"):  # of any size and rate that the container says
        assert found[name].outcome == "Frame Frame Frame"


def test_the_limit_is_named(tmp_path):
    large = next(file for file in videos() if file.name == "large.avi")
    (tmp_path / "a.avi").write_bytes(large.data)
    with pytest.raises(VideoError, match="a.avi.*its frames are 8000 x 8000: more than 1000000 pixels"):
        next(stream(Config(tmp_path / "a.avi", max_pixels=LIMIT)))


def test_a_decoder_ends_with_its_reader(tmp_path):
    small = next(file for file in videos() if file.name == "container.avi")
    (tmp_path / "a.avi").write_bytes(small.data)
    before = _children()
    frames = decode_video(tmp_path / "a.avi", 1, LIMIT)
    assert next(frames).image.shape == (48, 64, 3)
    assert _children() - before
    del frames
    assert not _children() - before


def test_a_decoder_that_ends_early_is_told_after_the_frames_before(tmp_path, monkeypatch):
    small = next(file for file in videos() if file.name == "container.avi")
    (tmp_path / "a.avi").write_bytes(small.data)

    def failing(*_):
        frames = decode_video(tmp_path / "a.avi", 1, LIMIT)
        yield from itertools.islice(frames, 2)
        raise VideoError("its decoder ended (-11)")

    monkeypatch.setattr("splatnode.capture.cameras.video.decode_video", failing)
    items = list(stream(Config(tmp_path / "a.avi")))
    assert [item.name for item in items] == ["a_000000.png", "a_000001.png", "a_rest"]
    assert items[2] == DroppedFrame("a_rest", "its decoder ended (-11)")


@pytest.mark.parametrize(
    ("span", "whole"), [(Span(), False), (Span(to_ns=250_000_000), True)], ids=["all", "before the cut"]
)
def test_a_video_that_was_cut_is_told_after_its_frames(tmp_path, span, whole):
    writer = cv2.VideoWriter(str(tmp_path / "whole.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20, (64, 48))
    for index in range(40):
        writer.write(np.full((48, 64, 3), 5 * index, np.uint8))
    writer.release()
    data = (tmp_path / "whole.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: len(data) // 2])
    found = list(until_error(decode_video(tmp_path / "cut.avi", 1, LIMIT, span)))
    errors = [item for item in found if isinstance(item, VideoError)]
    count = len(found) - len(errors)
    assert count == 5 if whole else 5 < count < 36
    assert [str(error) for error in errors] == ([] if whole else [
        "it ends before the frames that it states: it is cut, or damaged there"
    ])  # fmt: skip


def until_error(frames: Iterator[VideoFrame]) -> Iterator[VideoFrame | VideoError]:
    try:
        yield from frames
    except VideoError as error:
        yield error


def test_frames_pass_unchanged(tmp_path):
    """Of a video without losses."""
    frames = np.random.default_rng(0).integers(0, 255, (2, 48, 64, 3), np.uint8)
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"FFV1"), 20, (64, 48))
    for frame in frames:
        writer.write(frame)
    writer.release()
    found = [frame.image[:, :, ::-1] for frame in decode_video(tmp_path / "a.avi", 1, LIMIT)]
    np.testing.assert_array_equal(found, frames)


def _children() -> set[str]:
    path = Path("/proc/self/task")
    return {child for task in path.iterdir() for child in (task / "children").read_text().split()}
