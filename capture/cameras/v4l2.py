"""A UVC webcam, or any other Video4Linux2 camera."""

from __future__ import annotations

import errno
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture import v4l2_device
from splatnode.capture.frame import CameraUnavailable, DroppedFrame, Frame, Intrinsics, make_frame, wall_clock
from splatnode.capture.image_file import UnusableImage, decode_image
from splatnode.capture.lens_file import check_fits
from splatnode.capture.pace import FramesPerSecond
from splatnode.capture.process.system import raise_shortage
from splatnode.capture.v4l2_device import Device, Format, RawFrame, System

LIVE = True

_BY_ID, _BY_PATH = Path("/dev/v4l/by-id"), Path("/dev/v4l/by-path")


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    device: str = (
        ""  # as `splatnode list-cameras` prints it: a name that stays when ports and numbers change; "": the only one
    )
    width: Annotated[int, msgspec.Meta(ge=1)] = 1280  # of an image, pixels
    height: Annotated[int, msgspec.Meta(ge=1)] = 720  # of an image, pixels
    fps: FramesPerSecond = 30.0  # that the camera is asked for
    # Format that the camera sends; USB 2 carries no more than 10 frames of 1280 x 720 a second as YUYV
    fourcc: Literal["MJPG", "YUYV"] = "MJPG"
    lock_exposure: bool = True  # hold exposure, gain, white balance and focus, once the camera has chosen them
    # After the start, in which the camera chooses them; these frames are not given
    warmup_s: Annotated[float, msgspec.Meta(ge=0)] = 1.5
    # Instead of what the camera chooses; None: it chooses
    exposure_us: Annotated[int, msgspec.Meta(ge=1)] | None = None
    frame_timeout_s: Annotated[float, msgspec.Meta(gt=0)] = 3.0  # so long without a frame, the camera counts as lost
    intrinsics: Intrinsics | None = None  # the lens, of a calibration at the same aspect ratio


def stream(config: Config, system: System | None = None) -> Iterator[Frame | DroppedFrame]:
    """Frames as they come, stamped by the driver at exposure.

    Raises CameraUnavailable, at first and when unplugged; ValueError where the lens cannot be of the camera's images.
    """
    path = config.device or _only_camera(system)
    try:
        with Device(path, system) as device:
            yield from _frames(device, config)
    except OSError as error:
        raise CameraUnavailable(_explain(error, path, system)) from error


def find(system: System | None = None) -> list[dict[str, str]]:
    """The cameras that are connected: `device` for the configuration, `description` for the reader."""
    found = []
    for number in sorted(Path("/sys/class/video4linux").glob("video*"), key=lambda path: int(path.name[5:] or 0)):
        try:
            with Device(f"/dev/{number.name}", system) as device:
                if device.is_camera:
                    text = f"{device.card} ({device.bus}): {', '.join(device.pixel_formats())}"
                    found.append({"device": _stable_name(Path(device.path)), "description": text})
        except OSError as error:
            raise_shortage(error)
            found.append({"device": f"/dev/{number.name}", "description": f"cannot be opened: {error.strerror}"})
    return found


def _frames(device: Device, config: Config) -> Iterator[Frame | DroppedFrame]:
    if not device.is_camera:
        raise OSError(errno.ENOTTY, "not a camera")
    chosen = device.set_format(config.fourcc, config.width, config.height)
    if chosen.pixels not in ("MJPG", "YUYV"):
        has = ", ".join(device.pixel_formats())
        raise CameraUnavailable(f"{device.path} gives {chosen.pixels}, and MJPG or YUYV is needed; it has: {has}")
    if config.intrinsics is not None:
        check_fits(config.intrinsics, [(chosen.width, chosen.height)])
    device.set_rate(config.fps)
    if config.lock_exposure:
        v4l2_device.run_free(device)
    device.start()
    settled, locked, frame_id = time.monotonic() + config.warmup_s, not config.lock_exposure, 0
    while True:
        raw = device.read(config.frame_timeout_s)
        if raw is None:
            raise CameraUnavailable(f"{device.path} gave no frame for {config.frame_timeout_s:g} s")
        if not locked and time.monotonic() < settled:
            continue
        if not locked:
            v4l2_device.hold(device, config.exposure_us)
            locked = True
            continue  # it was exposed before
        item = _frame(raw, chosen, frame_id, config.intrinsics)
        frame_id += isinstance(item, Frame)
        yield item


def _frame(raw: RawFrame, chosen: Format, frame_id: int, intrinsics: Intrinsics | None) -> Frame | DroppedFrame:
    name = f"{raw.stamp_ns / 1e9:.6f}"
    if raw.damaged:
        return DroppedFrame(name, "the driver says that it is damaged")
    try:
        image = _decode(raw.data, chosen)
    except UnusableImage as error:
        return DroppedFrame(name, str(error))
    if intrinsics is not None:
        intrinsics = intrinsics.resized(image.shape[1], image.shape[0])
    encoded = raw.data if chosen.pixels == "MJPG" else None
    return make_frame(frame_id, name, raw.stamp_ns, image, intrinsics, encoded, wall_clock(raw.stamp_ns))


def _decode(data: bytes, chosen: Format) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB. Raises UnusableImage."""
    if chosen.pixels == "MJPG":
        return decode_image(data)[0]
    if len(data) < chosen.bytes_per_line * chosen.height:
        raise UnusableImage(f"truncated: {len(data)} of {chosen.bytes_per_line * chosen.height} bytes")
    lines = np.frombuffer(data, np.uint8, chosen.bytes_per_line * chosen.height)
    yuyv = lines.reshape(chosen.height, chosen.bytes_per_line)[:, : 2 * chosen.width]
    pixels = np.ascontiguousarray(yuyv).reshape(chosen.height, chosen.width, 2)
    return cv2.cvtColor(pixels, cv2.COLOR_YUV2RGB_YUY2).astype(np.uint8, copy=False)


def _only_camera(system: System | None) -> str:
    found = find(system)
    if len(found) != 1:
        raise CameraUnavailable(f"camera.device must say which camera; {_describe_cameras(found)}")
    return found[0]["device"]


def _explain(error: OSError, path: str, system: System | None) -> str:
    reasons = {
        errno.ENODEV: f"{path} was unplugged",
        errno.EBUSY: f"{path} is used by another program; close it",
        errno.EACCES: f"no right to open {path}; add this user to the group video",
        errno.ENOENT: f"no camera at {path}; {_describe_cameras(find(system))}",
        errno.ENOTTY: f"{path} is no camera; {_describe_cameras(find(system))}",
    }
    return reasons.get(error.errno or 0, f"{path}: {error.strerror or error}")


def _describe_cameras(found: list[dict[str, str]]) -> str:
    if not found:
        return "none is connected. Plug one in, then: splatnode list-cameras"
    return "found: " + "; ".join(f"{camera['device']} {camera['description']}" for camera in found)


def _stable_name(device: Path) -> str:
    """The name under which udev knows the camera by its serial number, else by its port, else its number."""
    for folder in (_BY_ID, _BY_PATH):
        links = sorted(folder.iterdir()) if folder.is_dir() else []
        for link in links:
            if link.resolve() == device.resolve():
                return str(link)
    return str(device)
