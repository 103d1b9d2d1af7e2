"""How soon the node shows what its camera sees: `python -m tests.bench live fox llff_flower tum_fr3_office`.

Twelve photographs of a scene are replayed through the real processes, capture and recon over ipc, at a pace. Timed by
one that looks on like a viewer: from the moment when capture says that it took a photograph (its preview) to the first
scene that has its camera. The final scene is scored on the held-out views, as is that of an offline run on the same
photographs. Processor seconds are recon's; together with the load they tell what a quiet machine would show.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from splatnode.capture.config import PreviewHeader
from splatnode.capture.messaging.network import CAPTURE_PREVIEW
from splatnode.capture.messaging.pubsub import Subscriber
from splatnode.extras.evaluate.dataset import EvaluationScene, Split, load_scene, load_split
from splatnode.extras.evaluate.protocol import PerceptualNetworks, Run, Settings, evaluate
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.pipeline import reconstruct
from splatnode.recon.rasterize import rasterize_on_cpu
from splatnode.recon.result.snapshot import Snapshot
from tests.support.node import PATIENCE_S, Node, Viewer, processor_s, running

SETTINGS = Settings(alignment_steps=150)
ALONE_S = 5.0  # of recon, before the camera starts: it loads torch


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", help="names in the folder of scenes")
    parser.add_argument("--folder", type=Path, default=Path(os.environ.get("SPLATNODE_SHARED", "../shared")) / "scenes")
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--per-second", type=float, default=0.5, help="photographs; default: one every two seconds")
    parser.add_argument("--no-offline", action="store_true", help="do not compare with an offline run")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/live.json"))
    args = parser.parse_args()
    rows = []
    for name in args.scenes:
        scene = load_scene(args.folder / name)
        split = load_split(args.folder / name, list(scene.paths), args.views)
        row, live = replay(scene, split, args.folder / name / "images", args.per_second)
        row |= {"scene": name, "live_psnr": psnr(live, scene, split)}
        if not args.no_offline:
            *_, offline = reconstruct(list(scene.frames(split.train)), ReconstructionConfig())
            row |= {"offline_psnr": psnr(offline, scene, split), "offline_gaussians": len(offline.gaussians)}
        rows.append(row)
        print(json.dumps(row), flush=True)
        result = {"command": shlex.join(["python", "-m", "tests.bench", "live", *sys.argv[1:]]), "rows": rows}
        args.out.write_text(json.dumps(result, indent=1) + "\n")


def replay(
    scene: EvaluationScene, split: Split, images: Path, per_second: float
) -> tuple[dict[str, object], Snapshot | None]:
    """What was timed, and the final snapshot."""
    camera = {
        "camera": {
            "kind": "folder",
            "folder": str(images.resolve()),
            "names": list(split.train),
            "fps": per_second,
            "pace": "recorded",
        },
        "selection": {"every_frame": True},
    }
    taken: dict[str, float] = {}
    shown: dict[str, float] = {}
    last = None
    with tempfile.TemporaryDirectory() as folder, running(Node(Path(folder) / "node", camera)) as node:
        pid = node.start("recon").pid
        viewer = Viewer(node.network)
        with Subscriber(CAPTURE_PREVIEW, node.network, PreviewHeader) as previews:
            time.sleep(ALONE_S)
            before_s = processor_s(pid)
            node.start("capture")
            growing_s, deadline = None, time.monotonic() + PATIENCE_S + len(split.train) / per_second
            while time.monotonic() < deadline and not (last and last.final and len(shown) >= len(split.train)):
                preview = previews.latest(0.01)
                if preview is not None and preview.header.taken:
                    taken.setdefault(preview.header.name, time.monotonic())
                heard = viewer.hear(0.02)
                if heard is None:
                    continue
                last = heard.snapshot
                for each in last.cameras:
                    shown.setdefault(each.name, time.monotonic())
                if len(shown) == len(split.train) and growing_s is None:
                    growing_s = processor_s(pid) - before_s
            final_s = processor_s(pid) - before_s
        viewer.close()
        codes = {verb: node.end(verb) for verb in ("capture", "recon")}
    names = list(taken)
    delays = {name: shown[name] - taken[name] for name in names if name in shown}
    further = [delays[name] for name in names[3:] if name in delays]
    row: dict[str, object] = {
        "views": len(split.train),
        "per_second": per_second,
        "taken": len(taken),
        "shown": len(shown),
        "first_scene_s": delays.get(names[2]) if len(names) > 2 else None,
        "further_s": further,
        "further_s_p95": float(np.percentile(further, 95)) if further else None,
        "processor_s_until_all_shown": growing_s,
        "processor_s_until_final": final_s,
        "final": bool(last and last.final),
        "verdict": last.verdict.code.value if last else None,
        "gaussians": len(last.gaussians) if last else 0,
        "exit_codes": codes,
        "load_average": os.getloadavg()[0],
        "processors": os.cpu_count(),
    }
    return row, last


def psnr(snapshot: Snapshot | None, scene: EvaluationScene, split: Split) -> float | None:
    """Mean over the held-out views, dB."""
    if snapshot is None:
        return None
    nowhere = Run("live", 0, None, {}, None)
    networks = PerceptualNetworks(alex=None, vgg=None)
    return evaluate(
        snapshot, scene, split, nowhere, rasterize=rasterize_on_cpu, networks=networks, settings=SETTINGS
    ).psnr
