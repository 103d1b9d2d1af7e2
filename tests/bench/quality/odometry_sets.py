"""Sets that images alone refuse, with odometry: `python -m tests.bench odometry_sets --out FILE`.

Sets of 2 to 4 photographs are drawn of each scene, so that neighbours look 20 to 60 degrees apart; the lens is told.
What images alone refuse, as NO_OVERLAP or otherwise, is made again with odometry: the true poses, in metres that put
the scene 2 m away, with the errors that `--poses-drift 2%,0.5 --poses-sigma 0.005,0.1` states, in the order in which
the photographs were taken. Cameras are compared with the true ones where they are, in the odometry's world: nothing is
aligned. `wrong` is a camera 2.5 times beyond its bound, or 5 degrees off. What --out holds is not run again.
"""

from __future__ import annotations

import argparse
import itertools
import json
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import make_given_pose
from splatnode.capture.process.terminal import say
from splatnode.extras.evaluate.dataset import EvaluationScene, load_scene
from splatnode.recon.config import apply_changes, preset
from splatnode.recon.estimation import Reconstruction, estimate_cameras, load_prior
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.pipeline import estimate_frame_cameras
from splatnode.recon.threads import Clock
from tests.bench.quality.known_poses import find_distance, load_frames_with_lens

Array = npt.NDArray[np.float64]

AWAY_M = 2.0  # from the cameras to the scene
SIGMA_M, SIGMA_DEG = 0.005, 0.1
DRIFT, DRIFT_DEG = 0.02, 0.5
LEAST_DEG, MOST_DEG = 20.0, 60.0
SIZES = (2, 3, 4)
ALONE = apply_changes(preset("balanced"), {"no_fallbacks": True})
TOLD = apply_changes(ALONE, {"registration": {"trust_poses": True, "poses_drift": DRIFT, "poses_drift_deg": DRIFT_DEG}})


@dataclass(frozen=True)
class Row:
    scene: str
    names: list[str]
    degrees: list[float]  # between the axes of neighbours
    alone: str  # the verdict without odometry
    verdict: str = ""  # with it; empty: not made, as images alone answer
    placed: int = 0
    matches: int = 0  # of all pairs
    rotation_deg: float = 0.0  # the largest error
    centre_percent: float = 0.0  # of the distance to the scene
    rotation_over_bound: float = 0.0
    centre_over_bound: float = 0.0
    scale_sigmas: float = 0.0  # error of the metres, where two cameras or more tell them
    wrong: bool = False


def draw_sets(scene: EvaluationScene, count: int, generator: np.random.Generator) -> Iterator[tuple[str, ...]]:
    """Draws sets of photographs, in order, whose neighbours look `LEAST_DEG` to `MOST_DEG` apart."""
    names = list(scene.cameras)
    axes = np.stack([scene.cameras[name].T_world_camera[:3, 2] for name in names])
    between = np.degrees(np.arccos(np.clip(axes @ axes.T, -1.0, 1.0)))
    seen: set[tuple[int, ...]] = set()
    for _ in range(200 * count):
        size = int(generator.choice(SIZES))
        chain = [int(generator.integers(len(names)))]
        while len(chain) < size:
            wide = np.flatnonzero((between[chain[-1]] >= LEAST_DEG) & (between[chain[-1]] <= MOST_DEG))
            wide = np.setdiff1d(wide, chain)
            if not len(wide):
                break
            chain.append(int(generator.choice(wide)))
        key = tuple(sorted(chain))
        if len(chain) == size and key not in seen:
            seen.add(key)
            yield tuple(names[i] for i in key)
        if len(seen) == count:
            return


def drift(Ts: Sequence[Array], generator: np.random.Generator) -> list[Array]:
    """Adds to poses (4, 4) in metres the errors of odometry, as `Drift` and the sigmas state them."""
    scale, turned, off, found = generator.normal(0.0, DRIFT), np.eye(3), np.zeros(3), []
    for i, T in enumerate(Ts):
        if i:
            step = T[:3, 3] - Ts[i - 1][:3, 3]
            length = float(np.linalg.norm(step))
            off = off + (turned - np.eye(3)) @ step + scale * step + DRIFT * length * generator.normal(size=3)
            turn = np.radians(DRIFT_DEG) * np.sqrt(length) * generator.normal(size=3)
            turned = Rotation.from_rotvec(turn).as_matrix() @ turned
        told = T.copy()
        told[:3, 3] += off + SIGMA_M * generator.normal(size=3)
        own = Rotation.from_rotvec(np.radians(SIGMA_DEG) * generator.normal(size=3)).as_matrix()
        told[:3, :3] = turned @ T[:3, :3] @ own
        found.append(told)
    return found


def match(scene: EvaluationScene, names: Sequence[str]) -> Reconstruction:
    """The set without odometry; the lens is told."""
    return estimate_frame_cameras(load_frames_with_lens(scene, names), load_prior(ALONE), ALONE, Clock())[0]


def judge(scene: EvaluationScene, names: Sequence[str], generator: np.random.Generator) -> Row:
    """Makes a set without odometry and, where that is refused, with it."""
    alone = match(scene, names)
    graph = alone.graph
    Ts, away = {}, find_distance(scene)
    for name in (keyframe.name for keyframe in graph.keyframes):
        Ts[name] = scene.cameras[name].T_world_camera.copy()
        Ts[name][:3, 3] *= AWAY_M / away
    axes = [Ts[name][:3, 2] for name in sorted(Ts)]
    degrees = [round(float(np.degrees(np.arccos(np.clip(a @ b, -1, 1)))), 1) for a, b in itertools.pairwise(axes)]
    row = Row(scene.name, list(names), degrees, alone.verdict.code.value)
    return row if alone.verdict.publishable else _judge_with_odometry(row, graph, Ts, generator)


def _judge_with_odometry(row: Row, graph: ViewGraph, Ts: dict[str, Array], generator: np.random.Generator) -> Row:
    order = sorted(Ts)
    told = dict(zip(order, drift([Ts[name] for name in order], generator), strict=True))
    keyframes = tuple(
        replace(each, frame=replace(each.frame, given_pose=make_given_pose(told[each.name], SIGMA_M, SIGMA_DEG)))
        for each in graph.keyframes
    )
    estimate = estimate_cameras(replace(graph, keyframes=keyframes), (), TOLD)
    row = replace(
        row, verdict=estimate.verdict.code.value, matches=sum(len(pair.matches) for pair in graph.pairs.values())
    )
    given, registration = estimate.prior_world, estimate.registration
    if given is None or registration is None or not estimate.verdict.publishable:
        return row
    errors = []
    for camera in registration.cameras:
        name = graph.names[camera.index]
        centre = given.scale * given.rotation @ camera.T_world_camera[:3, 3] + given.translation
        turn = (given.rotation @ camera.T_world_camera[:3, :3]).T @ Ts[name][:3, :3]
        metres = float(np.linalg.norm(centre - Ts[name][:3, 3]))
        rotation = float(np.degrees(Rotation.from_matrix(turn).magnitude()))
        bounds = estimate.bounds[name]
        over = rotation / bounds.rotation_deg, metres / (given.scale * bounds.centre)
        errors.append((rotation, 100.0 * metres / AWAY_M, *over))
    worst = np.array(errors).max(0).round(3).tolist()
    wrong = worst[0] > 5.0 or max(worst[2:]) > 2.5
    return replace(
        row,
        placed=len(registration.cameras),
        rotation_deg=worst[0],
        centre_percent=worst[1],
        rotation_over_bound=worst[2],
        centre_over_bound=worst[3],
        scale_sigmas=_score_scale(estimate, graph, Ts),
        wrong=wrong,
    )


def _score_scale(estimate: Reconstruction, graph: ViewGraph, Ts: dict[str, Array]) -> float:
    """The error of the metres in sigmas: of the cameras' spread against the true one."""
    given, registration = estimate.prior_world, estimate.registration
    if given is None or registration is None or len(registration.cameras) < 2 or given.scale_sigma <= 0:
        return 0.0
    found = np.stack([given.scale * camera.T_world_camera[:3, 3] for camera in registration.cameras])
    true = np.stack([Ts[graph.names[camera.index]][:3, 3] for camera in registration.cameras])
    spreads = [float(np.linalg.norm(each - each.mean(0))) for each in (found, true)]
    return round(abs(float(np.log(spreads[0] / spreads[1]))) / given.scale_sigma, 3)


def tell(rows: Sequence[Row]) -> str:
    """Says what the rows come to."""
    refused = [row for row in rows if row.verdict]
    return "; ".join(
        f"{title}: {_tell_answers([row for row in refused if (row.alone == 'NO_OVERLAP') == no_overlap])}"
        for title, no_overlap in (("NO_OVERLAP without odometry", True), ("otherwise refused", False))
    )


def _tell_answers(refused: Sequence[Row]) -> str:
    answered = [row for row in refused if row.placed]
    whole = sum(row.placed == len(row.names) for row in answered)
    within = sum(max(row.rotation_over_bound, row.centre_over_bound) <= 1.0 for row in answered)
    scales = sum(row.scale_sigmas <= 1.96 for row in answered)
    return (
        f"{len(answered)} of {len(refused)} answered with it, {whole} whole, {sum(row.wrong for row in answered)} "
        f"wrong; all cameras within their bounds in {within}, metres within their interval in {scales}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench odometry_sets", description=__doc__)
    parser.add_argument("--scenes", type=Path, default=Path("shared/scenes"), help="the folder of the scenes")
    parser.add_argument("--sets", type=int, default=24, metavar="N", help="of each scene")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    args = parser.parse_args()
    rows = [Row(**row) for row in json.loads(args.out.read_text())["rows"]] if args.out.exists() else []
    done = {(row.scene, *row.names) for row in rows}
    for folder in sorted(each.parent for each in args.scenes.glob("*/images")):
        scene = load_scene(folder)
        for number, names in enumerate(draw_sets(scene, args.sets, np.random.default_rng(0))):
            if (scene.name, *names) in done:
                continue
            rows.append(judge(scene, names, np.random.default_rng([number, len(names)])))
            _write(args.out, rows)
        say(f"{scene.name}: {tell(rows)}")


def _write(out: Path, rows: Sequence[Row]) -> None:
    command = shlex.join(["python", "-m", "tests.bench", "odometry_sets", *sys.argv[1:]])
    lines = ",\n".join(f"  {json.dumps(asdict(row))}" for row in rows)
    beside = out.with_suffix(".part")
    beside.write_text(f'{{\n "command": {json.dumps(command)},\n "rows": [\n{lines}\n ]\n}}\n')
    beside.replace(out)
