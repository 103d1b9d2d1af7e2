"""One configuration with several cameras: a capture process for each, with its camera id."""

from __future__ import annotations

import logging
import re
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splatnode.capture.messaging.network import CAMERA_ID
from splatnode.capture.process import python
from splatnode.capture.process.config import ConfigError
from splatnode.capture.process.terminal import event
from splatnode.capture.process.text import sanitize_text

log = logging.getLogger(__name__)

LOOK_S = 0.2  # between looks at whether a process has ended
RESTART_S = 5.0  # before a camera's process that failed is started again
END_S = 20.0  # for a process to end when it is told to
EXIT_GOOD, FOR_A_HUMAN = 0, (2, 77)  # starting again does not help these


def list_cameras(raw: Mapping[str, Any]) -> list[str]:
    """The camera ids of a configuration with `cameras`; none where it has one `camera`. Raises ConfigError."""
    if "cameras" not in raw:
        return []
    cameras = raw["cameras"]
    if (
        not isinstance(cameras, Mapping)
        or not cameras
        or not all(isinstance(each, Mapping) for each in cameras.values())
    ):
        raise ConfigError("cameras: expected a camera for each camera id, such as {left: {kind: v4l2, device: ...}}")
    for camera_id in cameras:
        if not re.fullmatch(CAMERA_ID, str(camera_id)):
            raise ConfigError(
                f"cameras: a camera id must be 1 to 32 letters, digits, - or _; got {sanitize_text(camera_id, 60)!r}"
            )
    both = [key for key in ("camera", "camera_id") if key in raw]
    if both:
        raise ConfigError(f"{both[0]}: unknown key beside cameras, each of which has an id and a camera of its own")
    return [str(camera_id) for camera_id in cameras]


def choose_camera(raw: Mapping[str, Any], camera_id: str) -> dict[str, Any]:
    """The configuration of one of several cameras, as CaptureConfig has it. Raises ConfigError."""
    known = list_cameras(raw)
    if camera_id not in known:
        raise ConfigError(f"--camera-id: expected one of {', '.join(known)}, got {sanitize_text(camera_id, 60)!r}")
    rest = {key: value for key, value in raw.items() if key != "cameras"}
    camera = dict(raw["cameras"][camera_id])
    own = {key: camera.pop(key) for key in ("body_mask", "T_base_camera") if key in camera}
    return {**rest, **own, "camera": camera, "camera_id": camera_id}


def run_captures(config: Path, camera_ids: Sequence[str], further: Sequence[str] = ()) -> int:
    """Runs a capture process for each camera until all have ended; one that fails is started again after a while.

    Where one cannot be used as it is configured, all end, and its exit code is returned.
    """
    commands = {
        each: python.command("splatnode", "capture", str(config), "--camera-id", each, *further) for each in camera_ids
    }
    processes: dict[str, subprocess.Popen] = {}
    due_s = dict.fromkeys(commands, 0.0)  # when it is to be started (monotonic)
    try:
        while processes or due_s:
            for each in [name for name, at_s in due_s.items() if time.monotonic() >= at_s]:
                del due_s[each]
                processes[each] = subprocess.Popen(commands[each])
            time.sleep(LOOK_S)
            for each in [name for name, process in processes.items() if process.poll() is not None]:
                code = processes.pop(each).returncode
                if code in FOR_A_HUMAN:
                    return code
                if code != EXIT_GOOD:
                    event(log, logging.ERROR, "capture_ended", camera_id=each, code=code, again_after_s=RESTART_S)
                    due_s[each] = time.monotonic() + RESTART_S
        return EXIT_GOOD
    finally:
        for process in processes.values():
            process.terminate()
        for process in processes.values():
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
