"""A long walk through the built-in building: `python -m tests.bench building --keyframes 1000 --per-second 0.5`.

Capture's camera is `kind: building`; capture and recon run as they do on a robot. While the robot walks, recon's
heartbeat, memory and processor time are sampled. When all scenes are finished, they are compared with what is known of
the walk: how far the cameras of each map are from the true ones, which of the revisits were recognised, and which links
between scenes are wrong. The scene of the first room is scored on photographs that were held out.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np

from splatnode.capture.status import read_heartbeats
from splatnode.extras.cameras import building
from splatnode.recon.result.export import read_cameras
from tests.bench.node.building_cost import Sample, cost_row, folder_mb
from tests.bench.node.building_score import camera_rows, loop_row, maps
from tests.bench.node.first_room import first_room
from tests.support.node import Node, at_rest, memory_mb, processor_s, running, taken

LOOK_S = 1.0
RESTS = 5  # looks in a row at which recon has nothing to do: then it is done
ALONE_S = 5.0  # of recon, before the camera starts: it loads torch
FARTHEST_M = 6.0  # cameras farther apart are not asked whether they show the same place


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int, default=1000)
    parser.add_argument("--per-second", type=float, default=0.5, help="keyframes")
    parser.add_argument("--size", type=int, default=480, help="pixels, the photographs' width")
    parser.add_argument("--seed", type=int, default=0, help="of the building and of the walk")
    parser.add_argument(
        "--kidnap-at", type=int, default=0, help="keyframe at which the robot is carried away; 0: never"
    )
    parser.add_argument(
        "--patience-s", type=float, default=1800.0, help="after the last keyframe, until all is finished"
    )
    parser.add_argument("--max-views", type=int, help="of a scene; default: recon's")
    parser.add_argument("--folder", type=Path, help="for what the processes write, to be kept; it must not exist")
    parser.add_argument("--score", type=Path, metavar="FOLDER", help="only scores what an earlier walk left there")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/building.json"))
    args = parser.parse_args()
    config = building.Config(
        keyframes=args.keyframes, width=args.size, height=args.size * 3 // 4, seed=args.seed, kidnap_at=args.kidnap_at,
        fps=args.per_second, pace="recorded",
    )  # fmt: skip
    recon = {} if args.max_views is None else {"max_views": args.max_views}
    told = (Path(each).name if each.startswith("/") else each for each in sys.argv[1:])  # no path of this machine
    command = shlex.join(["python", "-m", "tests.bench", "building", *told])
    if args.score is not None:
        found = scored(config, args.score / "node" / "out", args.score)
        states = Counter(place["state"] for place in found.pop("places"))
        result = {"command": command, "keyframes": config.keyframes, **found, "states": states}
        args.out.write_text(json.dumps(result, indent=1) + "\n")
        print(json.dumps(result))
        return
    with contextlib.ExitStack() as stack:
        folder = args.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        row, out = walked(folder, config, recon, args.patience_s)
        result = {"command": command, **row}
        args.out.write_text(
            json.dumps(result, indent=1) + "\n"
        )  # a walk is long: what it cost is kept whatever follows
        result |= scored(config, out, folder)
        args.out.write_text(json.dumps(result, indent=1) + "\n")
    brief = {key: value for key, value in result.items() if key not in ("cost", "places")}
    print(json.dumps(brief | {"cost": {key: value for key, value in row["cost"].items() if key != "samples"}}))


def walked(folder: Path, config: building.Config, recon: dict, patience_s: float) -> tuple[dict, Path]:
    """What was measured while the robot walked, and the folder of the results."""
    camera = {key: getattr(config, key) for key in config.__struct_fields__}
    capture = {
        "camera": {"kind": "building", **camera},
        "selection": {"every_frame": True},
        "spool": {"directory": str(folder / "node"), "max_frames": config.keyframes + 10, "max_mb": 20_000},
    }
    with running(Node(folder / "node", capture, recon)) as node:
        pid = node.start("recon").pid
        time.sleep(ALONE_S)
        node.start("capture")
        began, samples = time.monotonic(), []
        taken_s, finished_s, resting = None, None, 0
        last_s = config.keyframes / config.fps
        while finished_s is None and time.monotonic() - began < last_s + patience_s:
            time.sleep(LOOK_S)
            if node.processes["recon"].poll() is not None:
                break  # its exit code tells
            found = read_heartbeats(node.network)
            capture_status, recon_status = found["capture"], found["recon"]
            if recon_status is None:
                continue
            samples.append(_sample(node, pid, time.monotonic() - began, recon_status))
            done = taken(capture_status)
            if done and taken_s is None:
                taken_s = time.monotonic() - began
            resting = resting + 1 if done and at_rest(recon_status) else 0
            if resting == RESTS:
                finished_s = time.monotonic() - began
        codes = {verb: node.end(verb) for verb in ("capture", "recon")}
        row = {
            "keyframes": config.keyframes, "per_second": config.fps, "width": config.width,
            "taken_s": taken_s, "all_finished_s": finished_s, "exit_codes": codes, "cost": cost_row(samples),
            "load_average": os.getloadavg()[0],
        }  # fmt: skip
        return row, node.out


def _sample(node: Node, pid: int, second: float, status: Mapping) -> Sample:
    acknowledged = status["keyframe"] + 1
    checkpoint = Path(node.configs["recon"]["checkpoint"])
    return Sample(
        second=second, acknowledged=acknowledged, done=acknowledged - status["queue"], processor_s=processor_s(pid),
        rss_mb=memory_mb(pid), delay_s=status["delay_s"], checkpoint_mb=folder_mb(checkpoint),
    )  # fmt: skip


def scored(config: building.Config, out: Path, folder: Path) -> dict:
    """The scenes in `out` against the truth."""
    index = json.loads((out / "places.json").read_text())
    folders = {place["scene_id"]: out / place["folder"] for place in index["places"] if place["folder"]}
    found = {
        scene: {
            building.frame_index(camera.name): camera.T_world_camera for camera in read_cameras(path / "cameras.json")
        }
        for scene, path in folders.items()
        if (path / "cameras.json").exists()
    }

    @cache
    def truth(keyframe: int) -> np.ndarray:
        return building.scene_camera(config, keyframe)[0]

    @cache
    def same_place(first: int, second: int) -> bool:
        a, b = truth(first), truth(second)
        near = np.linalg.norm(a[:3, 3] - b[:3, 3]) < FARTHEST_M and a[:3, 2] @ b[:3, 2] > 0
        return bool(near) and building.same_place(config, first, second)

    joined = maps(index, list(found))
    in_a_scene = {keyframe for cameras in found.values() for keyframe in cameras}
    rows = camera_rows(found, joined, truth)
    return {
        "scenes": len(found),
        "maps": len({name for name, _ in joined.of.values()}),
        "in_a_scene": len(in_a_scene),
        "in_a_scene_percent": 100 * len(in_a_scene) / config.keyframes,
        "in_no_scene": sorted(set(range(config.keyframes)) - in_a_scene),
        "cameras_by_map": rows,
        "cameras": _over_all(rows),
        "loops": loop_row(found, joined, index["links"], truth, same_place),
        "first_room": first_room(config, index["places"], folders, found, folder),
        "places": index["places"],
    }


def _over_all(rows: list[dict]) -> dict:
    """The errors of all maps: of positions in the mean by keyframes, of rotations the worst."""
    weights = [row["keyframes"] for row in rows]
    if not rows:
        return {}
    return {
        "position_percent_of_path": float(
            np.average([row["position_percent_of_path"] for row in rows], weights=weights)
        ),
        "rotation_deg_most": max(row["rotation_deg_most"] for row in rows),
        "path_m": sum(row["path_m"] for row in rows),
    }
