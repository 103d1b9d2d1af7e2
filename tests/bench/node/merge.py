"""Merged scenes against the scenes that they were made of:
`python -m tests.bench merge castle_p30 --per-second 1 --max-views 12`.

The photographs of a scene, without those that are held out, are replayed through the real processes, which make a chain
of scenes of them. These are merged. Each scene is scored on the held-out photographs that lie between two of its own,
alone and in the merged scene, from the poses that are found in each; so is the merged scene within limits. Renders go
to --renders, each below its photograph.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from torch import Tensor

from splatnode.extras.evaluate.dataset import EvaluationScene, Split, load_scene
from splatnode.extras.evaluate.protocol import PerceptualNetworks, Run, Settings, evaluate
from splatnode.recon.merging import Submap, load_submaps, write_map
from splatnode.recon.rasterize import rasterize
from splatnode.recon.result.export import read_cameras, read_gaussians
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.result.submap_index import read_map_set
from splatnode.recon.result.verdict import Code, Verdict
from tests.bench.node.stream import _split, _streamed

SETTINGS = Settings(alignment_steps=80, alignment_levels=2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="a name in the folder of scenes")
    parser.add_argument("--folder", type=Path, default=Path(os.environ.get("SPLATNODE_SHARED", "../shared")) / "scenes")
    parser.add_argument("--per-second", type=float, default=1.0, help="photographs")
    parser.add_argument("--max-views", type=int, default=12, help="of a scene")
    parser.add_argument("--hold-out", type=int, default=3, help="one photograph in so many")
    parser.add_argument("--limits", type=int, nargs="*", default=[20_000], help="Gaussians, of further merges")
    parser.add_argument("--node", type=Path, help="a folder that the node's results stay in, or lie in already")
    parser.add_argument("--renders", type=Path, help="where renders below their photographs go")
    parser.add_argument("--out", type=Path, default=Path("tests/bench/results/merge.json"))
    args = parser.parse_args()
    scene = load_scene(args.folder / args.scene)
    split = _split(scene, args.hold_out)
    with tempfile.TemporaryDirectory() as scratch:
        node = args.node or Path(scratch) / "node"
        if not (node / "node" / "out").exists():
            node.mkdir(parents=True, exist_ok=True)
            _streamed(node, {args.scene: scene}, {args.scene: split}, args.per_second, args.max_views)
        rows = _rows(node / "node" / "out", Path(scratch), scene, split, args.limits, args.renders)
    # Folders are left out: they change nothing of what is measured.
    options = {"--per-second": args.per_second, "--max-views": args.max_views, "--hold-out": args.hold_out}
    words = [
        args.scene,
        *(f"{word:g}" if isinstance(word, float) else str(word) for pair in options.items() for word in pair),
    ]
    command = shlex.join(["python", "-m", "tests.bench", "merge", *words, "--limits", *map(str, args.limits)])
    args.out.write_text(json.dumps({"command": command, "maps": rows}, indent=1) + "\n")
    print(json.dumps(rows))


def _rows(
    out: Path, scratch: Path, scene: EvaluationScene, split: Split, limits: list[int], renders: Path | None
) -> list[dict]:
    whole = read_map_set(out)
    rows = []
    for each in whole.maps:
        found = load_submaps(whole, each)
        if not found.used:
            continue
        row: dict = {"map": each.name, "alone": {}, "merged": []}
        for submap in found.used:
            row["alone"][submap.scene_id] = _score(submap.gaussians, submap, scene, split, renders, "alone")
        for most in (None, *limits):
            folder, began = scratch / f"{each.name}-{most}", time.perf_counter()
            report = write_map(whole, each, found, folder, most)
            seconds = time.perf_counter() - began
            gaussians, cameras = read_gaussians(folder / "scene.ply"), read_cameras(folder / "cameras.json")
            scores = {
                submap.scene_id: _score(gaussians, _with(submap, cameras), scene, split, renders, f"merged-{most}")
                for submap in found.used
            }
            kept = {key: report[key] for key in ("num_gaussians", "gaussians_given", "far_shell", "scenes", "levels")}
            size = (folder / "scene.ply").stat().st_size
            row["merged"].append({"most": most, "seconds": seconds, "bytes": size, **kept, "held_out": scores})
        rows.append(row)
    return rows


def _with(submap: Submap, cameras: tuple[CameraEstimate, ...]) -> Submap:
    """With its cameras as the merged scene has them."""
    known = {camera.name: camera for camera in cameras}
    return replace(submap, cameras=tuple(known[camera.name] for camera in submap.cameras))


def _score(
    gaussians: GaussianArrays, submap: Submap, scene: EvaluationScene, split: Split, renders: Path | None, what: str
) -> dict[str, float]:
    """PSNR in dB by held-out photograph between two that the submap has."""
    cameras = tuple(replace(camera, name=camera.name.split("__", 1)[1]) for camera in submap.cameras)
    used, names = {camera.name for camera in cameras}, sorted(scene.paths)
    between = [
        name for name in split.test
        if (at := names.index(name)) + 1 < len(names) and names[at - 1] in used and names[at + 1] in used
    ]  # fmt: skip
    verdict = Verdict(Code.OK, "", "", publishable=True)
    snapshot = Snapshot(0, verdict, cameras, gaussians, {}, (), 0, final=True)
    scores: dict[str, float] = {}

    def show(name: str, truth: Tensor, image: Tensor) -> None:
        scores[name] = float(-10 * np.log10(np.mean((np.clip(image.numpy(), 0, 1) - truth.numpy()) ** 2)))
        if renders is not None:
            renders.mkdir(parents=True, exist_ok=True)
            pair = np.vstack([np.clip(each.numpy(), 0, 1) for each in (truth, image)])
            path = renders / f"{submap.scene_id}-{what}-{Path(name).stem}.png"
            cv2.imwrite(str(path), np.rint(255 * pair[..., ::-1]).astype(np.uint8))

    evaluate(
        snapshot, scene, Split(tuple(used), tuple(between)), Run("merge", 0, None, {}, None),
        rasterize=rasterize, networks=PerceptualNetworks(None, None), settings=SETTINGS, show=show,
    )  # fmt: skip
    return scores
