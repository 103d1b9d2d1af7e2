"""Previews: small JPEG images of what the camera sees now. Some may be lost on the way."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame, reduce_image
from splatnode.capture.messaging.jpeg import decode_jpeg, make_jpeg_array
from splatnode.capture.messaging.values import Name, Sequential, Text
from splatnode.capture.messaging.wire import Header, Message, Numbering, WireError
from splatnode.capture.process.printable import sanitize_text
from splatnode.capture.stamp import Stamp

_LARGEST_SIDE = 4096  # of what is decoded: a JPEG of a few bytes may ask for gigabytes


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    per_second: Annotated[float, msgspec.Meta(ge=0)] = 30.0  # previews that are sent; 0: none
    # At least so many, pixels; less than twice as many, since images are reduced by whole factors
    longer_side: Annotated[int, msgspec.Meta(ge=16, le=2048)] = 480
    jpeg_quality: Annotated[int, msgspec.Meta(ge=1, le=100)] = 75  # of the JPEG: 100 is best and largest


class PreviewHeader(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The only array is a JPEG file."""

    name: Name
    stamp_ns: Sequential
    state: Name  # of the camera: reader.State
    taken: bool  # it became a keyframe
    reason: Text  # why, or why not
    captured_at: Stamp | None = None


def encode_preview(
    frame: Frame, numbering: Numbering, config: Config, *, state: str, taken: bool, reason: str
) -> tuple[PreviewHeader, list[npt.NDArray[np.uint8]]]:
    jpeg = make_jpeg_array(reduce_image(frame.image, config.longer_side), config.jpeg_quality)
    header = PreviewHeader(
        **numbering.next(),
        name=frame.name,
        stamp_ns=frame.stamp_ns,
        state=state,
        taken=taken,
        reason=sanitize_text(reason),
        captured_at=frame.captured_at,
    )
    return header, [jpeg]


def decode_preview(message: Message[PreviewHeader]) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB. Raises WireError where the message holds no JPEG."""
    if len(message.arrays) != 1:
        raise WireError(f"a preview has one JPEG, got {len(message.arrays)} arrays")
    return decode_jpeg(message.arrays[0], _LARGEST_SIDE)
