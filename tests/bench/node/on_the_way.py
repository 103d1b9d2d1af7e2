"""The faults of `tests.bench walk_faults`, one function each: done to a node that is on its way, which must go on."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splatnode.capture.messaging.network import RECON_SCENE, Network, create_keys, expect_server
from splatnode.capture.messaging.pubsub import StateClient
from splatnode.capture.process.config import parse_config
from splatnode.capture.status import read_heartbeats
from splatnode.recon.daemon.ledger import MADE_ANEW
from splatnode.recon.result.message import SceneHeader
from tests.bench.node.intruders import refusal
from tests.bench.node.shortages import remounted
from tests.bench.node.trial import NotTried, expect, expect_exports_whole, wait_for
from tests.support.node import Node, Viewer

BETWEEN = 4  # photographs between two faults
ROOM = "3g"  # of the disk that the checkpoint is on
PATIENCE_S = 300.0  # until what was shown is worked in
MOST_SLEEPERS = 15  # viewers that never read, at one time


@dataclass
class Way:
    """A node on its way: its camera watches a folder into which photographs are put."""

    node: Node
    images: Path
    disk: Path
    network: dict[str, Any]
    stranger: Path  # keys that are not allowed
    chance: random.Random
    photograph: Callable[[int], Path]  # makes the photograph of this number
    shown: int = 0
    sleepers: list[StateClient] = field(default_factory=list)

    def show(self, count: int) -> None:
        for _ in range(count):
            path = self.photograph(self.shown)
            path.rename(self.images / path.name)
            self.shown += 1

    def recon(self) -> dict[str, Any] | None:
        """Its heartbeat."""
        return read_heartbeats(self.node.network)["recon"]

    def wait_until_worked_in(self) -> None:
        """Until recon has all that was shown, and few keyframes wait to be in a scene."""

        def worked_in() -> bool:
            for verb in ("capture", "recon"):
                code = self.node.processes[verb].poll()
                expect(code is None, f"{verb} ended with {code}")
            recon = self.recon()
            return (
                recon is not None
                and recon["state"] != "loading"
                and recon["keyframe"] + 1 >= self.shown
                and recon["queue"] <= 2
            )

        wait_for(worked_in, "scene of what was shown", PATIENCE_S)

    def restart(self) -> None:
        """After a fault that was not good: the next one is done to a node that runs."""
        for verb in ("capture", "recon"):
            if self.node.processes[verb].poll() is not None:
                self.node.start(verb)


Fault = Callable[[Way], None]


def kill_recon(way: Way) -> None:
    """kill -9 of recon."""
    way.node.end("recon", signal.SIGKILL)
    way.node.start("recon")


def kill_capture(way: Way) -> None:
    """kill -9 of capture. The next one takes what lies in the folder, from which older photographs were moved away."""
    way.node.end("capture", signal.SIGKILL)
    for path in sorted(way.images.iterdir())[:-BETWEEN]:
        path.unlink()
    way.node.start("capture")


def camera_lost(way: Way) -> None:
    """The watched folder vanishes, as a stick or a share does, and comes back."""
    gone = way.images.rename(way.images.with_name("gone"))
    time.sleep(way.chance.uniform(1.0, 4.0))
    gone.rename(way.images)


def late_viewer(way: Way) -> None:
    """Who comes late gets a scene at once."""
    viewer = Viewer(way.node.network)
    try:
        expect(viewer.hear(15.0), "the late viewer got no scene within 15 s")
    finally:
        viewer.close()


def second_publisher(way: Way) -> None:
    """A second capture and a second recon are told so (75); the first ones go on."""
    for verb in ("capture", "recon"):
        code = way.node.start(verb, name=f"second {verb}").wait(120)
        expect(code == 75, f"the second {verb} ended with {code}")


def slow_viewer(way: Way) -> None:
    """Viewers that connect and never read."""
    way.sleepers += [StateClient(RECON_SCENE, way.node.network, SceneHeader) for _ in range(5)]
    for sleeper in way.sleepers[:-MOST_SLEEPERS]:
        sleeper.close()
    del way.sleepers[:-MOST_SLEEPERS]


def full_disk(way: Way) -> None:
    """The checkpoint's disk is full, and has room a while later. What is not stored waits with capture."""
    used = os.statvfs(way.disk)
    taken_kb = (used.f_blocks - used.f_bfree) * used.f_frsize // 1024
    remounted(way.disk, f"size={taken_kb + 100}k")
    try:
        way.show(2)
        wait_for(lambda: "room" in str((way.recon() or {}).get("problem")), "word of the full disk", 60.0)
        time.sleep(way.chance.uniform(0, 4.0))
    finally:
        remounted(way.disk, f"size={ROOM}")


def clock_jump(way: Way) -> None:
    """recon goes on with a monotonic clock that is days off."""
    if subprocess.run(["unshare", "-T", "--monotonic", "1000", "true"], capture_output=True).returncode:
        raise NotTried("no right to another clock (unshare -T)")
    way.node.end("recon", signal.SIGKILL)
    way.node.start("recon", before=("unshare", "-T", "--monotonic", str(way.chance.randrange(10**6))))


def half_written(way: Way) -> None:
    """What a power cut leaves: temporary files, and caches that are cut short."""
    way.node.end("recon", signal.SIGKILL)
    checkpoint = way.disk / "checkpoint"
    for path in (checkpoint / name for name in MADE_ANEW):
        if path.exists():
            path.write_bytes(path.read_bytes()[: way.chance.randrange(max(1, path.stat().st_size))])
    out = max(way.node.out.glob("scene-*"))
    for leftover in (
        checkpoint / ".scene.1.tmp",
        checkpoint / "frames" / ".9.1.tmp",
        out / ".scene.ply.0123456789ab.tmp",
    ):
        leftover.write_bytes(b"half")
    way.node.start("recon")


def stopped_while_exporting(way: Way) -> None:
    """SIGTERM as an export's first temporary file appears: 0, and results that are whole or not there."""
    deadline = time.monotonic() + 60.0
    while not any(way.node.out.glob("*/.*")):
        if time.monotonic() > deadline:
            way.show(1)
            deadline += 60.0
        time.sleep(0.0005)
    expect(way.node.end("recon") == 0, "recon did not end with 0")
    expect_exports_whole(way.node)
    way.node.start("recon")


def unauthorised(way: Way) -> None:
    """A client whose key is not allowed hears nothing, and is told so."""
    expect("does not let this machine in" in _refusal(way, way.stranger), "no word to the stranger")


def wrong_key(way: Way) -> None:
    """A client that expects another machine than it meets hears nothing, and is told so."""
    keys = way.node.folder.with_name(f"keys-{way.shown}")
    expect_server(keys, create_keys(keys))
    expect("does not have the key" in _refusal(way, keys), "no word of the wrong key")


def _refusal(way: Way, keys: Path) -> str:
    """What a client with these keys is told."""
    client = StateClient(RECON_SCENE, parse_config(way.network | {"keys": str(keys)}, Network), SceneHeader)
    return refusal(client)


FAULTS: tuple[Fault, ...] = (
    kill_recon,
    kill_capture,
    camera_lost,
    late_viewer,
    second_publisher,
    slow_viewer,
    full_disk,
    clock_jump,
    half_written,
    stopped_while_exporting,
    unauthorised,
    wrong_key,
)
