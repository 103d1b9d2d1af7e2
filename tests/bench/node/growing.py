"""What a robot has of a scene that grows: `python -m tests.bench growing --keyframes 24 --per-second 0.5`.

Capture and recon run in the built-in building as on a robot. One that looks on hears maps and scenes, and asks twice a
second where images were taken that are no keyframes, half-way between two of them.

map_after_s   from the moment when capture says that it took a keyframe to the first map that has its view
free_solid    of the voxels that a map calls free, the share into which something solid reaches (as in `occupancy`);
              of each provisional map, and of the final one
alone_s       of the same steps one after the other, in one process: the processor seconds of their own thread, from the
              keyframe to its map; what a machine without other work would show, where a second core is free
located       of the questions while the scene grew: the share that got a place, the seconds of an answer, and the
              share of places within their bounds: of the distance, after the best similarity of the scene's cameras
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatnode.capture.config import PreviewHeader
from splatnode.capture.frame import Frame
from splatnode.capture.messaging.messages import make_jpeg_array
from splatnode.capture.messaging.network import CAPTURE_PREVIEW, RECON_LOCATE, RECON_MAP, RECON_SCENE, Network
from splatnode.capture.messaging.pubsub import NoAnswer, QueryClient, StateClient, Subscriber
from splatnode.extras.cameras import building
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon.free_space import GrowingScene, map_growing_scene
from splatnode.recon.geometry import Similarity, align_cameras
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.locating import LocateAnswer, Located, LocateRequest, parse_outcome
from splatnode.recon.occupancy import MapHeader, OccupancyMap, VoxelState, decode_map
from splatnode.recon.result.message import SceneHeader, decode_snapshot
from tests.bench.quality.occupancy import room
from tests.bench.quality.solid import touched
from tests.support.node import PATIENCE_S, Node, processor_s, running

ALONE_S = 5.0  # of recon, before the camera starts: it loads torch
ASK_EVERY_S = 0.5
TIMEOUT_S = 20.0  # of a question


@dataclass
class Heard:
    """What the one that looks on has heard; times are monotonic."""

    taken_s: dict[int, float] = field(default_factory=dict)  # by keyframe
    maps: list[tuple[float, MapHeader, OccupancyMap]] = field(default_factory=list)
    cameras: dict[int, dict[int, npt.NDArray[np.float64]]] = field(default_factory=dict)  # by scene's message, keyframe
    final: bool = False
    grew_s: float = 0.0  # of recon's processor time, until the last keyframe was shown
    answers: list[tuple[float, float, LocateAnswer | None]] = field(default_factory=list)  # index, seconds, answer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int, default=24)
    parser.add_argument("--per-second", type=float, default=0.5, help="keyframes")
    parser.add_argument("--seed", type=int, default=0, help="of the building and of the walk")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/growing.json"))
    args = parser.parse_args()
    config = building.Config(keyframes=args.keyframes, seed=args.seed, fps=args.per_second, pace="recorded")
    queries = [building.render_image(config, index + 0.5) for index in range(args.keyframes - 1)]
    with tempfile.TemporaryDirectory() as folder:
        heard = _watch(Path(folder), config, queries)
    told = (Path(each).name if each.startswith("/") else each for each in sys.argv[1:])  # no path of this machine
    result = {
        "command": shlex.join(["python", "-m", "tests.bench", "growing", *told]),
        "keyframes": args.keyframes, "per_second": args.per_second, "load_average": os.getloadavg()[0],
        "processor_s_a_keyframe": heard.grew_s / args.keyframes or None,
        "alone_s": _percentiles(_time_steps(config)), **_score_maps(heard, config),
        "located": _score_answers(heard, config),
    }  # fmt: skip
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps({key: value for key, value in result.items() if key != "maps"}))


def _time_steps(config: building.Config) -> list[float]:
    """Seconds of the thread, from each keyframe to its map, once there is one."""
    work, seconds = IncrementalReconstruction(ReconstructionConfig()), []
    for index in range(config.keyframes):
        name, image = building.frame_name(index), building.render_image(config, index)
        began_s = time.thread_time()
        work.add_frame(Frame(index, name, index, image, None))
        work.update()
        scene = GrowingScene(work.snapshot(), "alone", index, 0, work.state.pointmaps, 0.0)
        made = map_growing_scene(scene, None, lambda: None)
        if made.occupancy is not None:
            seconds.append(time.thread_time() - began_s)
    return seconds


def _watch(folder: Path, config: building.Config, queries: list[npt.NDArray[np.uint8]]) -> Heard:
    camera = {"kind": "building"} | {key: getattr(config, key) for key in config.__struct_fields__}
    capture = {"camera": camera, "selection": {"every_frame": True}, "preview": {"fps": 20.0}}
    recon = {"occupancy": {"live": True, "provisional": True}, "localization": {"live": True}}
    heard, ended = Heard(), threading.Event()
    with running(Node(folder / "node", capture, recon)) as node:
        pid = node.start("recon").pid
        time.sleep(ALONE_S)
        alone_s = processor_s(pid)
        asking = threading.Thread(target=_ask, args=(node.network, queries, heard, ended))
        asking.start()
        node.start("capture")
        try:
            _listen(node.network, heard, config, lambda: processor_s(pid) - alone_s)
        finally:
            ended.set()
            asking.join()
        for verb in ("capture", "recon"):
            node.end(verb)
    return heard


def _listen(network: Network, heard: Heard, config: building.Config, spent_s: Callable[[], float]) -> None:
    """Until the map of the final scene has come."""
    with contextlib.ExitStack() as stack:
        previews = stack.enter_context(Subscriber(CAPTURE_PREVIEW, network, PreviewHeader))
        maps = stack.enter_context(StateClient(RECON_MAP, network, MapHeader))
        scenes = stack.enter_context(StateClient(RECON_SCENE, network, SceneHeader))
        deadline = time.monotonic() + config.keyframes / config.fps + PATIENCE_S
        while time.monotonic() < deadline:
            if (preview := previews.latest(0)) is not None and preview.header.taken:
                heard.taken_s.setdefault(building.frame_index(preview.header.name), time.monotonic())
            if (scene := scenes.poll(0)) is not None:
                shown = decode_snapshot(scene).snapshot
                heard.cameras[scene.header.sequence] = {
                    building.frame_index(each.name): each.T_world_camera for each in shown.cameras
                }
                heard.final = shown.final
                if not heard.grew_s and len(shown.cameras) == config.keyframes:
                    heard.grew_s = spent_s()
            if (message := maps.poll(0.01)) is not None and (made := decode_map(message)) is not None:
                heard.maps.append((time.monotonic(), message.header, made))
                if message.header.map.provisional is None:
                    return


def _ask(network: Network, queries: list[npt.NDArray[np.uint8]], heard: Heard, ended: threading.Event) -> None:
    """Where the image before the newest keyframe was taken, from the third keyframe on until the scene is final."""
    number = 0
    with QueryClient(RECON_LOCATE, network, LocateAnswer) as client:
        while not ended.wait(ASK_EVERY_S if number == 0 else 0.0):
            newest = max((max(cameras, default=0) for cameras in heard.cameras.values()), default=0)
            if newest < 2 or heard.final:
                continue
            number += 1
            began_s, index = time.monotonic(), min(newest, len(queries)) - 1
            try:
                answer = client.ask(
                    LocateRequest(number, follows=True), [make_jpeg_array(queries[index], 95)], TIMEOUT_S
                )
            except NoAnswer:
                answer = None
            heard.answers.append((index + 0.5, time.monotonic() - began_s, answer))
            ended.wait(max(0.0, ASK_EVERY_S - (time.monotonic() - began_s)))


def _align(heard: Heard, sequence: int, config: building.Config) -> Similarity | None:
    """From the world of a scene's message to the true one."""
    cameras = heard.cameras.get(sequence, {})
    if len(cameras) < 2:
        return None
    true = np.stack([building.scene_camera(config, index)[0] for index in cameras])
    return align_cameras(np.stack(list(cameras.values())), true)


def _score_maps(heard: Heard, config: building.Config) -> dict[str, Any]:
    solids = room("walk", range(config.keyframes), config=config).solids()
    rows, first = [], {}
    for at_s, header, made in heard.maps:
        record = header.map
        assert record is not None
        by = _align(heard, record.scene_sequence, config)
        for index in heard.cameras.get(record.scene_sequence, {}):
            first.setdefault(index, at_s)
        free = np.argwhere(made.states == VoxelState.FREE)
        if by is None or not len(free):
            continue
        T = made.T_world_map
        centres = by((made.origin + (free + 0.5) * made.voxel) @ T[:3, :3].T + T[:3, 3])
        axes = by.scale * made.voxel * by.rotation @ T[:3, :3]
        solid = float(touched(solids, centres, axes).mean())
        views = None if record.provisional is None else record.provisional.views
        rows.append({"views": views, "voxel": made.voxel, "free": len(free), "free_solid": solid})
    after = [first[index] - taken_s for index, taken_s in sorted(heard.taken_s.items()) if index in first and index > 1]
    growing = [row["free_solid"] for row in rows if row["views"] is not None]
    final = [row["free_solid"] for row in rows if row["views"] is None]
    return {
        "map_after_s": {"keyframes": len(after), **_percentiles(after)},
        "free_solid": {"provisional": growing and max(growing), "median": growing and float(np.median(growing)),
                       "final": final[-1] if final else None},
        "maps": rows,
    }  # fmt: skip


def _score_answers(heard: Heard, config: building.Config) -> dict[str, Any]:
    seconds = [each for _, each, answer in heard.answers if answer is not None]
    placed, held, off = 0, 0, []
    for index, _, answer in heard.answers:
        found = None if answer is None else parse_outcome(answer)
        by = None if answer is None else _align(heard, answer.scene_sequence, config)
        if isinstance(found, Located) and by is not None:
            placed += 1
            true = building.scene_camera(config, index)[0]
            apart = float(np.linalg.norm(by(found.T_world_camera[None, :3, 3])[0] - true[:3, 3]))
            off.append(apart)
            held += apart <= by.scale * found.claim.centre
    return {
        "questions": len(heard.answers), "answered": len(seconds), "placed": placed, "within_bounds": held,
        "provisional": sum(answer is not None and answer.provisional for _, _, answer in heard.answers),
        "seconds": _percentiles(seconds), "off_m": _percentiles(off),
    }  # fmt: skip


def _percentiles(numbers: list[float]) -> dict[str, float]:
    if not numbers:
        return {}
    return {"median": round(float(np.median(numbers)), 4), "p95": round(float(np.percentile(numbers, 95)), 4)}


if __name__ == "__main__":
    main()
