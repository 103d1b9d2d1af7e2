"""Whole runs for `interrupted.py`: `splatnode replay`, and a node whose capture and recon share one process."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from pathlib import Path

import cv2
import msgspec

from splatnode.capture.messaging.keyframe_queue import KeyframeServer, Spool, SpoolConfig
from splatnode.capture.messaging.network import Network
from splatnode.capture.process.config import parse_config
from splatnode.command_line import main
from splatnode.recon.daemon import ReconState
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.config import DaemonConfig
from splatnode.recon.daemon.node import Daemon
from splatnode.recon.result.export.staged import hold_result_folder
from tests.bench.node.trial import RECON
from tests.fuzz.interrupted import Piece, Tell, in_a_fork
from tests.fuzz.pieces import no_leftovers, whole
from tests.support.synthetic import photographs

VIEWS = 3
RECIPE = RECON["reconstruction"] | {"seed": 0, "no_fallbacks": True}


def _images(disk: Path) -> None:
    folder = disk.with_name("images")
    folder.mkdir()
    for frame in photographs()[:VIEWS]:
        cv2.imwrite(str(folder / frame.name), cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
    (disk.with_name("recipe.yaml")).write_text(msgspec.json.encode(RECIPE).decode())


def _replaying(disk: Path, _: Tell) -> None:
    """As the command does, which ends with its code."""
    _silent(disk)
    out, recipe = str(disk / "out"), str(disk.with_name("recipe.yaml"))
    sys.exit(main(["replay", str(disk.with_name("images")), "--config", recipe, "--out", out]))


def _replayed_after(disk: Path, told: list[str]) -> None:
    out = disk / "out"
    if out.exists():
        with hold_result_folder(out):
            pass
        if any(path.is_file() for path in out.rglob("*")):
            whole(out)
    in_a_fork(lambda: _replaying(disk, told.append))
    no_leftovers(disk)
    whole(out)
    assert (out / "scene.ply").exists()


def _spooled(disk: Path) -> None:
    (disk.with_name("run")).mkdir(mode=0o700)
    server = KeyframeServer(_network(disk), Spool(SpoolConfig(directory=disk)))
    for frame in photographs()[:VIEWS]:
        server.offer(frame)
    server.close()


def _network(disk: Path) -> Network:
    return Network(directory=disk.with_name("run"))


def _growing(disk: Path, tell: Tell) -> None:
    """A node, until its scene has all keyframes, is finished and exported."""
    _silent(disk)
    recon = {"checkpoint": str(disk / "checkpoint"), "out": str(disk / "out"), "status_interval_s": 0.1}
    config = parse_config(RECON | {"reconstruction": RECIPE} | recon, DaemonConfig)
    config = msgspec.structs.replace(config, network=_network(disk))
    stopping = threading.Event()
    with KeyframeServer(config.network, Spool(SpoolConfig(directory=disk))) as server, Daemon(config, stopping) as node:
        ending = threading.Thread(target=_until_finished, args=(server, node, stopping))
        ending.start()
        try:
            node.run()
        finally:
            stopping.set()
            ending.join()
    tell(node._make_status().problem or "whole")


def _until_finished(server: KeyframeServer, node: Daemon, stopping: threading.Event) -> None:
    """Stops the node when all keyframes are in a finished scene, or when it says that the disk is full."""
    while not stopping.is_set():
        with contextlib.suppress(OSError):
            server.serve(0.05)
        status = node._make_status()
        if status.problem or (status.state is ReconState.IDLE and status.keyframes == VIEWS and not server.num_queued):
            stopping.set()


def _grown_after(disk: Path, told: list[str]) -> None:
    in_a_fork(lambda: _growing(disk, told.append))
    no_leftovers(disk)
    assert not list((disk / "spool").glob("*.frame")), "keyframes wait"
    store = Store(disk / "checkpoint")
    names = sorted(store.names)
    store.close()
    assert names == sorted(frame.name for frame in photographs()[:VIEWS]), names
    whole(disk / "out" / "scene-0001")


def _silent(disk: Path) -> None:
    """What the process says goes to a file beside the disk."""
    file = os.open(disk.with_name("log"), os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    for stream in (1, 2):
        os.dup2(file, stream)


RUNS = (
    Piece("replay", _images, _replaying, _replayed_after, kinds=("kill", "full")),
    Piece("recon", _spooled, _growing, _grown_after, kinds=("kill", "full")),
)
