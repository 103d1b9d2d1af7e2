"""Scenes of poses that are given, beside other recipes: `python -m tests.bench given_scenes --starts DIR --out FILE`.

The sets, and the errors of their poses, are those of known_poses.py. Given poses are refined and points matched once a
set; from these cameras and points each method makes its scene. 3DGS and FSGS are the recipes of extras/evaluate/rivals
without COLMAP, MCMC those of the race, with as many Gaussians as `balanced` chose. Seconds are of what a method does
from there on, its depth included. A method without Gaussians has no scores and says why. Rows that --out holds already
are not run again; of each set all methods run in turn, so that their seconds are of the same minutes.
"""

from __future__ import annotations

import json
import pickle
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from splatnode.capture.frame import Intrinsics, make_given_pose
from splatnode.capture.process.terminal import say
from splatnode.extras.evaluate import methods
from splatnode.extras.evaluate.methods import Start, continue_reconstruction
from splatnode.extras.evaluate.protocol import Settings
from splatnode.extras.evaluate.report import measure_timing
from splatnode.extras.evaluate.rivals import colmap_3dgs, colmap_fsgs
from splatnode.extras.evaluate.rivals.colmap import RegisteredFrame, SparseModel
from splatnode.extras.jobs import now
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction, estimate_depth, load_prior
from splatnode.recon.optimize.training import single_torch_thread
from splatnode.recon.pipeline import estimate_frame_cameras
from splatnode.recon.registration.registration import undistort_keyframes
from splatnode.recon.result.export.staged import json_bytes, write_file
from splatnode.recon.result.report import peak_rss_mb
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.threads import Clock
from tests.bench.quality.held_out import Case, Folders, Scoring, load_case, parsed, parser_of
from tests.bench.quality.known_poses import (
    CONFIG,
    SETS,
    SIGMA_DEG,
    SIGMA_M,
    disturb_pose,
    find_distance,
    load_frames_with_lens,
)
from tests.bench.quality.race import Field

RECIPES = MappingProxyType(
    {
        "3dgs": (colmap_3dgs.OPTIMIZE, colmap_3dgs.initialize_scene),
        "fsgs": (colmap_fsgs.OPTIMIZE, colmap_fsgs.initialize_scene_with_depth),
    }
)
OURS, CHOOSING = ("balanced", "fast"), "balanced"  # that runs first: MCMC gets as many Gaussians as it chose
METHODS = (*OURS, "mcmc+fill", *RECIPES)
# The search for a held-out view's pose begins where given poses have it: a quarter of the benchmark's steps, the same
# for all rows, and half of them at half the size
SETTINGS = Settings(alignment_steps=30, alignment_levels=2)


@dataclass(frozen=True)
class Row:
    scene: str
    views: int
    method: str
    verdict: str
    placed: int  # views that have a camera
    points: int  # that the cameras came with
    psnr: float | None  # of held-out views, as are the next two
    ssim: float | None
    lpips: float | None
    num_gaussians: int
    iterations: int
    seconds: float  # by the clock, from cameras and points on
    processor_seconds: float  # likewise, of all threads
    others: float | None  # the share of the cores' time that others took meanwhile
    why: str | None  # there is no score; None: there is


def find_given_start(case: Case) -> Start:
    """The cameras that poses with errors hold, and points; no depth yet."""
    clock, generator = Clock(), np.random.default_rng(0)
    scene, away = case.scene, find_distance(case.scene)
    frames = []
    for frame in load_frames_with_lens(scene, case.split.train):
        T = scene.cameras[frame.name].T_world_camera.copy()
        T[:3, 3] /= away
        told = make_given_pose(disturb_pose(T, generator, "clean"), SIGMA_M, SIGMA_DEG)
        frames.append(replace(frame, given_pose=told))
    estimate, dropped = estimate_frame_cameras(frames, load_prior(CONFIG), CONFIG, clock)
    return Start(estimate, dropped, clock, peak_rss_mb())


def load_start(case: Case, folders: Folders) -> bytes:
    """Cameras and points of the photographs, pickled: every method gets a copy of its own."""
    path = folders.starts / f"{case.scene.name}_{len(case.split.train)}.given"
    if not path.exists():
        folders.starts.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(find_given_start(case)))
    return path.read_bytes()


def make_sparse_model(estimate: Reconstruction) -> SparseModel | None:
    """Cameras and points as COLMAP would give them; None where there are none."""
    if estimate.registration is None or not len(estimate.registration.points):
        return None
    graph, found = undistort_keyframes(estimate.graph, estimate.registration)
    registered, observed = [], []
    sums, counts = np.zeros((len(found.points), 3)), np.zeros(len(found.points))
    for camera in found.cameras:
        frame, mine = graph.keyframes[camera.index].frame, found.observed_by == camera.index
        seen = found.observed_point[mine]
        x, y = np.clip(found.observed_pixels[mine].astype(np.int64), 0, [frame.width - 1, frame.height - 1]).T
        np.add.at(sums, seen, frame.image[y, x])
        np.add.at(counts, seen, 1)
        (fx, fy), (cx, cy) = camera.focals, camera.principal
        lens = Intrinsics(frame.width, frame.height, fx, fy, cx, cy, "estimated")
        registered.append(RegisteredFrame(frame, camera.T_world_camera, lens))
        observed.append(seen)
    colours = (sums / np.maximum(counts, 1)[:, None]).round().astype(np.uint8)
    return SparseModel(tuple(registered), found.points, colours, tuple(observed))


def continue_recipe(start: Start, name: str) -> Iterator[Snapshot]:
    """What 3DGS or FSGS make of the cameras and points; nothing where there is no point."""
    model = make_sparse_model(start.estimate)
    if model is not None:
        frames = [keyframe.frame for keyframe in start.estimate.graph.keyframes]
        yield from colmap_3dgs.refine_sparse_model(frames, model, 0, *RECIPES[name], Clock())


def continue_configuration(start: Start, config: ReconstructionConfig) -> Iterator[Snapshot]:
    """What a configuration of our engine makes of them, after the depth that it needs."""
    estimate = estimate_depth(start.estimate, load_prior(config))
    return continue_reconstruction(replace(start, estimate=estimate), config)


def continue_method(start: Start, name: str, chosen: int) -> Iterator[Snapshot]:
    if name in RECIPES:
        return continue_recipe(start, name)
    config = methods.CONFIGS[name] if name in OURS else Field(chosen, "cpu").config(name)
    assert config is not None
    return continue_configuration(start, config)


def measure(case: Case, start: Start, name: str, chosen: int, scoring: Scoring) -> Row:
    """One scene from cameras and points to its scores. `start` is used up."""
    registration = start.estimate.registration
    points = 0 if registration is None else len(registration.points)
    since, processor, begun = now(), time.process_time(), time.perf_counter()
    shown = deque(continue_method(start, name, chosen), maxlen=1)
    took = time.perf_counter() - begun, time.process_time() - processor
    others = measure_timing(since).others
    row = Row(
        scene=case.scene.name,
        views=len(case.split.train),
        method=name,
        verdict=start.estimate.verdict.code.value,
        placed=len(start.estimate.camera_names),
        points=points,
        psnr=None,
        ssim=None,
        lpips=None,
        num_gaussians=0,
        iterations=0,
        seconds=round(took[0], 2),
        processor_seconds=round(took[1], 2),
        others=None if others is None else round(others, 3),
        why=None,
    )
    if not shown:
        return replace(row, why="there is no point to start from")
    snapshot = shown[0]
    with single_torch_thread():  # beside other work, torch's threads would only wait for each other
        scored = case.score(snapshot, name, scoring)
    row = replace(
        row,
        verdict=snapshot.verdict.code.value,
        psnr=scored.psnr,
        ssim=scored.ssim,
        lpips=scored.lpips_alex,
        num_gaussians=len(snapshot.gaussians),
        iterations=snapshot.iterations,
    )
    if scored.psnr is not None:
        return row
    if snapshot.verdict.publishable:
        return replace(row, why="no Gaussian is left of its points")
    return replace(row, why=snapshot.verdict.message)


def fill(case: Case, rows: list[Row], folders: Folders, scoring: Scoring, out: Path) -> None:
    """Adds to `rows`, and to the file, what `case` lacks."""
    mine = case.scene.name, len(case.split.train)
    known = {row.method: row for row in rows if (row.scene, row.views) == mine}
    for name in METHODS:
        if name in known:
            continue
        chosen = known[CHOOSING].num_gaussians if CHOOSING in known else 0
        row = known[name] = measure(case, pickle.loads(load_start(case, folders)), name, max(chosen, 1), scoring)
        rows.append(row)
        write(rows, scoring, out)
        say(describe_row(row))


def describe_row(row: Row) -> str:
    score = f"not scored: {row.why}" if row.psnr is None else f"{row.psnr:.2f} dB, {row.ssim:.3f}, {row.lpips:.3f}"
    took = f"{row.seconds:.1f} s, {row.processor_seconds:.1f} s of the processor"
    return f"{row.scene} {row.views}, {row.method}: {row.verdict}, {score}, {row.num_gaussians} Gaussians, {took}"


def write(rows: Sequence[Row], scoring: Scoring, out: Path) -> None:
    missing = [
        name for name in SETS if {row.method for row in rows if f"{row.scene}:{row.views}" == name} != {*METHODS}
    ]
    content = {
        "command": "python -m tests.bench given_scenes",
        "note": f"not measured, or not by all methods: {', '.join(missing)}" if missing else "",
        "machine": asdict(measure_timing(now())) | {"others": None},
        "settings": asdict(scoring.settings),
        "rows": [asdict(row) for row in rows],
    }
    write_file(out, json_bytes(content))


def main() -> None:
    arguments, folders, scoring = parsed(parser_of(__doc__, SETS))
    scoring = replace(scoring, settings=SETTINGS)
    rows = [Row(**row) for row in json.loads(arguments.out.read_text())["rows"]] if arguments.out.exists() else []
    for name in arguments.cases or SETS:
        fill(load_case(name, folders), rows, folders, scoring, arguments.out)


if __name__ == "__main__":
    main()
