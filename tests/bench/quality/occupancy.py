"""Maps of free, occupied and unseen space against the truth: `python -m tests.bench occupancy --out occupancy.json`.

The photographs of made places are reconstructed and mapped, in voxels of a 64th of the median depth. True cameras carry
the map into the true world by the similarity of the cameras. What is solid there is known of every point.

free_solid   the share of the voxels called free into which something solid reaches: 4 x 4 x 4 points of each are asked.
             free_centre_solid is that of those whose centre is solid
found        of the true surface that two cameras see, by pixels of 320 x 240, the share in a voxel called occupied;
             found_near counts the voxels beside these, too
occupied_off the share of the voxels called occupied that are not within a voxel of a surface that a camera sees
unknown      of the voxels that a camera sees, the air before what it sees and that itself, the share that is not known
behind       of a pane or a mirror: voxels called free behind its plane, as a share of all that are called free there
             and within a metre before it; and `in_it`: voxels called free that reach into it
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation

from splatnode.capture.cameras import synthetic
from splatnode.capture.diorama import Camera, Solid
from splatnode.capture.frame import Frame
from splatnode.extras.building import CHAIR_ROOM, MIRROR_ROOM, ZONES, interior
from splatnode.extras.cameras import building
from splatnode.recon.config import preset
from splatnode.recon.geometry import Similarity, align_cameras
from splatnode.recon.occupancy import NoMap, OccupancyMap, VoxelState, occupancy_map
from splatnode.recon.pipeline import estimate_frames
from splatnode.recon.priors import compute_consistent_depths
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.threads import Clock, apply_thread_limit
from tests.bench.quality.pane import Pane, photograph
from tests.bench.quality.solid import inside, reached, surface, touched
from tests.conftest import ROOT

Array = npt.NDArray[np.float64]
VIEWS = (3, 6, 12)
SEEDS = (0, 1, 2)
_WIDTH, _HEIGHT = 320, 240  # of the pictures that tell what is truly seen
_BESIDE = np.ones((3, 3, 3), bool)
_GLASS = Pane.upright((1.95, 1.95, 0.75), width=1.0, height=1.2)
_TOURS = {0: 10, 3: 70}  # rooms of the building, and the first keyframe that is taken of each
_AT_THE_MIRROR = 316
_BEFORE = 1.0  # metres
_BUILDING = building.Config()


@dataclass(frozen=True, eq=False)
class Place:
    """Photographs of a made place, with what is true."""

    name: str
    images: Callable[[], list[npt.NDArray[np.uint8]]]
    cameras: list[Camera]
    size: tuple[int, int]  # of the photographs
    solids: Callable[[], Sequence[Solid]]
    pane: Callable[[], Solid] | None = None  # glass or a mirror, whose face is that along its y axis


@dataclass(frozen=True)
class Row:
    place: str
    views: int
    verdict: str
    placed: int
    seconds: float | None = None  # of the map alone, on one core
    voxel: float | None = None  # in the unit of the result, whose median depth is 1
    voxel_metres: float | None = None  # in truth
    voxels: int | None = None
    free: int | None = None
    occupied: int | None = None
    free_solid: float | None = None
    free_centre_solid: float | None = None
    found: float | None = None
    found_near: float | None = None
    occupied_off: float | None = None
    unknown: float | None = None
    up: str | None = None
    up_error_deg: float | None = None
    floor_error_metres: float | None = None
    behind: float | None = None
    in_it: int | None = None
    why: str | None = None  # there is no map


def built_in(seed: int, views: int) -> Place:
    config = synthetic.Config(views=views, seed=seed)
    return Place(
        f"built-in capture {seed}",
        lambda: [frame.image for frame in synthetic.stream(config)],
        synthetic.scene_cameras(config),
        (config.width, config.height),
        lambda: synthetic.solids(config),
    )


def glass(views: int) -> Place:
    """The built-in capture with a pane before the table."""
    config = synthetic.Config(views=views)
    cameras = synthetic.scene_cameras(config)
    return Place(
        "glass",
        lambda: [photograph(config, camera, _GLASS, index) for index, camera in enumerate(cameras)],
        cameras,
        (config.width, config.height),
        lambda: (*synthetic.solids(config), _GLASS.solid),
        lambda: _GLASS.solid,
    )


def room(name: str, keyframes: Sequence[int], mirror: bool = False, config: building.Config = _BUILDING) -> Place:
    """Keyframes of the building."""
    return Place(
        name,
        lambda: [building.render_image(config, index) for index in keyframes],
        [building.scene_camera(config, index) for index in keyframes],
        (config.width, config.height),
        lambda: _building(building.state(config, keyframes[0])),
        (lambda: _mirror(building.state(config, keyframes[0]))) if mirror else None,
    )


def _building(state: building.BuildingState) -> list[Solid]:
    zones = [interior(state.seed, building.BARE, zone.number) for zone in ZONES]
    return [solid for zone in zones for solid in zone.solids] + list(zones[CHAIR_ROOM].chairs[state.chair])


def _mirror(state: building.BuildingState) -> Solid:
    zone = interior(state.seed, building.BARE, MIRROR_ROOM)
    assert zone.mirror is not None
    return zone.solids[zone.mirror]


def places(views: Sequence[int], seeds: Sequence[int]) -> Iterator[tuple[Place, int]]:
    for number in views:
        for seed in seeds:
            yield built_in(seed, number), number
    for number in views:
        for zone, first in _TOURS.items():
            yield room(f"building, room {zone}", range(first, first + 2 * number, 2)), number
        yield glass(number), number
        yield room("mirror", range(_AT_THE_MIRROR, _AT_THE_MIRROR + 12, 12 // number), mirror=True), number


def mapped(place: Place) -> tuple[Snapshot, list[int]]:
    """What a result of the photographs would hold for its map; which of the place's cameras its own are."""
    frames = [Frame(index, f"{index:03d}.png", index, image, None) for index, image in enumerate(place.images())]
    estimate, _ = estimate_frames(frames, preset("balanced"), Clock())
    bounds = estimate.bounds
    cameras = tuple(
        CameraEstimate(
            each.name,
            each.frame_id,
            each.T_world_camera,
            each.K,
            each.depth.shape[1],
            each.depth.shape[0],
            bounds.get(each.name),
        )
        for each in estimate.pointmaps.values()
    )
    depths = compute_consistent_depths(list(estimate.pointmaps.values()))
    snapshot = Snapshot(0, estimate.verdict, cameras, GaussianArrays.empty(), {}, (), 0, final=True, depths=depths)
    return snapshot, [int(camera.name[:3]) for camera in cameras]


def row(place: Place, snapshot: Snapshot, numbers: Sequence[int], views: int) -> Row:
    """What the map of `snapshot` is worth; `numbers` say which of the place's cameras its own are."""
    head = place.name, views, snapshot.verdict.code.value, len(snapshot.cameras)
    begun = time.process_time()
    try:
        made = occupancy_map(snapshot)
    except NoMap as error:
        return Row(*head, why=str(error))
    seconds = time.process_time() - begun
    true = [place.cameras[number] for number in numbers]
    own = np.stack([camera.T_world_camera for camera in snapshot.cameras])
    return Row(*head, **_scores(place, made, align_cameras(own, np.stack([T for T, _ in true])), true, seconds))


def _scores(place: Place, made: OccupancyMap, to_true: Similarity, true: list[Camera], seconds: float) -> dict:
    solids, T = place.solids(), made.T_world_map

    def in_truth(points: Array) -> Array:
        return to_true(points @ T[:3, :3].T + T[:3, 3])

    def centres(state: npt.NDArray[np.bool_]) -> Array:
        return in_truth(made.origin + (np.argwhere(state) + 0.5) * made.voxel)

    axes = to_true.scale * made.voxel * to_true.rotation @ T[:3, :3]
    free, occupied = made.states == VoxelState.FREE, made.states == VoxelState.OCCUPIED
    air = centres(free)
    resized = [(T_camera, _shrunk(K, place.size)) for T_camera, K in true]
    shown = [surface(solids, camera, _WIDTH, _HEIGHT) for camera in resized]
    points = _seen_by_two(resized, shown)
    states = made.at(_into(to_true, points))
    near = OccupancyMap(binary_dilation(occupied, _BESIDE).astype(np.uint8), made.voxel, made.origin, made.upright)
    everything = np.concatenate([each for each, _ in shown])
    surfaces = np.zeros(made.states.shape, bool)
    index = np.floor(((_into(to_true, everything) - T[:3, 3]) @ T[:3, :3] - made.origin) / made.voxel).astype(int)
    surfaces[tuple(index[((index >= 0) & (index < surfaces.shape)).all(1)].T)] = True
    everywhere = centres(np.ones(made.states.shape, bool))
    visible = np.zeros(len(everywhere), bool)
    for camera, (_, z) in zip(resized, shown, strict=True):
        visible |= reached(everywhere, camera, z)[0]
    up = to_true.rotation @ T[:3, 2]
    return {
        "seconds": round(seconds, 2),
        "voxel": made.voxel,
        "voxel_metres": made.voxel * to_true.scale,
        "voxels": made.states.size,
        "free": int(free.sum()),
        "occupied": int(occupied.sum()),
        "free_solid": float(touched(solids, air, axes).mean()),
        "free_centre_solid": float(inside(solids, air).mean()),
        "found": float((states == VoxelState.OCCUPIED).mean()),
        "found_near": float(near.at(_into(to_true, points)).mean()),
        "occupied_off": float(1.0 - binary_dilation(surfaces, _BESIDE)[occupied].mean()),
        "unknown": float((made.states.ravel() == VoxelState.NOT_SEEN)[visible].mean()),
        "up": made.upright.source,
        "up_error_deg": float(np.degrees(np.arccos(np.clip(up[2], -1, 1)))),
        "floor_error_metres": abs(float(in_truth(np.zeros((1, 3)))[0, 2])) if made.upright.on_floor else None,
        **({} if place.pane is None else _behind(place.pane(), air, axes)),
    }


def _behind(pane: Solid, air: Array, axes: Array) -> dict[str, float]:
    """Of the voxels called free that the pane's outline covers, those behind it."""
    local = pane.transform_to_local(air)
    across = (np.abs(local[:, [0, 2]]) <= 1).all(1)
    distance = (local[:, 1] - 1) * float(np.linalg.norm(pane.axes[:, 1]))
    behind = int((across & (distance < 0)).sum())
    before = int((across & (distance >= 0) & (distance < _BEFORE)).sum())
    return {"behind": behind / max(behind + before, 1), "in_it": int(touched([pane], air, axes).sum())}


def _shrunk(K: Array, size: tuple[int, int]) -> Array:
    return np.diag([_WIDTH / size[0], _HEIGHT / size[1], 1.0]) @ K


def _into(to_true: Similarity, points: Array) -> Array:
    """True points (M, 3) in the result's world."""
    return (points - to_true.translation) @ to_true.rotation / to_true.scale


def _seen_by_two(cameras: list[Camera], shown: list[tuple[Array, npt.NDArray[np.float32]]]) -> Array:
    """(M, 3) what the cameras show that another one shows as well."""
    found = []
    for number, (points, _) in enumerate(shown):
        again = np.zeros(len(points), bool)
        for other, (camera, (_, z)) in enumerate(zip(cameras, shown, strict=True)):
            if other != number:
                again |= reached(points, camera, z)[1]
        found.append(points[again])
    return np.concatenate(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, nargs="+", default=VIEWS)
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS, help="of the built-in capture")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    rows = []
    head = ["git", "rev-parse", "--short=7", "HEAD"]
    commit = subprocess.run(head, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    told = {"command": shlex.join(["python", "-m", "tests.bench", "occupancy", *sys.argv[1:]]), "commit": commit}
    with apply_thread_limit(1):
        for place, views in places(args.views, args.seeds):
            rows.append(asdict(row(place, *mapped(place), views)))
            print(json.dumps(rows[-1]), flush=True)
            args.out.write_text(json.dumps({**told, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
