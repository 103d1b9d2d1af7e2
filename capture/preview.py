"""Small pictures of what the camera sees now, for the eye: they may get lost."""

from __future__ import annotations

from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from capture.frame import Frame, reduced
from capture.image_file import UnusableImage, decode_image
from capture.messaging.wire import Header, Message, Numbering, WireError

_LARGEST_SIDE = 4096  # of what is decoded: a JPEG of a few bytes may ask for gigabytes


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    per_second: Annotated[float, msgspec.Meta(ge=0)] = 30.0  # 0: none
    longer_side: Annotated[int, msgspec.Meta(ge=16, le=2048)] = 480  # at least; less than twice as many
    jpeg_quality: Annotated[int, msgspec.Meta(ge=1, le=100)] = 75


class PreviewHeader(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The only array is a JPEG file."""

    name: str
    stamp_ns: int
    state: str  # of the camera: reader.State
    taken: bool  # it became a key frame
    reason: str  # why, or why not


def encode_preview(
    frame: Frame, numbering: Numbering, config: Config, *, state: str, taken: bool, reason: str
) -> tuple[PreviewHeader, list[npt.NDArray[np.uint8]]]:
    small = reduced(frame.image, config.longer_side)
    options = [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality]
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), options)
    header = PreviewHeader(
        **numbering.next(), name=frame.name, stamp_ns=frame.stamp_ns, state=state, taken=taken, reason=reason
    )
    return header, [np.asarray(jpeg, np.uint8).ravel()]


def decode_preview(message: Message[PreviewHeader]) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB. Raises WireError where the message holds no JPEG."""
    if len(message.arrays) != 1 or message.arrays[0].size == 0 or message.arrays[0].dtype != np.uint8:
        raise WireError("a preview has one JPEG")
    try:
        return decode_image(message.arrays[0].tobytes(), _LARGEST_SIDE**2)[0]
    except UnusableImage as error:
        raise WireError(f"a preview that cannot be shown: {error}") from error
