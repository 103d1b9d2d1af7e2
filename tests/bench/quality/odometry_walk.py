"""A walk with odometry and a depth camera, in the odometry's frame: `python -m tests.bench odometry_walk --out FILE`.

Neighbouring keyframes of the built-in building, each with the motion and the gravity that wheels and an IMU tell, which
drift, and a depth image of a simulated OAK. Cameras are estimated from all together, without a scene. Positions are
compared in the frame in which the odometry began, without any alignment, as shares of the way; up by the first camera.
"""

from __future__ import annotations

import argparse
import json
import shlex
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from splatnode.capture.diorama import Config as Odometry
from splatnode.capture.diorama import odometry
from splatnode.capture.frame import Frame
from splatnode.capture.process.terminal import say
from splatnode.extras.cameras import building
from splatnode.recon import modelling
from splatnode.recon.config import preset
from splatnode.recon.estimation import load_prior
from splatnode.recon.metric.measurement import MetricConfig
from splatnode.recon.metric.metres import apply_metric_scale, gather_evidence
from splatnode.recon.pipeline import estimate_frame_cameras
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.threads import Clock
from tests.support.depth_camera import DepthCamera, measure

NOISE = Odometry(drift=0.01, noise_deg=0.2)  # of each step


@dataclass(frozen=True)
class Row:
    """One walk. Errors are None where there is no answer."""

    seed: int
    keyframes: int
    placed: int
    verdict: str
    way_m: float
    metric: bool
    worst_percent: float | None  # of the way, of the position that is worst
    median_percent: float | None
    odometry_percent: float  # of the way, by which odometry alone is off at worst
    unit_percent: float | None  # error of metres, by the distances between cameras
    up_deg: float | None
    up_sigma_deg: float | None
    seconds: float  # of the processor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    parser.add_argument("--keyframes", type=int, default=120)
    parser.add_argument("--walks", type=int, default=1)
    args = parser.parse_args()
    rows = []
    for seed in range(args.walks):
        rows.append(walk(seed, args.keyframes))
        say(json.dumps(asdict(rows[-1])))
        told = f"--keyframes={args.keyframes}", f"--walks={args.walks}"
        content = {"command": shlex.join(["python", "-m", "tests.bench", "odometry_walk", *told])}
        args.out.write_text(
            json.dumps({**content, "noise": NOISE_TOLD, "rows": list(map(asdict, rows))}, indent=1) + "\n"
        )


NOISE_TOLD = {"drift": NOISE.drift, "noise_deg": NOISE.noise_deg}


def walk(seed: int, keyframes: int) -> Row:
    """Estimates the cameras of a walk, and compares them with the true ones."""
    config = building.Config(keyframes=keyframes, seed=seed)
    Ts = [building.scene_camera(config, index)[0] for index in range(keyframes)]
    names = [building.frame_name(index) for index in range(keyframes)]
    camera, moved = DepthCamera(seed=seed), odometry(names, Ts, NOISE, seed)
    frames = []
    for index, (name, (motion, gravity)) in enumerate(zip(names, moved, strict=True)):
        depth = measure(building.depth(config, index), camera, index)
        image = building.render_image(config, index)
        frame = Frame(index, name, index * 500_000_000, image, None, depth=depth)
        frames.append(replace(frame, motion=motion, gravity=gravity))
    began = time.process_time()
    snapshot = _estimate(frames)
    seconds = round(time.process_time() - began, 1)
    own = {each.name: each.T_world_camera[:3, 3] for each in snapshot.cameras}
    true = {name: (np.linalg.inv(Ts[0]) @ T)[:3, 3] for name, T in zip(names, Ts, strict=True)}
    way_m = float(np.linalg.norm(np.diff([T[:3, 3] for T in Ts], axis=0), axis=1).sum())
    alone = max(
        float(np.linalg.norm(each.matrix[:3, 3] - true[name])) for name, (each, _) in zip(names, moved, strict=True)
    )
    told = seed, keyframes, len(own), snapshot.verdict.code.value, way_m, snapshot.scale.metric
    if len(own) < 2 or not snapshot.scale.metric:
        return Row(*told, None, None, 100 * alone / way_m, None, None, None, seconds)
    off = np.array([np.linalg.norm(own[name] - true[name]) for name in own])
    pairs = np.triu_indices(len(own), 1)
    apart = [
        np.linalg.norm((points[:, None] - points[None])[pairs], axis=-1)
        for points in (np.array(list(own.values())), np.array([true[name] for name in own]))
    ]
    unit = float(np.median(apart[0] / np.maximum(apart[1], 1e-9)) - 1.0)
    up_deg, up_sigma = None, None
    if snapshot.up is not None:  # as the first camera sees it: the frame itself is as the odometry has it
        first = next(each for each in snapshot.cameras if each.name in true)
        here = Ts[names.index(first.name)][:3, :3] @ first.T_world_camera[:3, :3].T @ np.array(snapshot.up.direction)
        up_deg = float(np.degrees(np.arccos(np.clip(here[2], -1.0, 1.0))))
        up_sigma = snapshot.up.sigma_deg
    shares = 100 * off / way_m
    return Row(
        *told, float(shares.max()), float(np.median(shares)), 100 * alone / way_m, 100 * unit, up_deg, up_sigma, seconds
    )


def _estimate(frames: list[Frame]) -> Snapshot:
    """The cameras of all frames, and what is published of them in the odometry's frame."""
    config = preset("fast")
    estimate, dropped = estimate_frame_cameras(frames, load_prior(config), config, Clock())
    look = modelling.create_coarse_preview(estimate, config)
    show = look or modelling.SceneWithVerdict()
    made = modelling.snapshot(0, estimate.summary, show, config, seconds={}, dropped=dropped)
    metric = MetricConfig(frame="odometry")
    return apply_metric_scale(modelling.add_landmarks(made, estimate), metric, gather_evidence(frames, metric))


if __name__ == "__main__":
    main()
