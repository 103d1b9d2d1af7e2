"""Runs in the virtual machine: a board is shown to a camera driver, and `splatnode calibrate` looks at it."""

from __future__ import annotations

import ctypes
import fcntl
import itertools
import mmap
import os
import sys
import threading
import time
from pathlib import Path

from splatnode import command_line
from splatnode.capture.cameras import v4l2
from splatnode.capture.cameras.v4l2 import Device, find

WIDTH, HEIGHT = 720, 576  # of PAL
OUTPUT = 2  # V4L2_BUF_TYPE_VIDEO_OUTPUT
INTERLACED = 4  # V4L2_FIELD_INTERLACED
CONTROLS = range(0x00F0F000, 0x00F0F000 + 200)  # of vivid alone
HOLD_S = 4.0  # a picture is shown: it is looked at twice in that, in a machine that is slow
SECONDS = 130  # two rounds


def main() -> int:
    (camera,) = find()
    number = int(Path(os.path.realpath(camera["device"])).name.removeprefix("video"))
    with Device(camera["device"]) as device:
        device.set_format("YUYV", WIDTH, HEIGHT)
        names = {control: device.control_range(control) for control in CONTROLS}
        (loop,) = [control for control, found in names.items() if found is not None and found.name == "Loop Video"]
        device.set_control(loop, 1)
    pictures = [path.read_bytes() for path in sorted(Path("/mnt").glob("*.yuyv"))]
    threading.Thread(target=show, args=(f"/dev/video{number + 1}", pictures), daemon=True).start()
    Path("/mnt/camera.yaml").write_text(
        f"camera: {{kind: v4l2, device: '{camera['device']}', width: {WIDTH}, height: {HEIGHT}, pixels: YUYV, "
        "lock_exposure: false, warmup_s: 0}"
    )
    arguments = ["/mnt/camera.yaml", "--out", "/mnt/lens.yaml", "--model", "pinhole", "--seconds", str(SECONDS)]
    return command_line.main(["calibrate", *arguments])


def show(path: str, pictures: list[bytes]) -> None:
    """Gives each picture to the driver's output for a while, again and again."""
    device = os.open(path, os.O_RDWR)
    wish = v4l2.FormatStruct(type=OUTPUT)
    wish.fmt.pix.width, wish.fmt.pix.height = WIDTH, HEIGHT
    wish.fmt.pix.pixelformat, wish.fmt.pix.field = v4l2.fourcc("YUYV"), INTERLACED
    fcntl.ioctl(device, v4l2.S_FMT, wish)
    request = v4l2.BufferRequest(count=4, type=OUTPUT, memory=v4l2.MMAP)
    fcntl.ioctl(device, v4l2.REQBUFS, request)
    maps = []
    for index in range(request.count):
        buffer = v4l2.Buffer(index=index, type=OUTPUT, memory=v4l2.MMAP)
        fcntl.ioctl(device, v4l2.QUERYBUF, buffer)
        maps.append(mmap.mmap(device, buffer.length, offset=buffer.m.offset))
        give(device, maps, index, pictures[0])
    fcntl.ioctl(device, v4l2.STREAMON, ctypes.c_int(OUTPUT))
    for picture in itertools.cycle(pictures):
        until_s = time.monotonic() + HOLD_S
        while time.monotonic() < until_s:
            buffer = v4l2.Buffer(type=OUTPUT, memory=v4l2.MMAP)
            fcntl.ioctl(device, v4l2.DQBUF, buffer)
            give(device, maps, buffer.index, picture)


def give(device: int, maps: list[mmap.mmap], index: int, picture: bytes) -> None:
    maps[index][: len(picture)] = picture
    buffer = v4l2.Buffer(index=index, type=OUTPUT, memory=v4l2.MMAP, bytesused=len(picture), field=INTERLACED)
    fcntl.ioctl(device, v4l2.QBUF, buffer)


sys.exit(main())
