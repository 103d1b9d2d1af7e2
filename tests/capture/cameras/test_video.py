"""Video files and the pace of recordings."""

from __future__ import annotations

import time
from fractions import Fraction
from typing import Any

import cv2
import numpy as np
import pytest

from splatnode.capture.cameras import folder
from splatnode.capture.cameras.video import Config, stream
from splatnode.capture.frame import Clock, DroppedFrame, Frame, Intrinsics, Stamp, pace_frames
from tests.support.clips import level_images, turn, write_clip, write_sound


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Twelve frames that get bluer, twenty a second."""
    file = tmp_path_factory.mktemp("video") / "walk.mp4"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 20, (160, 120))
    for index in range(12):
        writer.write(np.full((120, 160, 3), (20 * index, 100, 50), np.uint8))
    writer.release()
    return file


def test_frames_at_their_times(walk):
    lens = Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0, "calibration")
    frames: list[Any] = list(stream(Config(walk, intrinsics=lens)))
    assert [frame.stamp_ns for frame in frames] == [index * 50_000_000 for index in range(12)]
    assert [frame.name for frame in frames][-1] == "walk_000011.png"
    assert np.allclose([frame.image[60, 80, 2] for frame in frames], 20 * np.arange(12), atol=6)
    assert frames[0].intrinsics == lens.resized(160, 120)
    assert frames[-1].captured_at == Stamp(550_000_000, Clock.RECORDING)


def test_a_lens_of_another_aspect_ratio_is_refused(walk):
    with pytest.raises(ValueError, match="aspect ratio, got those of 320 x 180 for 160 x 120"):
        list(stream(Config(walk, intrinsics=Intrinsics(320, 180, 300.0, 300.0, 160.0, 90.0, "calibration"))))


def test_a_lens_is_that_of_frames_as_they_are_shown(tmp_path, caplog):
    """Of pixels that are not square it has the width that frames get, and of a video on its side its upright size."""
    file = write_clip(tmp_path / "a.mp4", "libx264", level_images(2), [0, 40], pixel_aspect=Fraction(4, 3))
    shown = Intrinsics(256, 128, 300.0, 300.0, 128.0, 64.0, "calibration")
    frames: list[Any] = list(stream(Config(file, intrinsics=shown)))
    assert [(frame.width, frame.height) for frame in frames] == [(128, 64)] * 2
    assert [frame.intrinsics for frame in frames] == [shown.resized(128, 64)] * 2
    assert "event=pixels_made_square" in caplog.text and "1.333 times as wide as high" in caplog.text
    stored = Intrinsics(96, 64, 100.0, 100.0, 48.0, 32.0, "calibration")
    with pytest.raises(ValueError, match="aspect ratio, got those of 96 x 64 for 128 x 64"):
        list(stream(Config(file, intrinsics=stored)))
    turn(file, (0, 1, -1, 0))
    with pytest.raises(ValueError, match="aspect ratio, got those of 256 x 128 for 64 x 128"):
        list(stream(Config(file, intrinsics=shown)))


def test_where_the_size_changes_the_lens_is_that_of_frames_of_its_shape(tmp_path):
    """A frame of another shape has none: nobody knows what was cut off."""
    clips = [
        write_clip(tmp_path / f"{index}.h264", "libx264", level_images(2, size), [0, 40])
        for index, size in enumerate([(96, 64), (48, 32), (64, 64)])
    ]
    file = tmp_path / "a.h264"
    file.write_bytes(b"".join(clip.read_bytes() for clip in clips))
    lens = Intrinsics(96, 64, 100.0, 100.0, 48.0, 32.0, "calibration")
    frames: list[Any] = list(stream(Config(file, intrinsics=lens)))
    assert [(frame.width, frame.height) for frame in frames[::2]] == [(96, 64), (48, 32), (64, 64)]
    assert [frame.intrinsics for frame in frames[::2]] == [lens, lens.resized(48, 32), None]
    assert len({frame.name for frame in frames}) == 6


def test_damage_is_named_behind_the_frames(tmp_path):
    file = write_clip(tmp_path / "a.avi", "mjpeg", level_images(20), [40 * index for index in range(20)])
    data = file.read_bytes()
    file.write_bytes(data[: data.index(b"idx1") * 6 // 10])
    *frames, last = stream(Config(file))
    assert 2 < len(frames) < 18 and all(isinstance(frame, Frame) for frame in frames)
    assert last == DroppedFrame("a_rest", "it ends before the frames that it states: it is cut, or damaged there")


def test_sound_alone_says_so(tmp_path):
    with pytest.raises(ValueError, match=r"a.m4a' is no video that can be used: it has no pictures that follow each"):
        list(stream(Config(write_sound(tmp_path / "a.m4a"))))


def test_some_of_the_frames(walk):
    frames: list[Any] = list(stream(Config(walk, stride=5)))
    assert [(frame.frame_id, frame.name) for frame in frames] == [
        (0, "walk_000000.png"),
        (1, "walk_000005.png"),
        (2, "walk_000010.png"),
    ]
    assert frames[2].stamp_ns == 500_000_000


@pytest.mark.parametrize("content", [b"", b"no video", None])
def test_what_is_no_video_says_so(tmp_path, walk, content):
    file = tmp_path / "x.mp4"
    file.write_bytes(walk.read_bytes()[:400] if content is None else content)
    with pytest.raises(ValueError, match="no video|no frame"):
        list(stream(Config(file)))
    with pytest.raises(FileNotFoundError, match="give a video"):
        stream(Config(tmp_path / "nowhere.mp4"))


def frame(stamp_ns):
    return Frame(0, "a", stamp_ns, np.zeros((2, 2, 3), np.uint8), None)


def test_the_recorded_pace():
    items = [DroppedFrame("x", "blurred"), frame(10**12), frame(10**12 + 50_000_000), frame(10**12 + 150_000_000)]
    start = time.monotonic()
    assert list(pace_frames(items, "recorded")) == items
    assert time.monotonic() - start >= 0.15
    hour = [frame(10**12), frame(10**12 + 3600 * 10**9)]
    start = time.monotonic()
    assert list(pace_frames(hour, "fastest")) == hour
    assert time.monotonic() - start < 60


def test_a_folder_can_be_shown_again_and_again(tmp_path):
    for index in range(2):
        image = np.random.default_rng(index).integers(0, 256, (48, 64, 3)).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"{index}.png"), image)
    (tmp_path / "9.jpg").write_bytes(b"")
    items = list(folder.stream(folder.Config(tmp_path, loops=2, fps=4)))
    assert [item.name for item in items] == ["0.png", "1.png", "9.jpg", "loop1_0.png", "loop1_1.png", "loop1_9.jpg"]
    frames = [item for item in items if isinstance(item, Frame)]
    assert [item.frame_id for item in frames] == [0, 1, 2, 3]
    assert [item.stamp_ns for item in frames] == [0, 250_000_000, 500_000_000, 750_000_000]
    assert np.array_equal(frames[0].image, frames[2].image)
