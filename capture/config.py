"""What can be configured in the capture room, with defaults and units."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture import keyframe_selection, reader
from splatnode.capture.frame import DroppedFrame, Frame, KeepAlive, Stamp, reduce_image, rigid_problem
from splatnode.capture.keyframe_selection import Limits
from splatnode.capture.masks import mask_frames, open_single_mask
from splatnode.capture.messaging import keyframe_queue
from splatnode.capture.messaging.messages import (
    Header,
    Message,
    Name,
    Numbering,
    Sequential,
    Text,
    WireError,
    decode_jpeg,
    make_jpeg_array,
)
from splatnode.capture.messaging.network import CaptureId, Network
from splatnode.capture.process import plugins
from splatnode.capture.process.config import Plugin
from splatnode.capture.process.former_names import CAPTURE_KEYS
from splatnode.capture.process.text import LONGEST_NAME, sanitize_text

# Previews: small JPEG images of what the camera sees now. Some may be lost on the way.

_LARGEST_SIDE = 4096  # of what is decoded: a JPEG of a few bytes may ask for gigabytes


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Previews: small JPEG images of what the camera sees now. Some may be lost on the way."""

    fps: Annotated[float, msgspec.Meta(ge=0)] = 30.0  # previews that are sent; 0: none
    # At least so many, pixels; less than twice as many, since images are reduced by whole factors
    longer_side: Annotated[int, msgspec.Meta(ge=16, le=2048)] = 480
    jpeg_quality: Annotated[int, msgspec.Meta(ge=1, le=100)] = 75  # of the JPEG: 100 is best and largest


class PreviewHeader(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The only array is a JPEG file."""

    name: Name
    stamp_ns: Sequential
    state: Name  # of the camera: reader.ReaderState
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


# Where a camera stands on the robot's base.

Row: TypeAlias = tuple[float, float, float, float]
Mount: TypeAlias = tuple[Row, Row, Row, Row]


def check_mount(T_base_camera: Mount | None) -> None:
    """Raises ValueError where the matrix is no rigid motion in metres."""
    if T_base_camera is not None and (problem := rigid_problem([number for row in T_base_camera for number in row])):
        raise ValueError(f"the mount T_base_camera must be {problem}")


def mount_camera(
    opened: Callable[[], Iterator[Frame | DroppedFrame | KeepAlive]], T_base_camera: Mount | None
) -> Callable[[], Iterator[Frame | DroppedFrame | KeepAlive]]:
    """The camera, whose frames tell where it stands on the base; as it is where nobody knows."""
    if T_base_camera is None:
        return opened
    numbers = tuple(number for row in T_base_camera for number in row)

    def stream() -> Iterator[Frame | DroppedFrame | KeepAlive]:
        for item in opened():
            yield replace(item, T_base_camera=numbers) if isinstance(item, Frame) else item

    return stream


class Camera(Plugin):
    """The source of frames: a module of capture/cameras, or one that is installed beside it."""

    package = "splatnode.capture.cameras"
    group = plugins.CAMERAS
    needs = ("Config", "stream")


class ProgramConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Configures what a program of one's own sends in place of a camera: as CaptureConfig has it, without a camera."""

    former_keys = CAPTURE_KEYS

    quality: Limits = Limits()
    selection: keyframe_selection.Config = keyframe_selection.Config()
    preview: Config = Config()
    spool: keyframe_queue.SpoolConfig = keyframe_queue.SpoolConfig()
    network: Network = Network()
    camera_id: CaptureId = ""
    T_base_camera: Mount | None = None

    def __post_init__(self) -> None:
        check_mount(self.T_base_camera)


class CaptureConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All that can be configured in the capture room, with defaults and units."""

    former_keys = CAPTURE_KEYS

    camera: Camera  # where frames come from: the kinds have options of their own, below
    quality: Limits = Limits()  # which frames are usable, and no copies
    selection: keyframe_selection.Config = keyframe_selection.Config()
    reader: reader.Config = reader.Config()
    preview: Config = Config()
    spool: keyframe_queue.SpoolConfig = keyframe_queue.SpoolConfig()
    network: Network = Network()  # how the processes reach each other
    # An image of the camera's size: black is never used, as where the camera sees the robot itself; white is used
    body_mask: Path | None = None
    # Of this capture, where several run beside one recon: letters, digits, - and _. Frames of several that were taken
    # at one time form a frame set
    camera_id: CaptureId = ""
    # Where the camera stands on the robot's base: four rows of four numbers, metres; p_base = T_base_camera @ p_camera.
    # Camera: x right, y down, z forward. Base: x forward, y left, z up. Recon's metric.frame: base needs it
    T_base_camera: Mount | None = None

    def __post_init__(self) -> None:
        check_mount(self.T_base_camera)


def camera_opener(
    camera: Camera, body_mask: Path | None = None
) -> Callable[[], Iterator[Frame | DroppedFrame | KeepAlive]]:
    """Opens the camera that is configured, and opens it again after a loss; without what `body_mask` hides.

    What it returns raises CameraUnavailable, when it is called or later; UnusableMask, FileNotFoundError.
    """
    remembering = getattr(camera.module, "opener", None)
    opened = partial(camera.module.stream, camera.config) if remembering is None else remembering(camera.config)
    return opened if body_mask is None else lambda: mask_frames(opened(), open_single_mask(body_mask))


def is_live(camera: Camera) -> bool:
    """Whether the camera goes on when nobody reads. Of a live camera the newest frames are read, of a recording all."""
    return getattr(camera.module, "LIVE", False)


def name_camera(
    opened: Callable[[], Iterator[Frame | DroppedFrame | KeepAlive]], camera_id: str
) -> Callable[[], Iterator[Frame | DroppedFrame | KeepAlive]]:
    """The camera, whose frames carry the id, also in their names; as it is for an empty one."""
    if not camera_id:
        return opened

    def stream() -> Iterator[Frame | DroppedFrame | KeepAlive]:
        for item in opened():
            if isinstance(item, KeepAlive):
                yield item
                continue
            named = replace(item, name=f"{camera_id}_{item.name}"[:LONGEST_NAME])
            yield replace(named, camera_id=named.camera_id or camera_id) if isinstance(named, Frame) else named

    return stream
