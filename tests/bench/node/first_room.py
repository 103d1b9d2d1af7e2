"""The first room of the built-in building: its scene among those of a walk, and made of the same photographs alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from splatnode.capture.frame import Frame
from splatnode.capture.image_file import encode_png
from splatnode.extras.cameras import building
from splatnode.extras.evaluate.dataset import EvaluationScene, Split, TrueCamera
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.pipeline import reconstruct
from splatnode.recon.result.export import read_cameras, read_gaussians
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from tests.bench.node.live import psnr

HELD_OUT = 4  # photographs


def first_room(
    config: building.Config,
    places: list[dict],
    folders: Mapping[str, Path],
    found: Mapping[str, Mapping],
    folder: Path,
) -> dict | None:
    """Of the scene that has most keyframes of the first tour: its score on photographs midway between them.

    `alone` is the score of a scene that is made offline of the same photographs. None where there is no such scene.
    """
    tour = [
        index for index in range(min(config.keyframes, 60)) if building.room(config, index) == building.room(config, 0)
    ]
    counts = {scene: len(set(cameras) & set(tour)) for scene, cameras in found.items()}
    scene = max(counts, key=lambda each: counts[each], default=None)
    if scene is None or not (folders[scene] / "scene.ply").exists():
        return None
    inside = [each for each in tour if each in found[scene] and each + 1 in found[scene]]
    chosen = inside[1 :: max(1, len(inside) // HELD_OUT)][:HELD_OUT]
    paths, true = {}, {}
    for keyframe in chosen:
        name = f"held_out_{keyframe:05d}.png"
        paths[name] = folder / name
        paths[name].write_bytes(encode_png(building.render_image(config, keyframe + 0.5)))
        true[name] = TrueCamera(*building.evaluation_camera(config, keyframe), config.width, config.height)
    cameras = read_cameras(folders[scene] / "cameras.json")
    for camera in cameras:
        known = building.scene_camera(config, building.frame_index(camera.name))
        true[camera.name] = TrueCamera(*known, config.width, config.height)
    verdict = Verdict(Code.OK, "", "", publishable=True)
    gaussians = read_gaussians(folders[scene] / "scene.ply")
    snapshot = Snapshot(0, verdict, cameras, gaussians, images={}, dropped=(), iterations=0, seconds={}, final=True)
    split = Split(tuple(camera.name for camera in cameras), tuple(paths))
    (state,) = [place["state"] for place in places if place["scene_id"] == scene]
    score = psnr(snapshot, EvaluationScene("building", paths, true), split)
    told = {"scene": scene, "state": state, "held_out": len(paths), "psnr": score, "gaussians": len(gaussians)}
    by_itself = _alone(config, split.train)
    score = psnr(by_itself, EvaluationScene("building", paths, true), split)
    return told | {"alone": {"psnr": score, "gaussians": len(by_itself.gaussians)}}


def _alone(config: building.Config, names: Sequence[str]) -> Snapshot:
    """Of these photographs of the walk, offline."""
    images = [building.render_image(config, building.frame_index(name)) for name in names]
    frames = [
        Frame(index, *named, None) for index, named in enumerate(zip(names, range(len(names)), images, strict=True))
    ]
    *_, last = reconstruct(frames, ReconstructionConfig(max_gaussians=300_000))
    return last
