"""What befalls software on robots, done to the real processes: `python -m tests.bench faults --times 20`.

Each fault is tried so many times, each time in a node of its own that replays six small photographs. Good is a trial
after which all of them are in a finished scene, nothing lies about half written, and the exit codes are right. A fault
that cannot be done on a machine (no right to mount or to unshare) is reported as not tried.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2

from capture.config import typed
from capture.messaging.keys import create_keys, expect_server
from capture.messaging.network import Network, NotAllowed
from capture.messaging.services import RECON_SCENE
from capture.messaging.state import StateClient
from capture.status import heartbeats
from recon.daemon.scene_message import SceneHeader
from recon.daemon.store import Store
from tests.node import PATIENCE_S, Node, Viewer, finished, memory_mb, running
from tests.synthetic import photographs

VIEWS = 6
# All that costs time and tells nothing about faults is small: a whole replay takes 5 seconds of a processor.
RECON = {
    "reconstruction": {
        "size": 160,
        "prior": {
            "registration": {
                "features": {"num_features": 1500, "shortest_longer_side": 320},
                "mapper": {"max_attempts": 2},
            }
        },
        "preview": {"iterations": 2, "half_resolution_share": 1.0},
        "optimize": {"iterations": 20, "checkpoints": [10]},
    },
    "tracking": {"every_s": 0},
    "settle_s": 0.5,
}


class NotTried(Exception):
    """This machine does not let the fault be done; the text says why."""


class Trial:
    """A node that replays the photographs, and what is expected of it in the end."""

    def __init__(self, folder: Path, chance: random.Random) -> None:
        self.folder, self.chance = folder, chance
        self.images = folder / "images"
        self.images.mkdir(parents=True)
        for frame in photographs():
            cv2.imwrite(str(self.images / frame.name), cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))

    def node(self, camera: dict[str, Any] | None = None, network: dict[str, Any] | None = None, **recon: Any) -> Node:
        replayed = {"kind": "folder", "folder": str(self.images), "frames_per_second": 4.0, "pace": "recorded"}
        config = {"camera": camera or replayed, "selection": {"every_frame": True}}
        return Node(self.folder / "node", config, RECON | recon, network)

    def some_time(self, most_s: float) -> None:
        time.sleep(self.chance.uniform(0, most_s))


def expect(condition: object, otherwise: str) -> None:
    if not condition:
        raise AssertionError(otherwise)


def wait_for(condition: Callable[[], bool], what: str, patience_s: float = 120.0) -> None:
    deadline = time.monotonic() + patience_s
    while not condition():
        expect(time.monotonic() < deadline, f"no {what} within {patience_s:.0f} s")
        time.sleep(0.05)


def expect_whole(node: Node, views: int = VIEWS) -> None:
    """All photographs in a finished scene, which is exported whole; nothing half written; a clean end."""
    expect_scene(node, views)
    wait_for(lambda: node.spooled() == 0, "acknowledgement of all key frames", 30)
    expect(node.end("recon") == 0, "recon did not end with 0")
    expect_exports_whole(node)
    expect(not list(node.folder.rglob(".*.tmp")), f"half-written files: {list(node.folder.rglob('.*.tmp'))}")


def expect_scene(node: Node, views: int = VIEWS) -> None:
    viewer = Viewer(node.network)
    deadline = time.monotonic() + PATIENCE_S
    while viewer.wait(finished(views), patience_s=5.0) is None:
        code = node.processes["recon"].poll()
        expect(code is None, f"recon ended with {code}")
        expect(time.monotonic() < deadline, f"no finished scene of {views} views")
    viewer.close()


def expect_exports_whole(node: Node) -> None:
    for manifest in (node.folder / "out").glob("*/manifest.json"):
        for name, entry in json.loads(manifest.read_text())["files"].items():
            content = (manifest.parent / name).read_bytes()
            expect(hashlib.sha256(content).hexdigest() == entry["sha256"], f"{name} is not what the manifest says")


def kill_recon(trial: Trial) -> None:
    """kill -9 of recon at a random moment, from its start until well after the last key frame."""
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
        expect(len(kept) == len(set(kept)), "a key frame was taken twice")


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
                wait_for(lambda: node.log("capture").count("event=keyframe") == 3, "three key frames")
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
    """The disk is full after two key frames, and has room later. What is not stored waits with capture."""
    disk = trial.folder / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", str(disk)], capture_output=True).returncode:
        raise NotTried("no right to mount a small disk")
    try:
        with running(trial.node(checkpoint=str(disk / "checkpoint"))) as node:
            node.start("recon")
            node.start("capture")
            deadline = time.monotonic() + 120
            while (status := heartbeats(node.network)["recon"]) is None or status["state"] != "full":
                expect(time.monotonic() < deadline, f"recon does not tell that the disk is full: {status}")
            trial.some_time(4.0)
            expect(node.spooled() > 0, "key frames were acknowledged that were not stored")
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
        for name in ("graph", "scene"):
            path = checkpoint / name
            if path.exists():
                path.write_bytes(path.read_bytes()[: trial.chance.randrange(max(1, path.stat().st_size))])
        out.mkdir(parents=True, exist_ok=True)
        for leftover in (checkpoint / ".scene.1.tmp", checkpoint / "frames" / ".9.1.tmp", out / ".scene.ply.1.tmp"):
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


def unauthorised(trial: Trial) -> None:
    """A client whose key is not allowed hears nothing, and the node goes on."""
    network, stranger = _over_tcp(trial)
    with running(trial.node(network=network)) as node:
        node.start("recon")
        node.start("capture")
        wait_for(lambda: "event=ready" in node.log("recon"), "recon that runs")
        outsider = StateClient(RECON_SCENE, typed(network | {"keys": str(stranger)}, Network), SceneHeader)
        refused = False
        deadline = time.monotonic() + 15
        while not refused and time.monotonic() < deadline:
            try:
                expect(outsider.poll(1.0) is None, "a stranger heard the scene")
            except NotAllowed:
                refused = True
        outsider.close()
        expect(refused, "the stranger was not told that it is not allowed")
        expect_whole(node)


def wrong_key(trial: Trial) -> None:
    """recon that expects another machine than it meets ends with 77 and says so."""
    network, stranger = _over_tcp(trial)
    expect_server(stranger, (stranger / "public.key").read_bytes().strip())
    with running(trial.node(network=network)) as node:
        node.start("capture")
        other = Node(
            trial.folder / "other",
            {"camera": {"kind": "folder", "folder": str(trial.images)}},
            RECON,
            network | {"keys": str(stranger), "directory": str(trial.folder / "other" / "run")},
        )
        with running(other):
            code = other.start("recon").wait(120)
            expect(code == 77, f"recon with the wrong key ended with {code}")
        node.start("recon")
        expect_whole(node)


def _over_tcp(trial: Trial) -> tuple[dict[str, Any], Path]:
    """A network over loopback with keys, and the keys of a machine that is not allowed."""
    own, stranger = trial.folder / "keys", trial.folder / "stranger"
    public = create_keys(own)
    create_keys(stranger)
    expect_server(own, public)
    expect_server(stranger, public)
    return {"tcp": "127.0.0.1", "keys": str(own), "first_port": trial.chance.randrange(20000, 30000)}, stranger


FAULTS: tuple[Callable[[Trial], None], ...] = (
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=20, help="trials of each fault (default: 20)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", choices=[fault.__name__ for fault in FAULTS], help="these faults")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/faults.json"))
    args = parser.parse_args()
    rows: dict[str, dict[str, Any]] = {}
    for index in range(args.times):
        for fault in FAULTS:
            if args.only and fault.__name__ not in args.only:
                continue
            row = rows.setdefault(fault.__name__, {"tried": 0, "good": 0, "failures": [], "seconds": []})
            started = time.monotonic()
            with tempfile.TemporaryDirectory() as folder:
                trial = Trial(Path(folder), random.Random(f"{args.seed} {fault.__name__} {index}"))
                try:
                    fault(trial)
                except NotTried as reason:
                    row["not_tried"] = str(reason)
                    continue
                except (AssertionError, subprocess.TimeoutExpired) as error:
                    logs = {path.name: path.read_text()[-3000:] for path in Path(folder).glob("*/*.log")}
                    row["failures"].append({"trial": index, "why": str(error), "logs": logs})
                else:
                    row["good"] += 1
            row["tried"] += 1
            row["seconds"].append(round(time.monotonic() - started, 1))
            print(f"{fault.__name__} {index}: {row['good']} of {row['tried']} good", flush=True)
            command = shlex.join(["python", "-m", "tests.bench", "faults", *sys.argv[1:]])
            args.out.write_text(json.dumps({"command": command, "faults": rows}, indent=1) + "\n")
    sys.exit(any(row["good"] < row["tried"] for row in rows.values()))
