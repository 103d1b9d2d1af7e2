"""Faults in the middle of a long walk: `python -m tests.bench walk_faults --times 5`.

A robot walks through the built-in building, from scene to scene, and one fault after the other befalls its node, each
while keyframes come. The node is not made anew in between, as it is in `tests.bench faults`. Good is a fault after
which the node goes on. In the end every photograph must be in a scene, or in places.json with the reason why it is not,
and the cameras are compared with the true ones.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shlex
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import msgspec

from splatnode.capture.messaging.network import create_keys, expect_server
from splatnode.capture.status import read_heartbeats
from splatnode.extras.cameras import building
from tests.bench.node import on_the_way
from tests.bench.node.building import scored
from tests.bench.node.on_the_way import Way
from tests.bench.node.shortages import small_disk
from tests.bench.node.trial import NotTried, expect, wait_for
from tests.support.node import Node, at_rest, running

BEFORE = 30  # photographs before the first fault
SIDE = 320  # of a photograph, pixels
MOST_KEYFRAMES = 2000
RECON = {
    "max_views": 12,
    "export_interval_s": 5.0,
    "idle_finalize_s": 1.0,
    "tracking": {"interval_s": 0},
    "reconstruction": {
        "size": 256,
        "matching": {"features": {"max_num_features": 4000, "min_longer_side": 640}},
        "preview": {"iterations": 5, "half_resolution_share": 1.0},
        "optimize": {"iterations": 20, "checkpoints": [10]},
    },
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=5, help="that each fault is done")
    parser.add_argument("--seed", type=int, default=0, help="of the building and of the faults")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/walk_faults.json"))
    args = parser.parse_args()
    chance = random.Random(args.seed)
    faults = [fault for _ in range(args.times) for fault in chance.sample(on_the_way.FAULTS, len(on_the_way.FAULTS))]
    walk = building.Config(
        keyframes=MOST_KEYFRAMES, width=SIDE, height=SIDE * 3 // 4, seed=args.seed, samples=1, fps=2.0
    )
    rows: dict[str, dict[str, Any]] = {}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        disk = stack.enter_context(small_disk(folder / "disk", on_the_way.ROOM))
        way = _begun(folder, disk, walk, chance)
        with running(way.node):
            for fault in faults:
                _befall(way, fault, rows.setdefault(fault.__name__, {"tried": 0, "good": 0, "failures": []}))
            result = _ended(way, walk)
    command = shlex.join(["python", "-m", "tests.bench", "walk_faults", *sys.argv[1:]])
    args.out.write_text(json.dumps({"command": command, **result, "faults": rows}, indent=1) + "\n")
    print(json.dumps({key: value for key, value in result.items() if key != "places"}))
    sys.exit(bool(result["in_no_list"]) or any(row["good"] < row["tried"] for row in rows.values()))


def _begun(folder: Path, disk: Path, walk: building.Config, chance: random.Random) -> Way:
    """The node, which has worked in the first photographs; others may reach it only with a key."""
    images, keys, stranger = folder / "images", folder / "keys", folder / "stranger"
    images.mkdir()
    public = create_keys(keys)
    create_keys(stranger)
    for each in (keys, stranger):
        expect_server(each, public)
    network = {"tcp": "127.0.0.1", "keys": str(keys), "first_port": chance.randrange(20000, 30000)}
    capture = {"camera": {"kind": "watched", "folder": str(images)}, "selection": {"every_frame": True}}
    node = Node(folder / "node", capture, RECON | {"checkpoint": str(disk / "checkpoint")}, network)

    def photograph(number: int) -> Path:
        path = folder / building.frame_name(number)
        cv2.imwrite(str(path), cv2.cvtColor(building.render_image(walk, number), cv2.COLOR_RGB2BGR))
        return path

    way = Way(node, images, disk, network, stranger, chance, photograph)
    node.start("recon")
    node.start("capture")
    way.show(BEFORE)
    way.wait_until_worked_in()
    return way


def _befall(way: Way, fault: on_the_way.Fault, row: dict[str, Any]) -> None:
    """One fault, and what the node does after it."""
    started = time.monotonic()
    way.show(on_the_way.BETWEEN)
    time.sleep(way.chance.uniform(0, 3.0))
    row["tried"] += 1
    try:
        fault(way)
        way.show(1)
        way.wait_until_worked_in()
        row["good"] += 1
    except NotTried as reason:
        row["tried"] -= 1
        row["not_tried"] = str(reason)
    except (AssertionError, subprocess.TimeoutExpired) as error:
        row["failures"].append({"photograph": way.shown, "why": str(error), "log": way.node.log("recon")[-3000:]})
        way.restart()
    seconds = time.monotonic() - started
    print(
        f"{fault.__name__}: {row['good']} of {row['tried']} good, {way.shown} photographs, {seconds:.0f} s", flush=True
    )


def _ended(way: Way, walk: building.Config) -> dict[str, Any]:
    """What became of each photograph, once the node has nothing to do; and how true the cameras are."""
    node = way.node

    def idle() -> bool:
        recon = read_heartbeats(node.network)["recon"]
        return recon is not None and at_rest(recon)

    wait_for(idle, "rest of recon", 3600.0)
    codes = {verb: node.end(verb) for verb in ("capture", "recon")}
    expect(not node.half_written, f"half-written files: {node.half_written}")
    index = json.loads((node.out / "places.json").read_text())
    used = {name for place in index["places"] for name in place["frames_used"]}
    dropped = {each["name"]: each["reason"] for place in index["places"] for each in place["frames_dropped"]}
    shown = {building.frame_name(number) for number in range(way.shown)}
    return {
        "photographs": way.shown,
        "in_a_scene": len(shown & used),
        "left_out_by_name": {name: reason for name, reason in dropped.items() if name not in used},
        "in_no_list": sorted(shown - used - set(dropped)),
        "exit_codes": codes,
        "load_average": os.getloadavg()[0],
        **scored(msgspec.structs.replace(walk, keyframes=way.shown), node.out, node.folder),
    }
