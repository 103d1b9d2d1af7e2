"""Good messages of each kind that capture's sockets know, and what can be done to them."""

from __future__ import annotations

import random
from typing import Any

import numpy as np

from splatnode.capture.config import Config as PreviewConfig
from splatnode.capture.config import PreviewHeader, encode_preview
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.messaging.messages import (
    Acknowledge,
    ConsumerStatus,
    Delivery,
    DroppedHeader,
    FrameHeader,
    Numbering,
    Ready,
    Refuse,
    Request,
    encode,
)
from splatnode.capture.messaging.pubsub import Want

LENS = Intrinsics(16, 12, 20.0, 20.0, 8.0, 6.0, "calibration", (0.1, -0.1))
IMAGE = np.random.default_rng(0).integers(0, 256, (12, 16, 3)).astype(np.uint8)
FRAME = Frame(0, "a.png", 1, IMAGE, LENS)
Parts = list[bytes]


def good_messages() -> list[tuple[Parts, Any]]:
    """One of each kind that capture's sockets send and receive, with its schema."""
    numbering = Numbering()
    frame = FrameHeader(**numbering.next(), frame_id=0, name="a.png", stamp_ns=1, intrinsics=LENS)
    dropped = DroppedHeader(**numbering.next(), name="a.png", reason="blurred")
    preview, arrays = encode_preview(
        FRAME, numbering, PreviewConfig(), state="streaming", taken=True, reason="parallax: 2%"
    )
    session = numbering.session
    messages = [
        (encode(frame, [IMAGE]), FrameHeader | DroppedHeader),
        (encode(dropped), FrameHeader | DroppedHeader),
        (encode(preview, arrays), PreviewHeader),
        (encode(Ready(session, session, 4, [(session, 1), (session, 2)], 1 << 20)), Request),
        (encode(Acknowledge(session, 7)), Request),
        (encode(Refuse(session, 7, "its stamp")), Request),
        (encode(ConsumerStatus(True, 1 << 20)), Delivery | ConsumerStatus),
        (encode(Want(session, 7)), Want),
    ]
    return [([bytes(part) for part in parts], schema) for parts, schema in messages]


def malformed(rng: random.Random, good: Parts) -> Parts:
    """A good message with one to three things done to it."""
    parts = list(good)
    for _ in range(rng.randint(1, 3)):
        rng.choice(MUTATIONS)(rng, parts)
    return parts


def flip(rng: random.Random, parts: Parts) -> None:
    index = rng.randrange(len(parts)) if parts else -1
    if index >= 0 and parts[index]:
        changed = bytearray(parts[index])
        for _ in range(rng.choice((1, 1, 2, 8))):
            changed[rng.randrange(len(changed))] = rng.choice((0, 255, 0x80, 0xC1, 0xDD, 0xDF, rng.randrange(256)))
        parts[index] = bytes(changed)


def cut(rng: random.Random, parts: Parts) -> None:
    if parts:
        index = rng.randrange(len(parts))
        parts[index] = parts[index][: rng.randrange(len(parts[index]) + 1)]


def insert(rng: random.Random, parts: Parts) -> None:
    if parts:
        index = rng.randrange(len(parts))
        at = rng.randrange(len(parts[index]) + 1)
        parts[index] = parts[index][:at] + rng.randbytes(rng.randrange(1, 9)) + parts[index][at:]


def leave_out(rng: random.Random, parts: Parts) -> None:
    if parts:
        parts.pop(rng.randrange(len(parts)))


def double(rng: random.Random, parts: Parts) -> None:
    if parts:
        parts.insert(rng.randrange(len(parts) + 1), rng.choice(parts))


def swap(rng: random.Random, parts: Parts) -> None:
    rng.shuffle(parts)


def grow(rng: random.Random, parts: Parts) -> None:
    if parts:
        parts[rng.randrange(len(parts))] = rng.randbytes(rng.choice((0, 1, 5, 100, 2000)))


def nest(rng: random.Random, parts: Parts) -> None:
    if len(parts) > 1:
        parts[1] = rng.choice((b"\x91", b"\x81\xa1a", b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff")) * 50 + parts[1]


MUTATIONS = (flip, flip, flip, cut, insert, leave_out, double, swap, grow, nest)  # mostly flipped bytes
