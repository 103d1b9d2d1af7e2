"""A walk along a wall in two scenes that overlap, each in a world of its own: what merging and maps are tried on.

In the world of the first scene, which is the map's, the wall is the plane z = 1 from x = 0 to x = 3, with a pattern of
colours. The first scene has it from 0 to 2, seen from z = 0; the second from 1 to 3, seen from nearer, so that it sees
the part that both have better.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatnode.recon.result.export import write_result
from splatnode.recon.result.export.limits import SH_C0
from splatnode.recon.result.placement import IDENTITY, Placement
from splatnode.recon.result.report import build_report
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.result.stored_snapshot import DEPTHS, encode_depths
from splatnode.recon.result.verdict import Code, Verdict
from tests.viewer.test_scene import together

K = np.array([[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]])
WIDTH, HEIGHT = 80, 60
STEP = 0.05  # between Gaussians of the wall
TURN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
SECOND = Placement(0.5, TURN, np.array([0.3, -0.1, 0.2]))  # of the second scene in the map


@dataclass(frozen=True, eq=False)
class WalkScene:
    scene_id: str
    gaussians: GaussianArrays  # in its own world
    cameras: tuple[CameraEstimate, ...]
    placement: Placement  # in the map


def camera(x: float, z: float, name: str, frame_id: int) -> CameraEstimate:
    """In the map's world, looking at the wall."""
    T = np.eye(4)
    T[:3, 3] = x, 0.0, z
    return CameraEstimate(name, frame_id, T, K, WIDTH, HEIGHT)


def wall(left: float, right: float, step: float = STEP) -> GaussianArrays:
    """The wall between two x, in the map's world, with a pattern that depends on the place alone."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(left, right, step), np.arange(-0.6, 0.6, step)))
    count = len(x)
    rgb = 0.5 + 0.3 * np.stack([np.sin(9 * x), np.cos(7 * y), np.sin(5 * x + 3 * y)], 1)
    return GaussianArrays(
        means=np.stack([x, y, np.ones(count)], 1).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.tile(np.array([0.8 * step, 0.8 * step, 1e-3], np.float32), (count, 1)),
        opacities=np.full(count, 0.97, np.float32),
        sh=((rgb - 0.5) / SH_C0).astype(np.float32)[:, None],
        source_frame=np.zeros(count, np.int32),
    )


def far_shell(centre: tuple[float, float, float], radius: float, spacing_deg: float = 8.0) -> GaussianArrays:
    """As `recon.scene.background` makes it, grey, all around."""
    count = int(4 * np.pi / np.radians(spacing_deg) ** 2)
    step = np.arange(count) + 0.5
    z, angle = 1 - 2 * step / count, np.pi * (1 + np.sqrt(5)) * step
    across = np.sqrt(1 - z**2)
    directions = np.column_stack([across * np.cos(angle), across * np.sin(angle), z])
    # The rotation of the z axis onto each direction.
    quats = np.column_stack([1 + z, -directions[:, 1], directions[:, 0], np.zeros(count)])
    extent = 0.7 * radius * np.radians(spacing_deg)
    return GaussianArrays(
        means=(np.array(centre) + radius * directions).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=np.tile(extent * np.array([1, 1, 0.1], np.float32), (count, 1)).astype(np.float32),
        opacities=np.full(count, 0.95, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
        source_frame=np.full(count, -1, np.int32),
    )


def walk(step: float = STEP) -> tuple[WalkScene, WalkScene]:
    """The two scenes. The first one's shell hangs in the part that only the second has."""
    first = tuple(camera(x, 0.0, f"{n}.png", n) for n, x in enumerate((0.4, 0.8, 1.2, 1.6)))
    second = tuple(camera(x, 0.25, f"{n}.png", n) for n, x in enumerate((1.2, 1.6, 2.0, 2.4), 2))
    one = together(wall(0.0, 2.0, step), far_shell((1.0, 0.0, 0.0), 1.4))
    two = together(wall(1.0, 3.0, step), far_shell((1.8, 0.0, 0.25), 4.0))
    away = SECOND.inverse()
    moved = tuple(away.transform_camera(each) for each in second)
    return (
        WalkScene("scene-0001", one, first, IDENTITY),
        WalkScene("scene-0002", away.transform_gaussians(two), moved, SECOND),
    )


def write_walk(
    out: Path, *, poses: bool = True, further: tuple[dict, ...] = (), step: float = STEP, second: Code = Code.OK
) -> Path:
    """The folder that a node would have written, with `further` places that have no scene.

    `second` is the verdict on the second scene.
    """
    out.mkdir(exist_ok=True)
    scenes = walk(step)
    places = [_written(out, each, code) for each, code in zip(scenes, (Code.OK, second), strict=True)]
    link = {"scene": "scene-0001", "other": "scene-0002", "shared": ["2.png", "3.png"], **record(SECOND)}
    index = {"checkpoint": "0" * 32, "places": [*places, *further], "links": [link]}
    if poses:
        link |= {"kind": "chain", "why": "the next", "retracted": None}
        index["poses"] = [{"scene": each.scene_id, "map": "scene-0001", **record(each.placement)} for each in scenes]
    (out / "places.json").write_text(json.dumps(index))
    return out


def record(placement: Placement) -> dict:
    return {
        "scale": placement.scale,
        "rotation": placement.rotation.tolist(),
        "translation": placement.translation.tolist(),
    }


def place(scene_id: str, **values: object) -> dict:
    """A record of places.json, of a place without a scene unless `values` say otherwise."""
    nothing = {"state": "finished", "folder": None, "verdict": "NO_PARALLAX", "message": "It only turned."}
    none = {"publishable": False, "provisional": False, "num_gaussians": 0, "frames_used": [], "frames_dropped": []}
    return {"scene_id": scene_id, **nothing, **none, **values}


def depths_of(scene: WalkScene) -> dict[str, np.ndarray]:
    """How far away the wall is in each photograph, in the scene's own unit: a value for 2 x 2 pixels."""
    distances = {each.name: 1.0 - scene.placement.transform_camera(each).T_world_camera[2, 3] for each in scene.cameras}
    size = HEIGHT // 2, WIDTH // 2
    return {name: np.full(size, far / scene.placement.scale, np.float16) for name, far in distances.items()}


def _written(out: Path, scene: WalkScene, code: Code) -> dict:
    verdict = Verdict(code, "All photographs were placed.", "", publishable=True)
    snapshot = Snapshot(0, verdict, scene.cameras, scene.gaussians, {}, (), 1, final=True)
    report = build_report(snapshot, seed=0, preset="fast", peak_rss_mb=None)
    write_result(snapshot, out / scene.scene_id, report, further={DEPTHS: encode_depths(depths_of(scene))})
    names = [each.name for each in scene.cameras]
    good = {"folder": scene.scene_id, "verdict": code.value, "message": "", "publishable": True, "frames_used": names}
    return place(scene.scene_id, **good, num_gaussians=len(scene.gaussians))


def without(gaussians: GaussianArrays, left: float, right: float) -> GaussianArrays:
    """The Gaussians, given in the map's world, without those between two x."""
    x = gaussians.means[:, 0]
    keep = (x < left) | (x > right)
    names = ("means", "quats", "scales", "opacities", "sh", "source_frame")
    return replace(gaussians, **{name: getattr(gaussians, name)[keep] for name in names})
