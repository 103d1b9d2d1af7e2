"""kill -9 at random moments: `python -m tests.bench kills --minutes 10`.

A robot walks through the built-in building. All the time one of its two processes is killed with -9, at once started
anew, and killed again, from the first moment of its start on; no disk is full and the spool has room for all. Beside it
an undisturbed node sees the same photographs. In the end every keyframe that capture said it had must be in a scene, or
in places.json with the reason why it is not, and each place to which the undisturbed node gives a scene must have one.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shlex
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2

from splatnode.capture.status import read_heartbeats
from splatnode.extras.cameras import building
from tests.bench.node.trial import expect_exports_whole
from tests.bench.node.walk_faults import RECON, SIDE
from tests.support.node import Node, running

BEFORE = 8  # photographs before the first kill
EVERY_S = 10.0  # between photographs
LONGEST_LIFE_S = 6.5  # of the two processes, from one kill to the next
RECON_SHARE = 0.4  # of the kills: its start takes longer, and it must get on
BUSY = ("loading", "growing", "refining", "full")  # states of recon; it may also wait for photographs, or be lost
RESTS = 5  # looks in a row at which there is nothing to do
_KEYFRAME = re.compile(r"event=keyframe name=(\S+)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0, help="of the building and of the kills")
    parser.add_argument("--patience-s", type=float, default=1800.0, help="until both nodes have nothing to do")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/kills.json"))
    args = parser.parse_args()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        walk = Walk(folder, args.seed)
        nodes = {name: stack.enter_context(running(walk.node(name))) for name in ("killed", "undisturbed")}
        walk.show(BEFORE)
        for node in nodes.values():
            node.start("recon")
            node.start("capture")
        kills = killed(nodes["killed"], walk, random.Random(args.seed), 60 * args.minutes)
        print(json.dumps(kills), flush=True)
        rested = {name: rests(node, args.patience_s) for name, node in nodes.items()}
        codes = {name: {verb: node.end(verb) for verb in ("capture", "recon")} for name, node in nodes.items()}
        expect_exports_whole(nodes["killed"])
        result = {
            "command": shlex.join(["python", "-m", "tests.bench", "kills", *sys.argv[1:]]),
            "minutes": args.minutes, "kills": kills, "photographs": walk.shown, "came_to_rest": rested,
            "exit_codes": codes, **compared(nodes["killed"], nodes["undisturbed"]),
            "half_written": len(nodes["killed"].half_written), "load_average": os.getloadavg()[0],
        }  # fmt: skip
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result))
    sys.exit(bool(result["lost"] or result["places_without_a_scene"] or not all(rested.values())))


class Walk:
    """Photographs of a walk, which both nodes get at the same time."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.shown = 0
        self._folder = folder
        self._config = building.Config(keyframes=400, width=SIDE, height=SIDE * 3 // 4, seed=seed, samples=1, fps=2.0)

    def node(self, name: str) -> Node:
        images = self._folder / f"{name}_images"
        images.mkdir()
        capture = {"camera": {"kind": "watched", "folder": str(images)}, "selection": {"every_frame": True}}
        return Node(self._folder / name, capture, RECON)

    def show(self, count: int) -> None:
        for _ in range(count):
            path = self._folder / building.frame_name(self.shown)
            cv2.imwrite(str(path), cv2.cvtColor(building.render_image(self._config, self.shown), cv2.COLOR_RGB2BGR))
            for images in sorted(self._folder.glob("*_images")):
                shutil.copy(path, images / f"{path.name}.part")
                (images / f"{path.name}.part").rename(images / path.name)
            self.shown += 1


def killed(node: Node, walk: Walk, chance: random.Random, seconds: float) -> dict[str, Any]:
    """Kills for so long; how often, whom, and how many keyframes waited in the spool at the most."""
    began, counts, most_waiting = time.monotonic(), Counter[str](), 0
    while time.monotonic() - began < seconds:
        time.sleep(chance.uniform(0.0, LONGEST_LIFE_S))
        while walk.shown < BEFORE + (time.monotonic() - began) / EVERY_S:
            walk.show(1)
        verb = "recon" if chance.random() < RECON_SHARE else "capture"
        most_waiting = max(most_waiting, node.spooled())
        if node.processes[verb].poll() is not None:
            counts[f"{verb} had ended with {node.processes[verb].poll()}"] += 1
        node.end(verb, signal.SIGKILL)
        counts[verb] += 1
        if verb == "capture":
            _take_away(node)
        node.start(verb)
    return {"together": counts["recon"] + counts["capture"], **counts, "most_waiting": most_waiting}


def _take_away(node: Node) -> None:
    """The photographs of which capture has said that they are keyframes, which it would else take again."""
    images = Path(node.configs["capture"]["camera"]["folder"])
    for name in _said(node):
        (images / name).unlink(missing_ok=True)


def _said(node: Node) -> set[str]:
    """The keyframes that capture has said to have: they are on its disk then."""
    return set(_KEYFRAME.findall(node.log("capture")))


def rests(node: Node, patience_s: float) -> bool:
    """Whether there comes to be nothing to do for the node."""
    deadline, resting = time.monotonic() + patience_s, 0
    while resting < RESTS and time.monotonic() < deadline:
        found = read_heartbeats(node.network)
        capture, recon = found["capture"], found["recon"]
        has_all = capture is not None and not capture["waiting"] and capture["state"] != "starting"
        idle = recon is not None and not recon["unfinished"] and not recon["queue"] and recon["state"] not in BUSY
        resting = resting + 1 if idle and (has_all or not node.spooled()) else 0
        time.sleep(1.0)
    return resting == RESTS


def compared(node: Node, undisturbed: Node) -> dict[str, Any]:
    """What became of the keyframes, and which scenes there are not."""
    used, dropped, places = _told(node)
    true_used, _, true_places = _told(undisturbed)
    said = _said(node)
    without = [sorted(each) for each in true_places if each and not each & used]
    return {
        "keyframes": len(said),
        "in_a_scene": len(said & used),
        "left_out_by_name": {name: reason for name, reason in dropped.items() if name not in used},
        "lost": sorted(said - used - set(dropped)),
        "scenes": sum(map(bool, places)),
        "undisturbed": {"in_a_scene": len(true_used), "scenes": sum(map(bool, true_places))},
        "places_without_a_scene": without,
    }


def _told(node: Node) -> tuple[set[str], dict[str, str], list[set[str]]]:
    """Photographs in scenes, those that were left out and why, and the photographs of each place's scene."""
    places = json.loads((node.out / "places.json").read_text())["places"]
    scenes = [set(place["frames_used"]) if place["folder"] else set() for place in places]
    dropped = {each["name"]: each["reason"] for place in places for each in place["frames_dropped"]}
    return {name for each in scenes for name in each}, dropped, scenes


if __name__ == "__main__":
    main()
