"""A keyframe of a checkpoint, in a file of its own: frames/<number>.frame."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import msgspec
from msgspec import UNSET, UnsetType

from splatnode.capture.exposure_settings import ExposureSettings
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.given_pose import GivenPose
from splatnode.capture.gravity import Gravity
from splatnode.capture.left_out import make_optional_field
from splatnode.capture.messaging.frame_arrays import arrays_of, frame_in
from splatnode.capture.messaging.message_file import read_message, write_message
from splatnode.capture.messaging.wire import WireError, decode, encode
from splatnode.capture.motion import Motion
from splatnode.capture.right_image import Baseline
from splatnode.capture.stamp import Stamp
from splatnode.recon.daemon.checkpoint.ledger import LIMITS, VERSION, is_readable

FILE = re.compile(r"[0-9]{12,18}\.frame")


class FrameRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A stored keyframe; its arrays are its image and, where it has these, its mask and its right image."""

    version: int
    session: str
    sequence: int
    name: str
    stamp_ns: int
    intrinsics: Intrinsics | None
    captured_at: Stamp | None = None
    given_pose: GivenPose | UnsetType = UNSET  # left out where there is none, as in a message; and those below
    motion: Motion | UnsetType = UNSET
    gravity: Gravity | UnsetType = UNSET
    exposure: ExposureSettings | UnsetType = UNSET
    baseline: Baseline | UnsetType = UNSET


@dataclass(frozen=True, eq=False)
class StoredFrame:
    number: int
    key: tuple[str, int]  # session and sequence
    frame: Frame  # its frame_id is the number


def file_name(number: int) -> str:
    return f"{number:012d}.frame"


def write_frame(path: Path, key: tuple[str, int], frame: Frame) -> None:
    """Whole or not at all; `key` is its session and sequence. Raises OSError."""
    moved = make_optional_field(frame.given_pose), make_optional_field(frame.motion), make_optional_field(frame.gravity)
    baseline = make_optional_field(frame.right and frame.right.baseline)
    known = frame.name, frame.stamp_ns, frame.intrinsics, frame.captured_at
    header = FrameRecord(VERSION, *key, *known, *moved, make_optional_field(frame.exposure), baseline)
    write_message(path, encode(header, arrays_of(frame)))


def read_frame(path: Path) -> StoredFrame:
    """The keyframe in a file that is named by its number. Raises OSError and ValueError."""
    number, message = int(path.stem), decode(read_message(path), FrameRecord, LIMITS)
    header = message.header
    if not is_readable(header.version):
        raise WireError(f"frame {number} is of version {header.version}")
    return StoredFrame(number, (header.session, header.sequence), frame_in(header, number, message.arrays))
