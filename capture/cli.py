"""The verbs of the command line that concern cameras and messages."""

from __future__ import annotations

import argparse
import json
import logging
import math
import pkgutil
from collections.abc import Iterator
from dataclasses import asdict
from importlib import import_module

from splatnode.capture import cameras, daemon
from splatnode.capture.config import CaptureConfig, camera_opener, is_live
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.last_run import last_run
from splatnode.capture.lens_file import read_lens
from splatnode.capture.messaging import keys as key_files
from splatnode.capture.messaging.network import Network
from splatnode.capture.process.config import load_config, merge_config, parse_changes, parse_config, read_yaml
from splatnode.capture.process.logs import use_structured_lines
from splatnode.capture.process.progress import report_items, show_progress, show_waiting
from splatnode.capture.process.terminal import say
from splatnode.capture.reader import Reader, ReaderState
from splatnode.capture.recording import Recorder
from splatnode.capture.status import heartbeats, mark_problems_seen
from splatnode.capture.status_words import describe_heartbeat

log = logging.getLogger(__name__)

EXIT_GOOD, EXIT_SILENT = 0, 75


def capture(args: argparse.Namespace) -> int:
    """Runs the capture process."""
    config = _config(args)
    use_structured_lines()
    daemon.capture(config)
    return EXIT_GOOD


def record(args: argparse.Namespace) -> int:
    """Writes every frame of a camera into a folder, until the camera ends, the time is up, or a signal comes."""
    config = _config(args)
    with Recorder(args.out) as recorder:
        camera = config.camera
        with Reader(camera_opener(camera), is_live(camera), config.reader) as reader, show_progress() as tell:
            try:
                for item in report_items(_read_until(reader, args.seconds), tell, "recording", 0, "frame"):
                    recorder.write(item)
            finally:
                late = f", {reader.skipped} came while the disk was busy and are missing" if reader.skipped else ""
                say(f"{recorder.frames} frame{'s' * (recorder.frames != 1)} in {args.out}{late}")
    return EXIT_GOOD


def _config(args: argparse.Namespace) -> CaptureConfig:
    if args.intrinsics is None:
        return load_config(args.config, CaptureConfig, args.set)
    lens = {"camera": {"intrinsics": asdict(read_lens(args.intrinsics))}}
    return parse_config(
        merge_config(merge_config(read_yaml(args.config), lens), parse_changes(args.set)), CaptureConfig
    )


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
    for module in pkgutil.iter_modules(cameras.__path__):
        source = import_module(f"splatnode.capture.cameras.{module.name}")
        if hasattr(source, "find"):
            with show_waiting("looking for cameras"):
                found[module.name] = source.find()
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
    """Waits for a heartbeat of each process and prints it; 75 where one is silent. `--seen`: what it tells is known.

    A capture that has come to the end of its recording is not silent.
    """
    network = (
        parse_config(read_yaml(args.config).get("network") or {}, Network, "network") if args.config else Network()
    )
    with show_waiting("listening for capture and recon"):
        found = heartbeats(network)
    ended = last_run(network) if found["capture"] is None else None
    if args.json:
        print(json.dumps(found))
    else:
        for room, fields in found.items():
            silent = f"{room}: nothing heard of it; is `splatnode {room}` running, with the same `network` as here?"
            if room == "capture" and ended is not None:
                silent = f"{room}: {ended}"
            for line in [silent] if fields is None else describe_heartbeat(room, fields):
                say(line)
    if args.seen:
        for room, answer in mark_problems_seen(network, [room for room, fields in found.items() if fields]).items():
            say(f"{room}: {answer}")
    heard = {room: bool(fields) for room, fields in found.items()} | ({"capture": True} if ended else {})
    return EXIT_GOOD if all(heard.values()) else EXIT_SILENT
