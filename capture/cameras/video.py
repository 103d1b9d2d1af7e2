"""A video file as a camera."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np

from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics, framed
from splatnode.capture.pace import Pace, paced
from splatnode.capture.process.printable import LONGEST_NAME, printable_name

_LONGEST_STEM = LONGEST_NAME - 25  # characters: the number of the frame comes behind it


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    file: Path
    every: Annotated[int, msgspec.Meta(ge=1)] = 1  # 3: every third frame; the others are not decoded
    pace: Pace = "fastest"
    intrinsics: Intrinsics | None = None  # of a calibration at the same aspect ratio


def stream(config: Config) -> Iterator[Frame | DroppedFrame]:
    """The frames at their times in the video; those that cannot be decoded are left out by the decoder, unnamed.

    Raises FileNotFoundError, or ValueError where the file is no video that can be decoded.
    """
    if not config.file.is_file():
        raise FileNotFoundError(f"no file {str(config.file)!r}; give a video, such as an MP4")
    return paced(_frames(config), config.pace)


def _frames(config: Config) -> Iterator[Frame | DroppedFrame]:
    video = cv2.VideoCapture(str(config.file), cv2.CAP_FFMPEG)
    try:
        rate = video.get(cv2.CAP_PROP_FPS)
        if not video.isOpened() or not rate > 0:
            raise ValueError(f"{str(config.file)!r} is no video that can be decoded; convert it to MP4 (H.264)")
        frame_id = index = 0
        while video.grab():
            if index % config.every == 0:
                decoded, image = video.retrieve()
                if decoded:
                    yield _frame(image, frame_id, index, rate, config)
                    frame_id += 1
            index += 1
        if frame_id == 0:
            raise ValueError(f"{str(config.file)!r} has no frame that can be decoded; is the file whole?")
    finally:
        video.release()


def _frame(image: np.ndarray, frame_id: int, index: int, rate: float, config: Config) -> Frame | DroppedFrame:
    """Stamps are counted, not read: containers with edited time lines give stamps that go back."""
    rgb = cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
    intrinsics = config.intrinsics.resized(rgb.shape[1], rgb.shape[0]) if config.intrinsics else None
    name = f"{printable_name(config.file.stem, _LONGEST_STEM)}_{index:06d}.png"
    return framed(frame_id, name, round(index / rate * 1e9), rgb, intrinsics)
