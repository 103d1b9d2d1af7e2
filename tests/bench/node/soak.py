"""An hour of replay at 30 frames a second:
`python -m tests.bench soak IMAGES --minutes 60` replays a folder over and over, 30 frames a second.

Every few seconds: memory and open descriptors of capture and recon; in the end, what both say of themselves. The
latency of a preview is the time from its sending to its arrival here. Memory is flat where the median of the last
quarter is within 5 % of that of the second quarter: in the first one the scene grows.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from splatnode.capture.config import PreviewHeader
from splatnode.capture.messaging.network import CAPTURE_PREVIEW
from splatnode.capture.messaging.pubsub import Subscriber
from splatnode.capture.status import read_heartbeats
from tests.support.node import Node, descriptors, memory_mb, running

SAMPLE_S = 5.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", type=Path, help="a folder of photographs of one place, in the order of a walk")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--per-second", type=float, default=30.0)
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/soak.json"))
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, running(Node(Path(folder) / "node", camera(args))) as node:
        for verb in ("recon", "capture"):
            node.start(verb)
        latencies, lost, samples = watch(node, args.minutes * 60)
        said = read_heartbeats(node.network)
        waiting = node.spooled()
        codes = {verb: node.end(verb) for verb in ("capture", "recon")}
    result = {
        "command": shlex.join(["python", "-m", "tests.bench", "soak", *sys.argv[1:]]),
        "seconds": samples[-1]["at_s"],
        "memory_change": {verb: change(samples, f"{verb}_mb") for verb in codes},
        "descriptor_change": {verb: change(samples, f"{verb}_descriptors") for verb in codes},
        "preview_latency_ms": {f"p{p}": float(np.percentile(latencies, p)) for p in (50, 99, 100)},
        "previews": len(latencies),
        "previews_lost": lost,
        "keyframes_waiting": waiting,
        "heartbeats": said,
        "exit_codes": codes,
        "load_average": os.getloadavg()[0],
        "samples": samples,
    }
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps({name: value for name, value in result.items() if name != "samples"}, indent=1))


def camera(args: argparse.Namespace) -> dict[str, Any]:
    count = len([path for path in args.images.iterdir() if path.is_file()])
    return {
        "camera": {
            "kind": "folder",
            "folder": str(args.images.resolve()),
            "fps": args.per_second,
            "pace": "recorded",
            "loops": 2 + int(args.minutes * 60 * args.per_second / max(1, count)),
        }
    }


def watch(node: Node, seconds: float) -> tuple[list[float], int, list[dict[str, Any]]]:
    """Latencies of previews in ms, how many got lost, and a sample of the processes every few seconds."""
    latencies: list[float] = []
    samples: list[dict[str, Any]] = []
    started = next_sample = time.monotonic()
    with Subscriber(CAPTURE_PREVIEW, node.network, PreviewHeader) as previews:
        while time.monotonic() < started + seconds or not samples:
            preview = previews.latest(0.05)
            if preview is not None:
                latencies.append((time.monotonic_ns() - preview.header.mono_ns) / 1e6)
            if time.monotonic() >= next_sample:
                next_sample += SAMPLE_S
                samples.append({"at_s": time.monotonic() - started} | sample(node))
        return latencies, previews.lost, samples


def sample(node: Node) -> dict[str, Any]:
    figures: dict[str, Any] = {}
    for verb, process in node.processes.items():
        figures |= {f"{verb}_mb": memory_mb(process.pid), f"{verb}_descriptors": descriptors(process.pid)}
    return figures


def change(samples: list[dict[str, Any]], name: str) -> float | None:
    """The last quarter's median over the second quarter's, less 1."""
    values = [each[name] for each in samples]
    quarter = len(values) // 4
    if quarter == 0:
        return None
    return statistics.median(values[-quarter:]) / statistics.median(values[quarter : 2 * quarter]) - 1.0
