"""A robot that goes from place to place: `python -m tests.bench stream castle_p30 fox --per-second 0.33`.

The photographs of several scenes, one scene after the other, are replayed through the real processes, without those
that are held out. When all places are finished, each is scored on its held-out photographs, as is an offline run on the
same photographs, and what became of every photograph is counted. The cameras of a place that became several scenes are
compared with the true ones by way of the links between its scenes. While the robot moves, the delay of the picture
behind the photographs is read from recon's heartbeat. With --and-back the robot goes the same way back, on which the
photographs come that were held out: each place should be recognised, and none be joined with another.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatnode.capture.status import read_heartbeats
from splatnode.extras.evaluate.dataset import EvaluationScene, Split, load_scene
from splatnode.extras.evaluate.protocol import compare_cameras
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.geometry import Similarity
from splatnode.recon.pipeline import reconstruct
from splatnode.recon.result.export import read_cameras, read_gaussians
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from tests.bench.node.live import psnr
from tests.support.node import Node, at_rest, memory_mb, running, taken

PATIENCE_S = 1800.0  # after the last photograph
LOOK_S = 1.0
RESTS = 5  # looks in a row at which recon has nothing to do: then it is done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", help="names in the folder of scenes")
    parser.add_argument("--folder", type=Path, default=Path(os.environ.get("SPLATNODE_SHARED", "../shared")) / "scenes")
    parser.add_argument("--per-second", type=float, default=0.33, help="photographs")
    parser.add_argument("--max-views", type=int, default=30, help="of a scene; a place with more is a chain of scenes")
    parser.add_argument("--hold-out", type=int, default=3, help="one photograph in so many; 0: none")
    parser.add_argument("--and-back", action="store_true", help="with those that were held out, the last one first")
    parser.add_argument("--until-judged", action="store_true", help="end when all places are, final or not")
    parser.add_argument("--no-offline", action="store_true", help="do not compare with offline runs")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/stream.json"))
    args = parser.parse_args()
    scenes = {name: load_scene(args.folder / name) for name in args.scenes}
    splits = {name: _split(scene, args.hold_out) for name, scene in scenes.items()}
    with tempfile.TemporaryDirectory() as folder:
        names = [f"{name}__{photograph}" for name in scenes for photograph in splits[name].train]
        back = [f"{name}__{photograph}" for name in scenes for photograph in splits[name].test]
        names += reversed(back) if args.and_back else []
        names = [f"{number:04d}__{name}" for number, name in enumerate(names)]  # they come in the order of their names
        live, places = _streamed(Path(folder), scenes, names, args)
    if args.and_back:
        live["visits"] = _visits(places, live["poses"], splits)
    live["cameras"] = {name: _camera_errors(name, scene, places, live["poses"]) for name, scene in scenes.items()}
    for name, scene in scenes.items():
        for place in places:
            snapshot = place["snapshot"]
            if (
                args.hold_out
                and not args.and_back
                and snapshot is not None
                and snapshot.cameras
                and _source(place) == name
            ):
                place["psnr"] = psnr(_of(name, snapshot), scene, splits[name])
        if not args.no_offline:
            *_, offline = reconstruct(
                list(scene.frames(splits[name].train)), ReconstructionConfig(max_gaussians=300_000)
            )
            row = {"psnr": psnr(offline, scene, splits[name]), "gaussians": len(offline.gaussians)}
            live.setdefault("offline", {})[name] = row | {"cameras": len(offline.cameras)}
    for place in places:
        place.pop("snapshot", None)
    command = shlex.join(["python", "-m", "tests.bench", "stream", *sys.argv[1:]])
    result = {"command": command, **live, "places": places}
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps({key: value for key, value in result.items() if key != "delays_s"}))


def _camera_errors(name: str, scene: EvaluationScene, places: list[dict], poses: list[dict]) -> dict | None:
    """Of all cameras of the place, in the map of its first scene; None where there is none."""
    found = {place["scene_id"]: place["snapshot"] for place in places if place["snapshot"] is not None}
    mine = [place["scene_id"] for place in places if place["scene_id"] in found and _source(place) == name]
    if not mine:
        return None
    map_of = {pose["scene"]: pose["map"] for pose in poses}
    to_map = {
        pose["scene"]: Similarity(pose["scale"], np.array(pose["rotation"]), np.array(pose["translation"]))
        for pose in poses
        if pose["scene"] in mine and pose["map"] == map_of.get(mine[0])
    }
    cameras = {
        camera.name: (similarity.camera(camera.T_world_camera), camera)
        for scene_id, similarity in to_map.items()
        for camera in _of(name, found[scene_id]).cameras
    }
    true = scene.cameras
    names = [each for each in cameras if each in true]
    errors = compare_cameras(
        np.stack([cameras[each][0] for each in names]),
        np.stack([true[each].T_world_camera for each in names]),
        np.stack([cameras[each][1].K for each in names]),
        np.stack([true[each].K_for(cameras[each][1].width, cameras[each][1].height) for each in names]),
    )
    told = {"rotation_deg": errors.rotation_deg, "centre_pct": errors.centre_pct}
    return {"scenes": len(mine), "linked": len(to_map), "cameras": len(names), **told}


def _visits(places: list[dict], poses: list[dict], splits: dict[str, Split]) -> dict:
    """Which scenes were found on the way back to be where those of the way there are; what was joined wrongly."""
    map_of = {pose["scene"]: pose["map"] for pose in poses}
    maps: dict[str, set[tuple[str, bool]]] = {}  # the scenes in each map, and whether they were seen on the way back
    for place in places:
        if place["scene_id"] in map_of:
            photographs = map(_parts, place["frames_used"])
            mine = {(name, photograph in splits[name].test) for name, photograph in photographs}
            maps.setdefault(map_of[place["scene_id"]], set()).update(mine)
    found = list(maps.values())
    return {
        "found_there": [name for name in splits if any((name, False) in each for each in found)],
        "found_back": [name for name in splits if any((name, True) in each for each in found)],
        "recognised": [name for name in splits if any({(name, False), (name, True)} <= each for each in found)],
        "joined": [sorted(joined) for each in found if len(joined := {name for name, _ in each}) > 1],
    }


def _source(place: dict) -> str:
    """The folder that the place's photographs come from."""
    return _parts(place["frames_used"][0])[0]


def _parts(name: str) -> tuple[str, str]:
    """The scene and the photograph that a streamed photograph is."""
    _, scene, photograph = name.split("__", 2)
    return scene, photograph


def _split(scene: EvaluationScene, hold_out: int) -> Split:
    names = sorted(scene.paths)
    test = names[1::hold_out] if hold_out else []
    return Split(tuple(name for name in names if name not in test), tuple(test))


def _judged(node: Node) -> bool:
    """Whether all places that were left are judged, and compared with the others."""
    left = Path(node.configs["recon"]["checkpoint"]) / "left"
    return all((ledger.parent / "codes").exists() for ledger in left.glob("*/ledger"))


def _streamed(
    folder: Path, scenes: dict[str, EvaluationScene], names: list[str], args: argparse.Namespace
) -> tuple[dict, list[dict]]:
    """What was measured while the photographs came; the places, each with its `snapshot` as it was exported last."""
    per_second: float = args.per_second
    images = folder / "images"
    images.mkdir()
    for name in names:
        scene, photograph = _parts(name)
        (images / name).symlink_to(scenes[scene].paths[photograph].resolve())
    camera = {
        "camera": {
            "kind": "folder", "folder": str(images), "names": names, "fps": per_second,
            "pace": "recorded",
        },
        "selection": {"every_frame": True},
    }  # fmt: skip
    with running(Node(folder / "node", camera, {"max_views": args.max_views})) as node:
        pid = node.start("recon").pid
        time.sleep(5.0)
        node.start("capture")
        began, delays, peak_mb = time.monotonic(), [], 0.0
        deadline = began + len(names) / per_second + PATIENCE_S
        taken_s, finished_s, resting = None, None, 0
        while finished_s is None and time.monotonic() < deadline:
            time.sleep(LOOK_S)
            found = read_heartbeats(node.network)
            capture, recon = found["capture"], found["recon"]
            peak_mb = max(peak_mb, memory_mb(pid))
            if recon is None:
                continue
            delays.append(recon["delay_s"])
            done = taken(capture)
            if done and taken_s is None:
                taken_s = time.monotonic() - began
            idle = at_rest(recon) or (args.until_judged and recon["state"] == "idle" and _judged(node))
            resting = resting + 1 if done and idle else 0
            if resting == RESTS:
                finished_s = time.monotonic() - began
        codes = {verb: node.end(verb) for verb in ("capture", "recon")}
        index = json.loads((node.out / "places.json").read_text())
        places = index["places"]
        for place in places:
            place["snapshot"] = _exported(node.out / place["folder"]) if place["folder"] else None
    told = [name for place in places for name in place["frames_used"]]
    dropped = {each["name"]: each["reason"] for place in places for each in place["frames_dropped"]}
    busy = [delay for delay in delays if delay > 0]
    row = {
        "photographs": len(names),
        "per_second": per_second,
        "in_a_scene": len(set(told)),
        "left_out_by_name": {name: reason for name, reason in dropped.items() if name not in told},
        "in_no_list": sorted(set(names) - set(told) - set(dropped)),  # what capture left out is among them
        "taken_s": taken_s,
        "all_finished_s": finished_s,
        "delay_s_median": float(np.median(busy)) if busy else 0.0,
        "delay_s_most": max(delays, default=0.0),
        "delays_s": [round(delay, 1) for delay in delays],
        "recon_mb_most": peak_mb,
        "links": index["links"],
        "poses": index["poses"],
        "exit_codes": codes,
        "load_average": os.getloadavg()[0],
    }
    return row, places


def _of(name: str, snapshot: Snapshot) -> Snapshot:
    """With the cameras of this scene's photographs alone, by the photographs' own names."""
    cameras = (
        replace(camera, name=_parts(camera.name)[1]) for camera in snapshot.cameras if _parts(camera.name)[0] == name
    )
    return replace(snapshot, cameras=tuple(cameras))


def _exported(folder: Path) -> Snapshot | None:
    """The scene in a result folder."""
    if not (folder / "scene.ply").exists():
        return None
    gaussians, cameras = read_gaussians(folder / "scene.ply"), read_cameras(folder / "cameras.json")
    verdict = Verdict(Code.OK, "", "", publishable=True)
    return Snapshot(0, verdict, cameras, gaussians, images={}, dropped=(), iterations=0, seconds={}, final=True)
