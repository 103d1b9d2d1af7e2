"""One trial of a fault: a node that replays six small photographs, and what must be so in the end."""

from __future__ import annotations

import hashlib
import json
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2

from tests.support.node import PATIENCE_S, Node, Viewer, finished
from tests.support.synthetic import photographs

VIEWS = 6
# All that costs time and tells nothing about faults is small: a whole replay takes 5 seconds of a processor.
RECON = {
    "reconstruction": {
        "size": 160,
        "matching": {"features": {"max_num_features": 1500, "min_longer_side": 320}},
        "registration": {"mapper": {"max_attempts": 2}},
        "preview": {"iterations": 2, "half_resolution_share": 1.0},
        "optimize": {"iterations": 20, "checkpoints": [10]},
    },
    "tracking": {"interval_s": 0},
    "idle_finalize_s": 0.5,
}


class NotTried(Exception):
    """This machine does not let the fault be done; the text says why."""


class Trial:
    """A node that replays the photographs, and what is expected of it in the end."""

    def __init__(self, folder: Path, chance: random.Random, pause_s: float = 60.0) -> None:
        """`pause_s`: how long a process is stopped that is stopped."""
        self.folder, self.chance, self.pause_s = folder, chance, pause_s
        self.images = folder / "images"
        self.images.mkdir(parents=True)
        for frame in photographs():
            cv2.imwrite(str(self.images / frame.name), cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))

    def node(
        self,
        camera: dict[str, Any] | None = None,
        network: dict[str, Any] | None = None,
        *,
        name: str = "node",
        spool: dict[str, Any] | None = None,
        **recon: Any,
    ) -> Node:
        replayed = {"kind": "folder", "folder": str(self.images), "fps": 4.0, "pace": "recorded"}
        config: dict[str, Any] = {"camera": camera or replayed, "selection": {"every_frame": True}}
        config["spool"] = {"directory": str(self.folder / name)} | (spool or {})
        return Node(self.folder / name, config, RECON | recon, network)

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
    wait_for(lambda: node.spooled() == 0, "acknowledgement of all keyframes", 30)
    expect(node.end("recon") == 0, "recon did not end with 0")
    expect(any(node.out.glob("*/manifest.json")), "there is no result")
    expect_exports_whole(node)
    expect(not node.half_written, f"half-written files: {node.half_written}")


def expect_scene(node: Node, views: int = VIEWS) -> None:
    viewer = Viewer(node.network)
    deadline = time.monotonic() + PATIENCE_S
    while viewer.wait(finished(views), patience_s=5.0) is None:
        code = node.processes["recon"].poll()
        expect(code is None, f"recon ended with {code}")
        expect(time.monotonic() < deadline, f"no finished scene of {views} views")
    viewer.close()


def expect_exports_whole(node: Node) -> None:
    for manifest in node.out.glob("*/manifest.json"):
        for name, entry in json.loads(manifest.read_text())["files"].items():
            content = (manifest.parent / name).read_bytes()
            expect(hashlib.sha256(content).hexdigest() == entry["sha256"], f"{name} is not what the manifest says")
