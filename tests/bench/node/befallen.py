"""The faults of `tests.bench faults`, one function each: done to a node, after which it must be whole again."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time

from splatnode.capture.messaging.network import RECON_SCENE
from splatnode.capture.messaging.pubsub import StateClient
from splatnode.capture.status import read_heartbeats
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.ledger import MADE_ANEW
from splatnode.recon.result.message import SceneHeader
from tests.bench.node.trial import (
    VIEWS,
    NotTried,
    Trial,
    expect,
    expect_exports_whole,
    expect_scene,
    expect_whole,
    wait_for,
)
from tests.support.node import Viewer, finished, memory_mb, running


def kill_recon(trial: Trial) -> None:
    """kill -9 of recon at a random moment, from its start until well after the last keyframe."""
    with running(trial.node()) as node:
        node.start("recon")
        node.start("capture")
        trial.some_time(15.0)
        node.end("recon", signal.SIGKILL)
        node.start("recon")
        expect_whole(node)


def kill_capture(trial: Trial) -> None:
    """kill -9 of capture: what it had spooled is delivered, once, by the next one."""
    with running(trial.node()) as node:
        node.start("capture")
        trial.some_time(5.0)
        node.end("capture", signal.SIGKILL)
        spooled = {tuple(path.stem.split("-")[1:]) for path in (node.folder / "spool").glob("*.frame")}
        node.start("recon")
        node.start("capture")
        expect_whole(node)
        store = Store(node.folder / "checkpoint")
        kept = [(stored.key[0], str(stored.key[1])) for stored in store.frames()]
        store.close()
        expect(spooled <= set(kept), f"lost: {spooled - set(kept)}")
        expect(len(kept) == len(set(kept)), "a keyframe was taken twice")


def camera_lost(trial: Trial) -> None:
    """The watched folder vanishes, as a stick or a share does, and comes back."""
    waiting = trial.folder / "waiting"
    trial.images.rename(waiting)
    trial.images.mkdir()
    with running(trial.node({"kind": "watched", "folder": str(trial.images)})) as node:
        node.start("recon")
        node.start("capture")
        for index, path in enumerate(sorted(waiting.iterdir())):
            if index == 3:
                wait_for(lambda: node.log("capture").count("event=keyframe") == 3, "three keyframes")
                gone = trial.images.rename(trial.folder / "gone")
                trial.some_time(6.0)
                gone.rename(trial.images)
            shutil.copy(path, trial.images / path.name)
            time.sleep(0.5)
        expect_whole(node)
        expect(node.end("capture") == 0, "capture did not end with 0")


def late_viewer(trial: Trial) -> None:
    """Who comes after all is done gets the whole scene at once."""
    with running(trial.node()) as node:
        node.start("recon")
        node.start("capture")
        expect_scene(node)
        started = time.monotonic()
        viewer = Viewer(node.network)
        scene = viewer.hear(10.0)
        viewer.close()
        expect(scene and finished(VIEWS)(scene), "the late viewer got no scene")
        expect(time.monotonic() - started < 5.0, f"it came after {time.monotonic() - started:.1f} s")
        expect_whole(node)


def second_publisher(trial: Trial) -> None:
    """A second capture and a second recon are told so (75); the first ones go on."""
    with running(trial.node()) as node:
        for verb, sign in (("capture", "event=started"), ("recon", "event=ready")):
            node.start(verb)
            wait_for(lambda verb=verb, sign=sign: sign in node.log(verb), f"{verb} that runs")
            code = node.start(verb, name=f"second {verb}").wait(120)
            expect(code == 75, f"the second {verb} ended with {code}")
        expect_whole(node)


def slow_viewer(trial: Trial) -> None:
    """Viewers that connect and never read hold nobody up and cost no memory."""
    with running(trial.node()) as node:
        pid = node.start("recon").pid
        sleepers = [StateClient(RECON_SCENE, node.network, SceneHeader) for _ in range(5)]
        node.start("capture")
        expect_scene(node)
        memory = memory_mb(pid)
        expect_whole(node)
        for sleeper in sleepers:
            sleeper.close()
        expect(memory < 1000, f"recon held {memory:.0f} MB")


def full_disk(trial: Trial) -> None:
    """The disk is full after two keyframes, and has room later. What is not stored waits with capture."""
    disk = trial.folder / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", str(disk)], capture_output=True).returncode:
        raise NotTried("no right to mount a small disk")
    try:
        with running(trial.node(checkpoint=str(disk / "checkpoint"))) as node:
            node.start("recon")
            node.start("capture")
            deadline = time.monotonic() + 120
            while (status := read_heartbeats(node.network)["recon"]) is None or status["state"] != "full":
                expect(time.monotonic() < deadline, f"recon does not tell that the disk is full: {status}")
            trial.some_time(4.0)
            expect(node.spooled() > 0, "keyframes were acknowledged that were not stored")
            subprocess.run(["mount", "-o", "remount,size=200m", str(disk)], check=True)
            expect_whole(node)
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def clock_jump(trial: Trial) -> None:
    """recon goes on with a monotonic clock that is days ahead of capture's and of its own before."""
    if subprocess.run(["unshare", "-T", "--monotonic", "1000", "true"], capture_output=True).returncode:
        raise NotTried("no right to another clock (unshare -T)")
    with running(trial.node()) as node:
        node.start("recon")
        node.start("capture")
        trial.some_time(10.0)
        node.end("recon", signal.SIGKILL)
        node.start("recon", before=("unshare", "-T", "--monotonic", str(trial.chance.randrange(10**6))))
        expect_whole(node)


def half_written(trial: Trial) -> None:
    """What a power cut leaves: temporary files, and caches that are cut short."""
    with running(trial.node()) as node:
        node.start("recon")
        node.start("capture")
        viewer = Viewer(node.network)
        expect(viewer.wait(lambda scene: len(scene.snapshot.cameras) >= 3), "no scene")
        viewer.close()
        node.end("recon", signal.SIGKILL)
        checkpoint, out = node.folder / "checkpoint", node.folder / "out" / "scene-0001"
        for name in MADE_ANEW:
            path = checkpoint / name
            if path.exists():
                path.write_bytes(path.read_bytes()[: trial.chance.randrange(max(1, path.stat().st_size))])
        out.mkdir(parents=True, exist_ok=True)
        for leftover in (
            checkpoint / ".scene.1.tmp",
            checkpoint / "frames" / ".9.1.tmp",
            out / ".scene.ply.0123456789ab.tmp",
        ):
            leftover.write_bytes(b"half")
        node.start("recon")
        expect_whole(node)


def stopped_while_exporting(trial: Trial) -> None:
    """SIGTERM as the export's first temporary file appears: 0, and a result that is whole or not there."""
    with running(trial.node()) as node:
        process = node.start("recon")
        node.start("capture")
        out = node.folder / "out" / "scene-0001"
        deadline = time.monotonic() + 300
        while not (out.is_dir() and any(name.startswith(".") for name in os.listdir(out))):
            if (out / "manifest.json").exists():
                break
            expect(time.monotonic() < deadline, "no export began")
            time.sleep(0.0005)
        time.sleep(trial.chance.uniform(0, 0.02))
        expect(node.end("recon") == 0, f"recon ended with {process.returncode}")
        expect_exports_whole(node)
        expect((out / "manifest.json").exists() or not (out / "scene.ply").exists(), "half a result")
        expect(not list(node.folder.rglob(".*.tmp")), "half-written files")
        node.start("recon")
        expect_whole(node)
