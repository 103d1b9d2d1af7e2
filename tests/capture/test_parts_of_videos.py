"""A part of a video is read without what lies before it, and its frames are those of reading it all, to the bit."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode.capture import video_process
from splatnode.capture.video_process import Span, VideoFrame

RATE, LENGTH = 30, 120


class Counted:
    """A video that counts the frames that are asked for; `timed`: whether it tells their times."""

    def __init__(self, file: Path, timed: bool = True) -> None:
        self._video, self._timed = cv2.VideoCapture(str(file), cv2.CAP_FFMPEG), timed
        self.grabbed = 0

    def grab(self) -> bool:
        self.grabbed += 1
        return self._video.grab()

    def get(self, what: int) -> float:
        return self._video.get(what) if self._timed or what != cv2.CAP_PROP_POS_MSEC else 0.0

    def __getattr__(self, name: str):
        return getattr(self._video, name)


def images() -> list[np.ndarray]:
    coarse = np.random.default_rng(0).integers(0, 256, (9, 12, 3), dtype=np.uint8)
    wide = cv2.resize(coarse, (96, 64), interpolation=cv2.INTER_CUBIC)
    return [np.ascontiguousarray(np.roll(wide, 2 * index, axis=1)) for index in range(LENGTH)]


def by_opencv(file: Path) -> None:
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), RATE, (96, 64))
    for image in images():
        writer.write(image)
    writer.release()


def by_av(file: Path) -> None:
    """Frames that refer to later ones, and one alone that refers to none."""
    av = pytest.importorskip("av", reason="needs PyAV")
    with av.open(str(file), "w") as container:
        stream = container.add_stream("h264", rate=RATE, options={"g": "250", "bf": "3"})
        stream.height, stream.width, stream.pix_fmt = 64, 96, "yuv420p"
        for image in images():
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))


@pytest.fixture(scope="module", params=[by_opencv, by_av])
def film(request, tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("film") / "film.mp4"
    request.param(file)
    return file


def read(film: Path, first: int, end: int, timed: bool = True) -> tuple[list[VideoFrame], int]:
    """The frames, and how many were asked for."""
    out, opened = io.BytesIO(), list[Counted]()

    def again() -> Counted:
        opened.append(Counted(film, timed))
        return opened[-1]

    span = Span(first / RATE, end / RATE)
    video_process._write_by_opencv(out, again(), again, 1, 10_000, span)  # pyright: ignore[reportArgumentType]
    out.seek(0)
    return list(video_process._received(out, 10_000)), sum(video.grabbed for video in opened)


def whole(film: Path) -> list[np.ndarray]:
    video = cv2.VideoCapture(str(film), cv2.CAP_FFMPEG)
    return [video.read()[1] for _ in range(LENGTH)]


def check(found: list[VideoFrame], every: list[np.ndarray], first: int) -> None:
    assert [frame.index for frame in found] == list(range(first, first + 6))
    for frame in found:
        np.testing.assert_array_equal(frame.image, every[frame.index])


def test_a_part_is_sought_and_its_frames_are_the_same(film):
    every = whole(film)
    for first in (0, 5, 11, 40, 77, LENGTH - 6):
        found, asked = read(film, first, first + 6)
        check(found, every, first)
        assert asked <= 6 + 12, "what lies before it is not asked for"


def test_where_times_tell_nothing_it_is_read_from_the_beginning(film):
    found, asked = read(film, 77, 83, timed=False)
    check(found, whole(film), 77)
    assert asked > 83
