"""Runs in the virtual machine: a real camera driver is found, read, locked, unplugged and plugged in again."""

from __future__ import annotations

import itertools
import json
import time
from pathlib import Path
from typing import Any

import msgspec

from splatnode.capture.cameras import v4l2
from splatnode.capture.cameras.v4l2 import Config, Device, find, stream
from splatnode.capture.frame import CameraUnavailable, Frame
from splatnode.capture.reader import Config as ReaderConfig
from splatnode.capture.reader import Reader, ReaderState

DISCONNECT = 0x00F0F000 + 65  # vivid's control of that name


def main() -> None:
    result = {"found": find()}
    (camera,) = result["found"]
    config = Config(device=camera["device"], width=640, height=480, fourcc="YUYV", warmup_s=0.2)
    result["frames"] = [described(frame) for frame in itertools.islice(stream(config), 8)]
    result["busy"] = second_reader(config)
    with Device(camera["device"]) as device:
        result["held"] = v4l2.hold(device)
        result["gain_is_automatic"] = device.get_control(v4l2.AUTO_GAIN)
    result["unplugged"] = unplugged_while_streaming(config)
    result["replugged"] = lost_and_back(config)
    Path("/mnt/result.json").write_text(json.dumps(result))


def frame_id(frame):
    return frame.frame_id if isinstance(frame, Frame) else None


def described(frame):
    if not isinstance(frame, Frame):
        return {"dropped": frame.reason}
    shape, spread = list(frame.image.shape), float(frame.image.std())
    return {"shape": shape, "spread": spread, "stamp_ns": frame.stamp_ns, "age_s": age_s(frame), "name": frame.name}


def age_s(frame):
    return (time.monotonic_ns() - frame.stamp_ns) / 1e9


def second_reader(config):
    first: Any = stream(config)
    next(first)
    try:
        return opening(config)
    finally:
        first.close()


def opening(config):
    try:
        next(stream(config))
    except CameraUnavailable as error:
        return str(error)
    return "opened"


def unplug(device):
    """As pulling the cable does. vivid plugs itself in again when nobody has it open any more."""
    with Device(device) as handle:
        name = handle.control_range(DISCONNECT).name
        handle._ioctl(v4l2.S_CTRL, v4l2.Control(id=DISCONNECT, value=1))
    return name


def unplugged_while_streaming(config):
    frames = stream(config)
    next(frames)
    name = unplug(config.device)
    start = time.monotonic()
    try:
        for _ in frames:
            continue
    except CameraUnavailable as error:
        return {"control": name, "error": str(error), "seconds": time.monotonic() - start}
    return {"control": name, "error": None}


def lost_and_back(config):
    """The reader goes through a loss by itself."""
    (camera,) = find()
    config = msgspec.structs.replace(config, device=camera["device"])
    states, ids = [], []
    with Reader(lambda: stream(config), True, ReaderConfig(first_pause_s=1.0)) as reader:
        ids.append(frame_id(reader.next(10)))
        unplug(config.device)
        deadline = time.monotonic() + 10
        while reader.state is not ReaderState.DEGRADED and time.monotonic() < deadline:
            reader.next(0.05)
        states.append([reader.state.value, reader.why])
        while reader.state is not ReaderState.STREAMING and time.monotonic() < deadline + 20:
            reader.next(0.05)
        ids.append(frame_id(reader.next(10)))
        states.append([reader.state.value, reader.why])
    return {"states": states, "ids": ids}


main()
