"""The messages between capture and recon: frames one way, readiness and acknowledgements the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec

from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.messaging.spool import Key
from splatnode.capture.messaging.wire import Header, Message, Numbering, Part, Sequential, SessionId, WireError, encode

_LONGEST_NAME = 255  # characters, as of a file
_LONGEST_TEXT = 1000  # characters
_MOST_HELD = 64  # frames that a client may hold without acknowledging them

Name = Annotated[str, msgspec.Meta(min_length=1, max_length=_LONGEST_NAME)]
Text = Annotated[str, msgspec.Meta(max_length=_LONGEST_TEXT)]


class FrameHeader(Header, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="frame"):
    """A Frame; its image is the only array."""

    frame_id: Sequential
    name: Name
    stamp_ns: Sequential
    intrinsics: Intrinsics | None


class DroppedHeader(Header, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="dropped"):
    """A DroppedFrame: recon is told of an image that was left out."""

    name: Name
    reason: Text


class Ready(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="ready"):
    """The sender takes frames until it has `capacity` that are not acknowledged; `holding` it has received already."""

    capacity: Annotated[int, msgspec.Meta(ge=0, le=_MOST_HELD)]
    holding: Annotated[list[tuple[SessionId, Sequential]], msgspec.Meta(max_length=_MOST_HELD)]


class Acknowledge(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="acknowledge"):
    """The sender has this frame on its disk; the receiver may remove it."""

    session: SessionId
    sequence: Sequential


@dataclass(frozen=True)
class ReceivedFrame:
    session: str
    sequence: int
    frame: Frame | DroppedFrame

    @property
    def key(self) -> Key:
        return Key(self.session, self.sequence)


def to_message(frame: Frame | DroppedFrame, numbering: Numbering) -> list[Part]:
    """The parts of the message that carries `frame`, with the next number."""
    name = frame.name[-_LONGEST_NAME:]
    if isinstance(frame, DroppedFrame):
        return encode(DroppedHeader(**numbering.next(), name=name, reason=frame.reason[:_LONGEST_TEXT]))
    header = FrameHeader(
        **numbering.next(),
        frame_id=frame.frame_id,
        name=name,
        stamp_ns=frame.stamp_ns,
        intrinsics=frame.intrinsics,
    )
    return encode(header, [frame.image])


def received(message: Message) -> ReceivedFrame:
    """The frame in a decoded message. Raises WireError where what it says is not possible."""
    header = message.header
    if isinstance(header, DroppedHeader):
        if message.arrays:
            raise WireError("a dropped frame has no image")
        return ReceivedFrame(header.session, header.sequence, DroppedFrame(header.name, header.reason))
    if len(message.arrays) != 1 or min(message.arrays[0].shape, default=0) < 1:
        raise WireError("a frame has one image")
    try:
        frame = Frame(header.frame_id, header.name, header.stamp_ns, message.arrays[0], header.intrinsics)
    except ValueError as error:
        raise WireError(str(error)) from error
    return ReceivedFrame(header.session, header.sequence, frame)
