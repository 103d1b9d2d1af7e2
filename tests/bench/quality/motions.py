"""Metres and up by wheels and an IMU, where both are known: `python -m tests.bench motions --out FILE`.

Each place of the built-in capture is photographed from six cameras and reconstructed; the true unit is by the best
similarity to the true cameras. Then, of the same reconstruction, with motions whose steps are off by 2 % of their
length and 2 degrees about each axis, and gravity off by 2 degrees:

motions        what all of them say of the unit
slipped        the same, with one motion wrong by a metre
gravity        how far up is off, and how unsure it is told

An error is of the unit, in per cent; `held` says whether the 95 % interval has the truth in it.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from splatnode.capture.cameras import synthetic
from splatnode.capture.diorama import Config as Odometry
from splatnode.capture.diorama import odometry
from splatnode.capture.frame import Motion
from splatnode.recon.config import preset
from splatnode.recon.geometry import align_cameras
from splatnode.recon.metric.measurement import Measurement, MetricConfig, MetricView, make_metric_views
from splatnode.recon.metric.odometry import estimate_scale_from_motions, estimate_up
from splatnode.recon.pipeline import run
from tests.bench.quality.metres import Array, Row, measured

DRAWS = 40  # of odometry, in each place
NOISE = Odometry(drift=0.02, noise_deg=2.0)
SLIP_M, TWO_SIDED_95 = 1.0, 2.45  # standard deviations in two dimensions


def of_odometry(views: Mapping[str, MetricView], names: Sequence[str], Ts: Sequence[Array], seed: int) -> Iterator[Row]:
    """All rows of the cameras `names` of a place, which truly are at `Ts`."""
    to_truth = align_cameras(np.stack([views[name].T_world_camera for name in names]), np.stack(Ts))
    true_up = to_truth.rotation.T @ [0.0, 0.0, 1.0]
    for draw in range(DRAWS):
        told = odometry(names, Ts, NOISE, 1000 * seed + draw)
        motions = {name: motion for name, (motion, _) in zip(names, told, strict=True)}
        yield {"what": "motions", **_unit(views, motions, to_truth.scale)}
        rng = np.random.default_rng([seed, draw])
        wrong = names[int(rng.integers(1, len(names)))]
        yield {
            "what": "slipped",
            "wrong": wrong,
            **_unit(views, _slipped(motions, names, wrong, rng), to_truth.scale),
        }
        up = estimate_up(views, {name: gravity for name, (_, gravity) in zip(names, told, strict=True)})
        if up is None:
            yield {"what": "gravity", "told": "nothing"}
            continue
        off_deg = float(np.degrees(np.arccos(min(1.0, float(np.dot(up.direction, true_up))))))
        held = off_deg <= TWO_SIDED_95 * up.sigma_deg
        yield {"what": "gravity", "off_deg": round(off_deg, 4), "sigma_deg": round(up.sigma_deg, 4), "held": held}


def _slipped(motions: Mapping[str, Motion], names: Sequence[str], wrong: str, rng: np.random.Generator) -> dict:
    """The motions, of which that to `wrong` is off by a metre."""
    found = {names[0]: motions[names[0]]}
    for before, name in pairwise(names):
        one, other = motions[before], motions[name]
        step = np.linalg.inv(one.matrix) @ other.matrix
        if name == wrong:
            direction = rng.normal(size=3)
            step[:3, 3] += SLIP_M * direction / np.linalg.norm(direction)
        sigmas = [float(np.sqrt(b**2 - a**2)) for a, b in zip(*map(_sigmas, (one, other)), strict=True)]
        found[name] = found[before].append_step(step, sigmas[0], sigmas[1])
    return found


def _sigmas(motion: Motion) -> tuple[float, float]:
    return motion.sigma_m, motion.sigma_deg


def _unit(views: Mapping[str, MetricView], motions: Mapping[str, Motion], truth: float) -> Row:
    """What the motions say, and which photographs the motions that were left out led to."""
    said = estimate_scale_from_motions(views, motions, MetricConfig().odometry_scale_sigma)
    sentences = [each for each in said if isinstance(each, str)]
    if isinstance(said[0], Measurement):
        return {**measured(said[0], truth), "left_out": [each.split()[5] for each in sentences]}
    return {"told": said[0], "left_out": []}


def place(seed: int) -> list[Row]:
    """All rows of a place."""
    config = synthetic.Config(views=6, width=640, height=480, seed=seed)
    frames, cameras = list(synthetic.stream(config)), synthetic.scene_cameras(config)
    snapshot = run(frames, preset("preview"))
    if len(snapshot.cameras) < 2:
        return [{"seed": seed, "what": "refused", "told": snapshot.verdict.message}]
    names = [frame.name for frame in frames]
    used = sorted(names.index(camera.name) for camera in snapshot.cameras)
    rows = of_odometry(make_metric_views(snapshot), [names[i] for i in used], [cameras[i][0] for i in used], seed)
    return [{"seed": seed, **row} for row in rows]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench motions", description=__doc__)
    parser.add_argument("--places", type=int, default=9, metavar="N")
    parser.add_argument("--out", type=Path, required=True, help="JSON")
    args = parser.parse_args()
    rows = []
    for seed in range(args.places):
        rows += place(seed)
        print(f"place {seed}: {len(rows)} rows", flush=True)
    command = shlex.join(["python", "-m", "tests.bench", "motions", *sys.argv[1:]])
    lines = ",\n".join(f"  {json.dumps(row)}" for row in rows)
    args.out.write_text(f'{{\n "command": {json.dumps(command)},\n "rows": [\n{lines}\n ]\n}}\n')
