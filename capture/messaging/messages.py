"""The messages between capture and recon: frames one way, readiness and answers the other.

A frame's message is preceded by a Delivery, which says which frame it is: what cannot be read can be refused by its
number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt
import zmq
from msgspec import UNSET, UnsetType

from splatnode.capture.depth_image import DepthMeta, depth_arrays, describe_depth, read_depth
from splatnode.capture.frame import (
    Baseline,
    DroppedFrame,
    Frame,
    RightImage,
    make_optional_field,
)
from splatnode.capture.frame_meta import FrameMeta, describe_frame, read_frame_fields
from splatnode.capture.image_file import UnusableImage, decode_image, encode_jpeg
from splatnode.capture.messaging.spool import Key
from splatnode.capture.messaging.wire import (
    Header,
    Limits,
    Message,
    Name,
    Numbering,
    Part,
    Sequential,
    SessionId,
    Text,
    WireError,
    decode,
    encode,
    plain_header,
)
from splatnode.capture.process.text import LONGEST_NAME, LONGEST_TEXT, sanitize_text

# The pixels of a frame as arrays of a message: its image, then, where it has these, its mask, its right image and its
# depth image.

Array = npt.NDArray[np.generic]


class StoredFrameMeta(FrameMeta, frozen=True, kw_only=True):
    """FrameMeta, the baseline of a right image, and what a depth image is. Their arrays are the last ones, in order."""

    baseline: Baseline | UnsetType = UNSET
    depth: DepthMeta | UnsetType = UNSET


def describe_stored_frame(frame: Frame) -> dict[str, Any]:
    """Returns the fields of StoredFrameMeta by name."""
    return {
        **describe_frame(frame),
        "baseline": make_optional_field(frame.right and frame.right.baseline),
        "depth": UNSET if frame.depth is None else describe_depth(frame.depth),
    }


def arrays_of(frame: Frame) -> list[Array]:
    """The image (H, W, 3), the mask (H, ceil(W / 8)), first pixel in the highest bit, the right image (H, W), the depth
    image (h, w), and its confidence (h, w)."""
    mask = [] if frame.mask is None else [np.packbits(frame.mask, axis=1)]
    right = [] if frame.right is None else [frame.right.image]
    return [frame.image, *mask, *right, *([] if frame.depth is None else depth_arrays(frame.depth))]


def frame_in(header: StoredFrameMeta, frame_id: int, arrays: Sequence[npt.NDArray]) -> Frame:
    """The frame of which `arrays_of` gave the arrays; it has a right image if its header tells a baseline.

    And a depth image if its header describes one.

    Raises ValueError where they are not that: the mask's and the right image's size must be the image's.
    """
    depth = None
    if header.depth is not UNSET:
        arrays, beside = arrays[: -header.depth.num_arrays], arrays[-header.depth.num_arrays :]
        depth = read_depth(header.depth, list(beside))
    rights = 0 if header.baseline is UNSET else 1
    if len(arrays) - rights not in (1, 2):
        also = ", with a baseline one right image" if rights else ""
        raise ValueError(f"a frame has one image and at most one mask{also}; got {len(arrays)} arrays")
    image, masks = arrays[0], arrays[1 : len(arrays) - rights]
    return Frame(
        frame_id,
        header.name,
        header.stamp_ns,
        image,
        mask=_mask(image, masks[0]) if masks else None,
        right=None if header.baseline is UNSET else RightImage(arrays[-1], header.baseline),
        depth=depth,
        **read_frame_fields(header),
    )


def _mask(image: npt.NDArray, bits: npt.NDArray) -> npt.NDArray[np.bool_]:
    height, width = image.shape[:2] if image.ndim >= 2 else (0, 0)
    if bits.dtype != np.uint8 or bits.shape != (height, (width + 7) // 8):
        raise ValueError(
            f"the mask of an image {width} x {height} must be ({height}, {(width + 7) // 8}) uint8, a bit a pixel, "
            f"got {bits.shape} {bits.dtype}"
        )
    return np.unpackbits(bits, axis=1, count=width).astype(bool)


MOST_HELD = 64  # frames that a client may hold without acknowledging them
DELIVERY_PARTS = 2  # that come before a frame's own


class FrameHeader(StoredFrameMeta, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="frame"):
    """A Frame; its arrays are its image and, where it has these, its mask, its right image and its depth image."""

    session: SessionId  # these three as every Header has them
    sequence: Sequential
    mono_ns: Sequential
    frame_id: Sequential


class DroppedHeader(Header, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="dropped"):
    """A DroppedFrame: recon is told of an image that was left out."""

    name: Name
    reason: Text


class Delivery(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="delivery"):
    """The rest of this message is that frame."""

    session: SessionId
    sequence: Sequential


class ConsumerStatus(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="served"):
    """capture's answer to Ready: whether this recon gets its keyframes, or another one does."""

    served: bool
    message_bytes: Sequential  # of the largest keyframe that capture sends


class Ready(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="ready"):
    """The sender takes frames until it has `capacity` that are not acknowledged; `holding` it has received already."""

    recon: SessionId  # its checkpoint, which a restarted process has from the one before
    process: SessionId
    capacity: Annotated[int, msgspec.Meta(ge=0, le=MOST_HELD)]
    holding: Annotated[list[tuple[SessionId, Sequential]], msgspec.Meta(max_length=MOST_HELD)]
    message_bytes: Sequential  # of the largest keyframe that it can take


class Acknowledge(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="acknowledge"):
    """The sender has this frame on its disk; the receiver may remove it."""

    session: SessionId
    sequence: Sequential


class Refuse(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="refuse"):
    """The sender cannot take this frame, now or later; the receiver may set it aside."""

    session: SessionId
    sequence: Sequential
    reason: Text


Request = Ready | Acknowledge | Refuse


@dataclass(frozen=True)
class ReceivedFrame:
    session: str
    sequence: int
    frame: Frame | DroppedFrame

    @property
    def key(self) -> Key:
        return Key(self.session, self.sequence)


def encode_frame(frame: Frame | DroppedFrame, numbering: Numbering) -> list[Part]:
    """The parts of the message that carries `frame`, with the next number."""
    if isinstance(frame, DroppedFrame):
        name = sanitize_text(frame.name, LONGEST_NAME) or "?"
        return encode(DroppedHeader(**numbering.next(), name=name, reason=sanitize_text(frame.reason, LONGEST_TEXT)))
    header = FrameHeader(**numbering.next(), frame_id=frame.frame_id, **describe_stored_frame(frame))
    return encode(header, arrays_of(frame))


def add_delivery(key: Key, message: list[Part]) -> list[Part]:
    """The message with the Delivery that precedes it."""
    return [*encode(Delivery(*key)), *message]


def decode_frame(key: Key, parts: list[zmq.Frame], limits: Limits) -> ReceivedFrame:
    """The frame in what followed a Delivery. Raises WireError where it is none, or another one."""
    message: Message[FrameHeader | DroppedHeader] = decode(parts, FrameHeader | DroppedHeader, limits)
    header = message.header
    if (header.session, header.sequence) != key:
        raise WireError(f"frame {header.sequence} was delivered as frame {key.sequence}")
    if isinstance(header, DroppedHeader):
        if message.arrays:
            raise WireError("a dropped frame has no image")
        return ReceivedFrame(*key, DroppedFrame(header.name, header.reason))
    try:
        return ReceivedFrame(*key, frame_in(header, header.frame_id, message.arrays))
    except ValueError as error:
        raise WireError(str(error)) from error


def name_in(parts: list[Part]) -> str:
    """The name in a message that need not be a frame's; a question mark where it does not tell."""
    return sanitize_text(plain_header(parts).get("name", "?"), LONGEST_NAME) or "?"


# Photographs in messages: JPEG files, with a bound on what a sender may have the receiver decode.


def make_jpeg_array(image: npt.NDArray[np.uint8], quality: int) -> npt.NDArray[np.uint8]:
    """`image` (H, W, 3) RGB as the bytes (N,) of a JPEG file; `quality` is 1 to 100."""
    return np.frombuffer(encode_jpeg(image, quality), np.uint8)


def decode_jpeg(jpeg: npt.NDArray, largest_side: int) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB. Raises WireError where it is no JPEG, or one with a side of more than `largest_side` pixels."""
    if jpeg.dtype != np.uint8 or jpeg.ndim != 1 or jpeg.size == 0:
        raise WireError(f"a photograph must be the bytes of a JPEG file, got {jpeg.dtype} {jpeg.shape}")
    try:
        image = decode_image(jpeg.tobytes(), largest_side**2)[0]
    except UnusableImage as error:
        raise WireError(f"a photograph that cannot be shown: {error}") from error
    if max(image.shape) > largest_side:
        raise WireError(f"a photograph must be at most {largest_side} pixels long, got {image.shape}")
    return image
