"""A hostile client on every socket: `python -m tests.bench siege --minutes 60 --over ipc`.

The real processes follow a walk through the built-in place, eight pictures a second, over and over. Quiet phases and
hostile ones alternate; in a hostile one a client besieges the node's sockets (tests/bench/node/besieger.py): over ipc
as another process of the same user, over tcp as one without a key. Timed by one that looks on like a viewer: previews
from their sending to their arrival, keyframes from their preview to the first scene that has their camera. What counts
is the ratio of hostile to quiet phases of the same run. Memory is flat where, of the quiet phases' samples, the median
of the last quarter is within 5 % of that of the second quarter.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from splatnode.capture.cameras.synthetic import TARGET, Config, intrinsic_matrix, look_at, render_image
from splatnode.capture.config import PreviewHeader
from splatnode.capture.messaging.network import CAPTURE_PREVIEW, create_keys
from splatnode.capture.messaging.pubsub import Subscriber
from splatnode.capture.status import read_heartbeats
from tests.bench.node.soak import SAMPLE_S, change, sample
from tests.bench.node.trial import RECON
from tests.conftest import ROOT
from tests.support.node import Node, Viewer, running

PICTURE = Config(width=320, height=240, samples=1)
PICTURES = 1200  # of the walk; at 8 a second it lasts 150 s
PER_SECOND = 8.0
SETTLE_S = 20.0  # at the start, until the first scene is there
KINDS = ("quiet", "hostile")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--phase-s", type=float, default=60.0)
    parser.add_argument("--over", choices=("ipc", "tcp"), default="ipc")
    parser.add_argument("--per-second", type=float, default=200.0, help="what the hostile client does")
    parser.add_argument("--pictures", type=int, default=PICTURES)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        network = over(args.over, place)
        photograph_walk(place / "walk", args.pictures)
        loops = 2 + int(args.minutes * 60 * PER_SECOND / args.pictures)
        stream = {"kind": "folder", "folder": str(place / "walk"), "fps": PER_SECOND}
        camera = {"camera": {**stream, "pace": "recorded", "loops": loops}}
        with running(
            Node(place / "node", camera, RECON | {"max_views": 8, "idle_finalize_s": 10.0, "out": "out"}, network)
        ) as node:
            for verb in ("recon", "capture"):
                node.start(verb)
            watched = Watched(node, args)
            watched.run()
            said = read_heartbeats(node.network)
            codes = {verb: node.end(verb) for verb in ("capture", "recon")}
    result = {
        "command": shlex.join(["python", "-m", "tests.bench", "siege", *sys.argv[1:]]),
        **watched.figures(),
        "heartbeats": said,
        "exit_codes": codes,
        "load_average": os.getloadavg()[0],
        "samples": watched.samples,
    }
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps({name: value for name, value in result.items() if name != "samples"}, indent=1))


def over(kind: str, place: Path) -> dict[str, Any] | None:
    """The network of the node; None: ipc in its own folder."""
    if kind == "ipc":
        return None
    create_keys(place / "keys")
    return {"tcp": "127.0.0.1", "keys": str(place / "keys"), "first_port": 47710}


def photograph_walk(folder: Path, count: int) -> None:
    """A walk to and fro on an arc around the corner, never twice at the same place."""
    folder.mkdir(parents=True)
    K = intrinsic_matrix(PICTURE, 0.9 * PICTURE.width)
    for index in range(count):
        way = index / 30.0
        azimuth = np.radians(45 + 30 * np.sin(0.31 * way))
        distance, height = 3.3 + 0.25 * np.sin(0.73 * way), 1.55 + 0.25 * np.sin(1.17 * way + 1.0)
        centre = np.array([TARGET[0] + distance * np.cos(azimuth), TARGET[1] + distance * np.sin(azimuth), height])
        camera = look_at(centre, TARGET + 0.05 * np.sin([way, 1.3 * way, 1.9 * way])), K
        image = render_image(PICTURE, camera, index)
        cv2.imwrite(str(folder / f"walk_{index:05d}.png"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))


class Watched:
    """What somebody who looks on sees of the node, phase by phase."""

    def __init__(self, node: Node, args: argparse.Namespace) -> None:
        self._node, self._args = node, args
        self._waiting: dict[str, tuple[str, int]] = {}  # keyframes by name: phase and time of the preview
        self.previews: dict[str, list[float]] = {kind: [] for kind in KINDS}  # ms
        self.keyframes: dict[str, list[float]] = {kind: [] for kind in KINDS}  # s
        self.overtaken = dict.fromkeys(KINDS, 0)  # keyframes that no scene showed before the next 20
        self.samples: list[dict[str, Any]] = []
        self.lost = 0

    def run(self) -> None:
        """Alternates phases until the time is up."""
        started = time.monotonic()
        with Subscriber(CAPTURE_PREVIEW, self._node.network, PreviewHeader, queue=1000) as previews:
            viewer = Viewer(self._node.network)
            self._watch(previews, viewer, "", SETTLE_S)
            phase = 0
            while time.monotonic() < started + 60 * self._args.minutes:
                kind = KINDS[phase % 2]
                besieger = self._besieger(phase) if kind == "hostile" else None
                self._watch(previews, viewer, kind, self._args.phase_s)
                if besieger is not None:
                    if besieger.poll() is not None:
                        raise AssertionError(f"the hostile client ended by itself, with {besieger.returncode}")
                    besieger.kill()
                    besieger.wait(10)
                phase += 1
            self.lost = previews.lost
            viewer.close()

    def figures(self) -> dict[str, Any]:
        found: dict[str, Any] = {"seconds": self.samples[-1]["at_s"], "previews_lost": self.lost}
        for name, values in (("preview_ms", self.previews), ("keyframe_s", self.keyframes)):
            rows = {kind: spread(values[kind]) for kind in KINDS}
            found[name] = rows
            found[f"{name}_hostile_over_quiet"] = {
                figure: rows["hostile"][figure] / rows["quiet"][figure] for figure in ("p50", "p95", "p99")
            }
        found["keyframes_overtaken"] = self.overtaken
        for figure in ("capture_mb", "recon_mb", "capture_descriptors", "recon_descriptors"):
            found[f"change_of_{figure}"] = change([each for each in self.samples if each["phase"] == "quiet"], figure)
        return found

    def _besieger(self, seed: int) -> subprocess.Popen:
        config = self._node.folder / "besieged.yaml"
        config.write_text(yaml.safe_dump(self._node.configs["capture"]["network"]))
        command = [
            sys.executable,
            "-m",
            "tests.bench.node.besieger",
            str(config),
            str(self._args.per_second),
            str(seed),
        ]
        return subprocess.Popen(command, cwd=ROOT)

    def _watch(self, previews: Subscriber, viewer: Viewer, kind: str, seconds: float) -> None:
        started = time.monotonic()
        next_sample = started
        while time.monotonic() < started + seconds:
            preview = previews.latest(0.02)
            if preview is not None and kind:
                self.previews[kind].append((time.monotonic_ns() - preview.header.mono_ns) / 1e6)
                if preview.header.taken:
                    self._waiting[preview.header.name] = kind, preview.header.mono_ns
            self._hear(viewer)
            if time.monotonic() >= next_sample:
                next_sample += SAMPLE_S
                self.samples.append({"at_s": time.monotonic(), "phase": kind} | sample(self._node))

    def _hear(self, viewer: Viewer) -> None:
        scene = viewer.hear(0.0)
        if scene is None:
            return
        for camera in scene.snapshot.cameras:
            kind, since_ns = self._waiting.pop(camera.name, ("", 0))
            if kind:
                self.keyframes[kind].append((time.monotonic_ns() - since_ns) / 1e9)
        for name in list(self._waiting)[:-20]:
            self.overtaken[self._waiting.pop(name)[0]] += 1


def spread(values: list[float]) -> dict[str, float]:
    return {"count": len(values)} | {f"p{p}": float(np.percentile(values, p)) for p in (50, 95, 99)}


if __name__ == "__main__":
    main()
