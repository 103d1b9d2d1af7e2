"""What can be configured in the capture room, with defaults and units."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import msgspec

from splatnode.capture import preview, reader, selection
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.masks import mask_frames, open_single_mask
from splatnode.capture.messaging import spool
from splatnode.capture.messaging.network import Network
from splatnode.capture.nothing_new import KeepAlive
from splatnode.capture.process.config import Plugin
from splatnode.capture.quality import Limits


class Camera(Plugin):
    """The source of frames: a module of capture/cameras."""

    package = "splatnode.capture.cameras"


class CaptureConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    camera: Camera  # where frames come from: the kinds have options of their own, below
    quality: Limits = Limits()  # which frames are usable, and no copies
    selection: selection.Config = selection.Config()
    reader: reader.Config = reader.Config()
    preview: preview.Config = preview.Config()
    spool: spool.Config = spool.Config()
    network: Network = Network()  # how the processes reach each other
    # An image of the camera's size: black is never used, as where the camera sees the robot itself; white is used
    body_mask: Path | None = None


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
