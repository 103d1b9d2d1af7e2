"""Metres by markers, stereo pairs and poses, where the metres are known: `python -m tests.bench metres --out FILE`.

Each place of the built-in capture has a printed marker of 10 cm, is photographed from six cameras and reconstructed;
the true unit is by the spread of the true cameras. Then, of the same reconstruction:

marker         what each two photographs that show the marker say
contradiction  a baseline that is 20 % off, too long and too short, against each of these: whether metres are refused
stereo         a second camera stands 75 mm to the right, off by 0 to 5 %; what each pair says, and all of them, against
               what its baseline says
poses          odometry whose steps are each off by 2 % of their length (`steps`), or that ends 2 % of the way off
               (`way`), with 2 degrees of noise; then with one of its poses wrong by a metre

An error is of the unit, in per cent; `held` says whether the 95 % interval has the truth in it.
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import synthetic
from splatnode.extras.evaluate.protocol import compare_cameras
from splatnode.recon.config import preset
from splatnode.recon.geometry import compute_rms_radius
from splatnode.recon.metric.measurement import (
    Baseline,
    MarkerDetection,
    Measurement,
    MetricConfig,
    MetricView,
    estimate_scale_from_markers,
    make_metric_views,
)
from splatnode.recon.metric.metres import Evidence, apply_metric_scale, gather_evidence
from splatnode.recon.metric.odometry import PoseAlignment, PoseSigmas, align_to_poses
from splatnode.recon.metric.stereo import StereoPair, estimate_scale_from_stereo, make_pairs
from splatnode.recon.pipeline import run
from splatnode.recon.result.snapshot import Snapshot
from tests.support import marked
from tests.support.odometry import drifting
from tests.support.stereo import right_photographs

SIDE_M, BASELINE_M, OFF = 0.1, 0.075, 0.2
DRAWS = 40  # of odometry, of each kind, in each place
SIGMAS = PoseSigmas(MetricConfig().poses_sigma_m, MetricConfig().poses_sigma_deg, MetricConfig().poses_drift)

Array = npt.NDArray[np.float64]
Row = dict[str, Any]


def measured(told: Measurement | str, truth: float) -> Row:
    """The error of what was told, and whether its interval holds."""
    if isinstance(told, str):
        return {"told": told}
    low, high = told.interval_95
    error = 100.0 * (told.metres_per_unit / truth - 1.0)
    return {
        "error_percent": round(error, 4),
        "sigma_percent": round(100.0 * told.sigma, 4),
        "held": bool(low <= truth / told.metres_per_unit <= high),
    }


def of_marker(snapshot: Snapshot, sightings: Sequence[MarkerDetection], truth: float) -> Iterator[Row]:
    """Each two photographs that show the marker; then with a baseline that is off, which must be refused."""
    views = make_metric_views(snapshot)
    first, last = snapshot.cameras[0].name, snapshot.cameras[-1].name
    apart = truth * float(np.linalg.norm(views[first].centre - views[last].centre))
    for two in combinations(sightings, 2):
        (told,) = estimate_scale_from_markers(views, two, SIDE_M, 0.0)
        row = {"what": "marker", "photographs": [each.photograph for each in two], **measured(told, truth)}
        refused = []
        for factor in (1.0 - OFF, 1.0 + OFF):
            asked = MetricConfig(marker_size_m=SIDE_M, baseline=Baseline(first, last, factor * apart))
            refused.append(not apply_metric_scale(snapshot, asked, Evidence(two)).scale.metric)
        yield {**row, "wrong_baselines": len(refused), "refused": sum(refused)}


def of_stereo(snapshot: Snapshot, pairs: Sequence[StereoPair], truth: float, off: float) -> Iterator[Row]:
    """What each pair says, and all, against what a baseline says that is `off` (a share) of its stated length."""
    views = make_metric_views(snapshot)
    for chosen in (pairs, *([pair] for pair in pairs)):
        told = estimate_scale_from_stereo(views, snapshot.landmarks, chosen, BASELINE_M, 0.0)
        yield {"what": "stereo", "off_percent": 100 * off, "pairs": len(chosen), **measured(told, truth / (1.0 + off))}


def of_poses(
    views: Mapping[str, MetricView], Ts: Sequence[Array], names: Sequence[str], truth: float, seed: int
) -> Iterator[Row]:
    """Odometry of both kinds, as it is and with one pose wrong by a metre."""
    for draw, kind in ((draw, kind) for draw in range(DRAWS) for kind in ("steps", "way")):
        rng = np.random.default_rng([seed, draw])
        given = dict(zip(names, drifting(Ts, rng, whole=kind == "way"), strict=True))
        yield {"what": "poses", "kind": kind, **_aligned(align_to_poses(views, given, SIGMAS), truth)}
        wrong, direction = names[int(rng.integers(len(names)))], rng.normal(size=3)
        given[wrong] = given[wrong].copy()
        given[wrong][:3, 3] += direction / np.linalg.norm(direction)
        yield {"what": "poses", "kind": kind, "wrong": wrong, **_aligned(align_to_poses(views, given, SIGMAS), truth)}


def _aligned(found: PoseAlignment | str, truth: float) -> Row:
    if isinstance(found, str):
        return {"told": found, "left_out": []}
    return {**measured(found.unit, truth), "left_out": [each.split()[3] for each in found.notes]}


def place(seed: int) -> list[Row]:
    """All rows of a place."""
    config = synthetic.Config(views=6, width=640, height=480, seed=seed)
    cameras = synthetic.scene_cameras(config)
    markers = [marked.Marker(seed, SIDE_M, turn_deg=math.degrees(seed))]
    frames = marked.photographs(config, cameras, markers)
    snapshot = run(frames, preset("preview"))
    if len(snapshot.cameras) < 2:
        return [{"what": "refused", "told": snapshot.verdict.message}]
    views, names = make_metric_views(snapshot), [frame.name for frame in frames]
    used = [names.index(camera.name) for camera in snapshot.cameras]
    centres = np.stack([views[names[index]].centre for index in used])
    Ts = [cameras[index][0] for index in used]
    truth = compute_rms_radius(np.stack(Ts)[:, :3, 3]) / compute_rms_radius(centres)
    rows = list(of_marker(snapshot, gather_evidence(frames, MetricConfig(marker_size_m=SIDE_M)).sightings, truth))
    off = 0.01 * (seed % 6)
    pairs = make_pairs(frames, right_photographs(config, BASELINE_M * (1.0 + off), markers))
    rows += of_stereo(snapshot, pairs, truth, off)
    rows += of_poses(views, Ts, [names[index] for index in used], truth, seed)
    rows.append(_unharmed(snapshot, Ts, [names[index] for index in used], seed))
    return [{"seed": seed, **row} for row in rows]


def _unharmed(snapshot: Snapshot, Ts: Sequence[Array], names: Sequence[str], seed: int) -> Row:
    """The cameras' errors after the best similarity, without poses and with: the same."""
    given = dict(zip(names, drifting(Ts, np.random.default_rng(seed)), strict=True))
    with_poses = apply_metric_scale(snapshot, MetricConfig(), Evidence(poses=given))
    errors = []
    for each in (snapshot, with_poses):
        estimated = np.stack([camera.T_world_camera for camera in each.cameras])
        Ks = np.stack([camera.K for camera in each.cameras])
        found = compare_cameras(estimated, np.stack(Ts), Ks, Ks)
        errors.append([round(found.rotation_deg, 6), round(found.centre_pct, 6)])
    return {"what": "unharmed", "without": errors[0], "with": errors[1]}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench metres", description=__doc__)
    parser.add_argument("--places", type=int, default=12, metavar="N")
    parser.add_argument("--out", type=Path, required=True, help="JSON; places that it holds are not made again")
    args = parser.parse_args()
    rows: list[Row] = json.loads(args.out.read_text())["rows"] if args.out.exists() else []
    for seed in sorted(set(range(args.places)) - {row["seed"] for row in rows}):
        rows += place(seed)
        head = {"command": shlex.join(["python", "-m", "tests.bench", "metres", *sys.argv[1:]])}
        lines = ",\n".join(f"  {json.dumps(row)}" for row in rows)
        args.out.write_text(f'{{\n "command": {json.dumps(head["command"])},\n "rows": [\n{lines}\n ]\n}}\n')
        print(f"place {seed}: {len(rows)} rows", flush=True)
