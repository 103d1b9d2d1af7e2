"""The messages between capture and recon: frames one way, readiness and answers the other.

A frame's message is preceded by a Delivery, which says which frame it is: what cannot be read can be refused by its
number.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import math
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Generic, NamedTuple, TypeVar

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
    FrameMeta,
    RightImage,
    describe_frame,
    make_optional_field,
    read_frame_fields,
)
from splatnode.capture.image_file import UnusableImage, decode_image, encode_jpeg
from splatnode.capture.process.config import Decoder, decoder_of
from splatnode.capture.process.text import LONGEST_NAME, LONGEST_TEXT, guard_untrusted, is_printable, sanitize_text

# A message: a typed header and arrays. What does not fit its schema to the last byte is refused.
#
#     [magic, version] [MessagePack: header, (dtype, shape) of each array] [raw array] [raw array] ...
#
# Arrays are little-endian and C-contiguous. Nothing in a message is executed or trusted: msgspec checks types and
# ranges, `values.check` what types do not say, dtypes come from a list, and each part must be exactly as long as its
# shape requires. Whatever is wrong with a message is a WireError.

# What a header may say: each kind of number and text with its range, and what all of them have in common.
#
# Types that msgspec checks tell the range of each field. `check` is for what types do not say: text that a terminal
# only shows, numbers that are finite, and nothing without end in a field that takes anything.

LARGEST = 2**62  # of all integers
MOST_ENTRIES = 4096  # of a sequence or a table
DEEPEST = 12  # values within values

SessionId = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{32}\Z", max_length=32)]
Sequential = Annotated[int, msgspec.Meta(ge=0, le=LARGEST)]
Count = Annotated[int, msgspec.Meta(ge=-1, le=LARGEST)]  # or a number of something, -1 where there is none yet
Finite = Annotated[float, msgspec.Meta(ge=-1e12, le=1e12)]
Amount = Annotated[float, msgspec.Meta(ge=0.0, le=1e12)]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=LONGEST_NAME)]
Text = Annotated[str, msgspec.Meta(max_length=LONGEST_TEXT)]


def check(value: object, depth: int = 0) -> None:
    """Raises ValueError where `value`, a decoded header, holds what no header may hold."""
    if isinstance(value, str):
        if not is_printable(value):
            raise ValueError(f"text must be printable and at most {LONGEST_TEXT} characters, got {value[:60]!a}")
    elif isinstance(value, int):
        if abs(value) > LARGEST:
            raise ValueError(f"numbers must be within 2**62, got {value}")
    elif isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"numbers must be finite, got {value}")
    elif value is not None and value is not msgspec.UNSET and not isinstance(value, enum.Enum):
        _check_all(_contents(value), depth + 1)


def _contents(value: object) -> list[object]:
    if isinstance(value, (list, tuple)):
        return list(value)
    if isinstance(value, Mapping):
        return [*value, *value.values()]
    if isinstance(value, msgspec.Struct):
        return [getattr(value, name) for name in value.__struct_fields__]
    if dataclasses.is_dataclass(value):
        return [getattr(value, field.name) for field in dataclasses.fields(value)]
    raise ValueError(f"a header has text and numbers, got {type(value).__name__}")


def _check_all(values: list[object], depth: int) -> None:
    if depth > DEEPEST or len(values) > 2 * MOST_ENTRIES:
        raise ValueError(f"at most {MOST_ENTRIES} values, {DEEPEST} deep, got {len(values)} at depth {depth}")
    for value in values:
        check(value, depth)


# Of the messages: 1 knew no answer to a keyframe that cannot be taken, 2 no time of capture, 3 no masks, 4 no fisheyes.
VERSION = 5
MAGIC = b"SPLAT" + bytes([VERSION])
DTYPES = {name: np.dtype(f"<{name}") for name in ("u1", "u2", "u4", "i4", "i8", "f4", "f8")}

T = TypeVar("T")
Part = bytes | memoryview


class WireError(ValueError):
    """The parts are no message of this schema; the text says what is wrong with them."""


class Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The fields of every header. A room's headers extend it; where several share a service they are tagged."""

    session: SessionId  # of the process that sends: a new one begins to count anew
    sequence: Sequential  # gaps are losses
    mono_ns: Sequential  # the sender's monotonic clock


class Numbering:
    """The first fields of the headers that one sender sends: `PreviewHeader(**numbering.next(), name=...)`."""

    def __init__(self, session: str | None = None) -> None:
        self.session = session or uuid.uuid4().hex
        self.sequence = 0  # of the next header

    def next(self) -> dict[str, Any]:
        fields = {"session": self.session, "sequence": self.sequence, "mono_ns": time.monotonic_ns()}
        self.sequence += 1
        return fields


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The largest message that a receiver decodes."""

    header_bytes: int = 1 << 20
    arrays: int = 4096
    dimensions: int = 4
    total_bytes: int = 256 << 20
    own: bool = False  # what this process wrote itself may be longer than what a stranger says, and not finite


@dataclass(frozen=True)
class Message(Generic[T]):
    header: T
    arrays: tuple[npt.NDArray, ...] = ()  # read-only; views of the received bytes where their alignment allows


class _Envelope(msgspec.Struct, Generic[T], array_like=True, forbid_unknown_fields=True):
    header: T
    arrays: list[tuple[str, list[Sequential]]]  # dtype and shape of each


def encode(header: msgspec.Struct, arrays: Sequence[npt.NDArray] = ()) -> list[Part]:
    """The parts of a message; those of contiguous arrays are views of them. Raises ValueError for other dtypes."""
    contiguous = [_little_endian(array) for array in arrays]
    table = [(array.dtype.str[1:], list(array.shape)) for array in contiguous]
    head = msgspec.msgpack.encode(_Envelope(header, table))
    return [MAGIC, head, *(array.reshape(-1).view(np.uint8).data for array in contiguous)]


def decode(parts: Sequence[Part | zmq.Frame], schema: Any, limits: Limits | None = None) -> Message[Any]:
    """The message in `parts` if its header is a `schema` (a Struct, or a union of tagged ones). Raises WireError."""
    with guard_untrusted(WireError, "a message"):
        return _decode_parts(parts, schema, limits or Limits())


def size_bytes(parts: Sequence[Part]) -> int:
    """Returns the size of a message on its way."""
    return sum(memoryview(part).nbytes for part in parts)


def plain_header(parts: Sequence[Part]) -> dict[str, Any]:
    """Returns what stands in the place of the header, of parts that need not be a message; empty where nothing does."""
    try:
        with guard_untrusted(WireError):
            return _envelope(memoryview(parts[1]), dict[str, Any]).header
    except WireError:
        return {}


def _decode_parts(parts: Sequence[Part | zmq.Frame], schema: Any, limits: Limits) -> Message[Any]:
    if len(parts) > limits.arrays + 2:
        raise WireError(f"too many parts: {len(parts)}, and {limits.arrays} arrays are allowed")
    buffers = [memoryview(part.buffer if isinstance(part, zmq.Frame) else part) for part in parts]
    if len(buffers) < 2 or buffers[0] != MAGIC:
        raise WireError(_no_message(buffers))
    total_bytes = size_bytes(buffers)
    if total_bytes > limits.total_bytes or buffers[1].nbytes > limits.header_bytes:
        raise WireError(
            f"too large: {total_bytes} bytes, {buffers[1].nbytes} of them its header; "
            f"{limits.total_bytes} and {limits.header_bytes} are allowed"
        )
    envelope = _envelope(buffers[1], schema)
    if len(envelope.arrays) != len(buffers) - 2:
        raise WireError(f"{len(envelope.arrays)} arrays announced, {len(buffers) - 2} came")
    if not limits.own:
        check(envelope.header)
    pairs = zip(envelope.arrays, buffers[2:], strict=True)
    return Message(envelope.header, tuple(_array(*entry, buffer, limits) for entry, buffer in pairs))


def _no_message(buffers: Sequence[memoryview]) -> str:
    first = bytes(buffers[0][: len(MAGIC)]) if buffers else b""
    if len(first) == len(MAGIC) and first[:-1] == MAGIC[:-1] and first != MAGIC:
        return f"a message of version {first[-1]}, and this splatnode speaks version {VERSION}: update the older one"
    return f"no message of splatnode: {len(buffers)} parts, not {MAGIC!r} first"


def _envelope(head: memoryview, schema: Any) -> _Envelope[Any]:
    decoder = _decoder(schema)
    try:
        return decoder.decode(head)
    except (ValueError, RecursionError) as error:  # msgspec's own errors are ValueErrors
        raise WireError(f"header refused: {sanitize_text(error)}") from error


@functools.lru_cache(maxsize=64)
def _decoder(schema: Any) -> Decoder:
    return decoder_of(_Envelope[schema])


def _array(name: str, shape: list[int], buffer: memoryview, limits: Limits) -> npt.NDArray:
    dtype = DTYPES.get(name)
    if dtype is None or len(shape) > limits.dimensions:
        raise WireError(f"array of dtype {name[:16]!r} with {len(shape)} dimensions refused")
    # Of an array without elements, too: what its other dimensions promise must be possible.
    if math.prod(max(1, side) for side in shape) * dtype.itemsize > limits.total_bytes:
        raise WireError(f"array {name} of shape {shape} is more than {limits.total_bytes} bytes can hold")
    if math.prod(shape) * dtype.itemsize != buffer.nbytes:
        raise WireError(f"array {name} of shape {shape} does not have {buffer.nbytes} bytes")
    array = np.frombuffer(buffer, dtype).reshape(shape)
    if not array.flags.aligned:  # a received message may begin at any address; compiled code needs an aligned one
        array = array.copy()
    array.setflags(write=False)
    return array


def _little_endian(array: npt.NDArray) -> npt.NDArray:
    contiguous = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).reshape(array.shape)
    if contiguous.dtype.str[1:] not in DTYPES:
        raise ValueError(f"arrays of {array.dtype} cannot be sent; convert to one of {', '.join(DTYPES)}")
    return contiguous


class Key(NamedTuple):
    """Identifies a keyframe: the session of the capture process, and the number in it."""

    session: str
    sequence: int


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
