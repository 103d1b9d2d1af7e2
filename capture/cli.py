"""The verbs of the command line that concern cameras and messages."""

from __future__ import annotations

import argparse
import contextlib
import errno
import json
import logging
import math
import os
import re
import shutil
import subprocess
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

from splatnode.capture import daemon
from splatnode.capture.config import Camera, CaptureConfig, camera_opener, is_live, mount_camera
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.lenses import read_lens
from splatnode.capture.messaging import network as key_files
from splatnode.capture.messaging.network import CAMERA_ID, Network
from splatnode.capture.process import python
from splatnode.capture.process.config import ConfigError, parse_changes, parse_config, parse_layers, read_yaml
from splatnode.capture.process.files import make_folder, sync_folder
from splatnode.capture.process.terminal import (
    event,
    report_items,
    say,
    show_progress,
    show_waiting,
    use_structured_lines,
)
from splatnode.capture.process.text import sanitize_text
from splatnode.capture.reader import Reader, ReaderState
from splatnode.capture.recording import Recorder
from splatnode.capture.status import describe_heartbeat, last_run, mark_problems_seen, parse_camera_id, read_heartbeats

# One configuration with several cameras: a capture process for each, with its camera id.

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


EXIT_SILENT = 75


def capture(args: argparse.Namespace) -> int:
    """Runs the capture process; of a configuration with several cameras one for each."""
    camera_ids = list_cameras(read_yaml(args.config)) if args.camera_id is None else []
    if camera_ids:
        if args.intrinsics is not None:
            raise ConfigError("--intrinsics: has one lens, and there are several cameras; give each its `intrinsics`")
        for each in camera_ids:
            _config(argparse.Namespace(**{**vars(args), "camera_id": each}))  # what is wrong is told at once
        use_structured_lines()
        return run_captures(args.config, camera_ids, [part for each in args.set for part in ("--set", each)])
    config = _config(args)
    use_structured_lines()
    daemon.capture(config)
    return EXIT_GOOD


def record(args: argparse.Namespace) -> int:
    """Writes every frame of a camera into a folder, until the camera ends, the time is up, or a signal comes."""
    config = _config(args)
    with Recorder(args.out) as recorder:
        camera = config.camera
        opened = mount_camera(camera_opener(camera), config.T_base_camera)
        with Reader(opened, is_live(camera), config.reader) as reader, show_progress() as tell:
            try:
                for item in report_items(_read_until(reader, args.seconds), tell, "recording", 0, "frame"):
                    recorder.write(item)
            finally:
                late = f", {reader.skipped} came while the disk was busy and are missing" if reader.skipped else ""
                say(f"{recorder.frames} frame{'s' * (recorder.frames != 1)} in {args.out}{late}")
    return EXIT_GOOD


def _config(args: argparse.Namespace) -> CaptureConfig:
    raw, camera_id = read_yaml(args.config), getattr(args, "camera_id", None)
    if "cameras" in raw:
        if camera_id is None:
            raise ConfigError("cameras: this command is for one camera; give a configuration with `camera`")
        raw = choose_camera(raw, camera_id)
    own = {} if args.intrinsics is None else {"camera": {"intrinsics": asdict(read_lens(args.intrinsics))}}
    if camera_id is not None:
        own["camera_id"] = camera_id
    return parse_layers([raw, own, parse_changes(args.set)], CaptureConfig)


def _read_until(reader: Reader, seconds: float | None) -> Iterator[Frame | DroppedFrame]:
    """The reader's items until its end; with `seconds`, until a frame whose stamp is so much later than the first."""
    last_ns = math.inf
    while reader.state is not ReaderState.FINISHED:
        item = reader.next(0.1)
        if isinstance(item, Frame) and seconds is not None:
            last_ns = min(last_ns, item.stamp_ns + seconds * 1e9)
            if item.stamp_ns > last_ns:
                return
        if item is not None:
            yield item


def find(args: argparse.Namespace) -> int:
    """Lists the cameras that are connected, as lines that can be copied into a configuration."""
    found = {}
    for kind in Camera.kinds():
        try:
            source = Camera.load_module(kind)
        except ConfigError as error:  # of another package: the other cameras are found all the same
            say(str(error), error=True)
            continue
        if hasattr(source, "find"):
            with show_waiting("looking for cameras"):
                found[kind] = source.find()
    if args.json:
        print(json.dumps(found, indent=1))
        return EXIT_GOOD
    for kind, devices in found.items():
        for device in devices:
            name = json.dumps(device["device"], ensure_ascii=False)  # with the escapes of `say` it is YAML's text, too
            say(f"camera: {{kind: {kind}, device: {name}}}  # {device['description']}")
    if not any(found.values()):
        say("no camera is connected; folders and videos need none: see replay.yaml (splatnode config --write configs)")
    return EXIT_GOOD


def keys(args: argparse.Namespace) -> int:
    """Makes this machine's keys, allows another machine to connect, or names the server's key."""
    if args.allow:
        name, public = args.allow
        key_files.allow(args.folder, name, public.encode())
        say(f"{name} may connect")
    elif args.server:
        key_files.expect_server(args.folder, args.server.encode())
        say("this machine connects to that server and to no other")
    else:
        say(key_files.create_keys(args.folder).decode())
    return EXIT_GOOD


def status(args: argparse.Namespace) -> int:
    """Waits for a heartbeat of each process and prints it; 75 where one is silent.

    `--acknowledge`: what it tells is known.
    A capture that has come to the end of its recording is not silent.
    """
    network = (
        parse_config(read_yaml(args.config).get("network") or {}, Network, "network") if args.config else Network()
    )
    with show_waiting("listening for capture and recon"):
        found = read_heartbeats(network)
    silent_captures = {room for room in found if room != "recon" and found[room] is None}
    ended = {room: run for room in silent_captures if (run := last_run(network, parse_camera_id(room))) is not None}
    if args.json:
        print(json.dumps(found))
    else:
        for room, fields in found.items():
            silent = f"{room}: nothing heard of it; is `splatnode {_command(room)}` running, with the same `network`?"
            if room in ended:
                silent = f"{room}: {ended[room]}"
            for line in [silent] if fields is None else describe_heartbeat(room, fields):
                say(line)
    if args.acknowledge:
        for room, answer in mark_problems_seen(network, [room for room, fields in found.items() if fields]).items():
            say(f"{room}: {answer}")
    return EXIT_GOOD if all(fields or room in ended for room, fields in found.items()) else EXIT_SILENT


def _command(room: str) -> str:
    """`capture --camera-id left`."""
    camera_id = parse_camera_id(room)
    return f"capture --camera-id {camera_id}" if camera_id else room


# The configurations that come with the package, with systemd's units and udev's rule: listed, or written to a folder.
#
# In a checkout they lie in configs/. The first line of each is a comment that says what it is for.

_PATTERNS = ("*.yaml", "systemd/*.service", "udev/*.rules")
_IS_THERE = {errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR, errno.EBUSY, errno.EINVAL}


def config(args: argparse.Namespace) -> int:
    """Lists the configurations, or with `--write` writes them into a new folder."""
    contents = examples()
    if args.write is None:
        longest = max(map(len, contents))
        for name, content in contents.items():
            say(f"{name:{longest}}  {content.decode().splitlines()[0].lstrip('# ')}")
        say("Write them into a new folder: splatnode config --write configs")
        return 0
    write(args.write, contents)
    for name in contents:
        say(str(args.write / name))
    return 0


def examples() -> dict[str, bytes]:
    """The content of each file, by its name in the folder."""
    with resources.as_file(resources.files("splatnode") / "configs") as folder:
        paths = [path for pattern in _PATTERNS for path in sorted(folder.glob(pattern))]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def write(folder: Path, contents: dict[str, bytes]) -> None:
    """Makes `folder` with all files in it, or leaves nothing.

    Raises ValueError where there is something already, which stays as it is, and OSError. A process that is killed may
    leave its unfinished folder, `.NAME.*.tmp`, beside it.
    """
    staged = folder.with_name(f".{folder.name}.{uuid.uuid4().hex[:8]}.tmp") if folder.name else folder
    try:
        with make_folder(folder.parent), contextlib.ExitStack() as failing:
            staged.mkdir()
            failing.callback(shutil.rmtree, staged, ignore_errors=True)
            for name, content in contents.items():
                _write(staged / name, content)
            os.rename(staged, folder)  # takes the place of an empty folder, and of nothing else
            failing.pop_all()
            sync_folder(folder.parent)
    except OSError as error:
        if error.errno in _IS_THERE and os.path.lexists(folder):
            raise ValueError(
                f"{sanitize_text(folder)} is there already, and nothing was written. Name a folder that is new or empty"
            ) from error
        raise OSError(error.errno, error.strerror, str(folder)) from error


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(exist_ok=True)
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    sync_folder(path.parent)
