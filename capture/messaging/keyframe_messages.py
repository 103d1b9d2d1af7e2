"""The messages between capture and recon: frames one way, readiness and answers the other.

A frame's message is preceded by a Delivery, which says which frame it is: what cannot be read can be refused by its
number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import zmq
from msgspec import UNSET, UnsetType

from splatnode.capture.exposure_settings import ExposureSettings
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.given_pose import GivenPose
from splatnode.capture.gravity import Gravity
from splatnode.capture.left_out import make_optional_field
from splatnode.capture.messaging.frame_arrays import arrays_of, frame_in
from splatnode.capture.messaging.spool import Key
from splatnode.capture.messaging.values import Name, Sequential, SessionId, Text
from splatnode.capture.messaging.wire import (
    Header,
    Limits,
    Message,
    Numbering,
    Part,
    WireError,
    decode,
    encode,
    plain_header,
)
from splatnode.capture.motion import Motion
from splatnode.capture.process.printable import LONGEST_NAME, LONGEST_TEXT, sanitize_text
from splatnode.capture.right_image import Baseline
from splatnode.capture.stamp import Stamp

MOST_HELD = 64  # frames that a client may hold without acknowledging them
DELIVERY_PARTS = 2  # that come before a frame's own


class FrameHeader(Header, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="frame"):
    """A Frame; its arrays are its image and, where it has these, its mask and its right image (frame_arrays.py)."""

    frame_id: Sequential
    name: Name
    stamp_ns: Sequential
    intrinsics: Intrinsics | None
    captured_at: Stamp | None = None
    # Left out where there is none: a receiver that does not know it takes all keyframes without one
    given_pose: GivenPose | UnsetType = UNSET
    motion: Motion | UnsetType = UNSET
    gravity: Gravity | UnsetType = UNSET
    exposure: ExposureSettings | UnsetType = UNSET
    baseline: Baseline | UnsetType = UNSET  # likewise; where it is there, the last array is the right image


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
    header = FrameHeader(
        **numbering.next(),
        frame_id=frame.frame_id,
        name=frame.name,
        stamp_ns=frame.stamp_ns,
        intrinsics=frame.intrinsics,
        captured_at=frame.captured_at,
        given_pose=make_optional_field(frame.given_pose),
        motion=make_optional_field(frame.motion),
        gravity=make_optional_field(frame.gravity),
        exposure=make_optional_field(frame.exposure),
        baseline=make_optional_field(frame.right and frame.right.baseline),
    )
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
