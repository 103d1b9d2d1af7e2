"""A film of the built-in building, live and offline: `python -m tests.bench film --keyframes 300`.

Live, capture plays the film at its pace and recon works until every scene is final. Offline, `replay --map` makes one
map of the same film. The processor time of both is compared, and the cameras of both with the true ones.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shlex
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2

from splatnode.capture.status import read_heartbeats
from splatnode.extras.cameras import building
from tests.bench.node.building import LOOK_S, RESTS, scored
from tests.support.node import Node, at_rest, memory_mb, processor_s, running, taken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int, default=300, help="frames of the film")
    parser.add_argument("--per-second", type=float, default=1.0, help="frames")
    parser.add_argument("--size", type=int, default=480, help="pixels, the film's width")
    parser.add_argument("--seed", type=int, default=0, help="of the building and of the walk")
    parser.add_argument("--patience-s", type=float, default=3600.0, help="after the film, until all is finished")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/film.json"))
    args = parser.parse_args()
    walk = building.Config(
        keyframes=args.keyframes, width=args.size, height=args.size * 3 // 4, seed=args.seed, samples=1,
        fps=args.per_second,
    )  # fmt: skip
    command = shlex.join(["python", "-m", "tests.bench", "film", *sys.argv[1:]])
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder, "keyframe.mp4")  # so that a frame is named as a keyframe of the walk is
        filmed(walk, film)
        result: dict[str, Any] = {"command": command, "frames": args.keyframes, "megabytes": film.stat().st_size / 1e6}
        for name, run in (("live", live), ("offline", offline)):
            result[name] = run(film, Path(folder, name), walk, args.patience_s)
            args.out.write_text(json.dumps(result, indent=1) + "\n")  # each takes long, and is kept whatever follows
        result["offline_over_live"] = result["offline"]["processor_s"] / result["live"]["processor_s"]
        result["load_average"] = os.getloadavg()[0]
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result))


def filmed(walk: building.Config, path: Path) -> None:
    """The photographs of the walk as a video."""
    size = walk.width, walk.height
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), walk.fps, size)
    for number in range(walk.keyframes):
        writer.write(cv2.cvtColor(building.render_image(walk, number), cv2.COLOR_RGB2BGR))
    writer.release()


def live(film: Path, folder: Path, walk: building.Config, patience_s: float) -> dict[str, Any]:
    """The film through the node's real processes, until every scene is final."""
    camera = {
        "camera": {"kind": "video", "file": str(film), "pace": "recorded"},
        "spool": {"directory": str(folder / "node"), "max_frames": walk.keyframes + 10, "max_mb": 20_000},
    }
    with running(Node(folder / "node", camera)) as node:
        pid = node.start("recon").pid
        node.start("capture")
        began, resting, peak_mb, spent_s = time.monotonic(), 0, 0.0, 0.0
        limit_s = walk.keyframes / walk.fps + patience_s
        while resting < RESTS and time.monotonic() - began < limit_s and node.processes["recon"].poll() is None:
            time.sleep(LOOK_S)
            found = read_heartbeats(node.network)
            peak_mb, spent_s = max(peak_mb, memory_mb(pid)), processor_s(pid)
            done = taken(found["capture"]) and found["recon"] is not None and at_rest(found["recon"])
            resting = resting + 1 if done else 0
        codes = {verb: node.end(verb) for verb in ("capture", "recon")}
        told = {"all_finished": resting == RESTS, "exit_codes": codes, "peak_mb": peak_mb, "processor_s": spent_s}
        return told | {"seconds": time.monotonic() - began} | _brief(walk, node.out, folder)


def offline(film: Path, folder: Path, walk: building.Config, patience_s: float) -> dict[str, Any]:
    """`replay --map` of the film."""
    folder.mkdir()
    out = folder / "out"
    command = [sys.executable, "-m", "splatnode", "replay", str(film), "--map", "--out", str(out)]
    with running(Node(folder / "node", {})) as node:
        began, before = time.monotonic(), _children_s()
        code = node.run("replay", command).wait(patience_s)
        told = {"exit_code": code, "processor_s": _children_s() - before, "seconds": time.monotonic() - began}
        return told | _brief(walk, out, folder)


def _children_s() -> float:
    """Seconds of processor time that processes which have ended used."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def _brief(walk: building.Config, out: Path, folder: Path) -> dict[str, Any]:
    """Of the scenes in `out` against the truth."""
    found = scored(walk, out, folder)
    places = found["places"]
    keyframes = {name for place in places for name in place["frames_used"]}
    keyframes |= {each["name"] for place in places for each in place["frames_dropped"]}
    kept = ("scenes", "maps", "in_a_scene", "cameras", "loops", "first_room")
    return {"keyframes": len(keyframes)} | {key: found[key] for key in kept}
