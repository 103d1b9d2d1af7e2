"""A simulated depth camera beside the built-in capture's: `python -m tests.bench rgbd --out FILE [--places N]`.

Each place is reconstructed from photographs alone and with depth images, once as it is and once with whitewashed walls:
the share of the visible surface that is found, to 2 % of its depth, and the error of metres with its bound. Then many
depth cameras are judged by the points of the same photographs: good ones, some noisier than they say, and some that lie
4 pixels (of 640) beside their photographs, which must be named.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame
from splatnode.capture.process.terminal import say
from splatnode.recon.config import preset
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.metric.depth_fit import DepthFit, fit_depth_images, make_depth_view
from splatnode.recon.pipeline import estimate_frames
from splatnode.recon.result.snapshot import DepthCode
from splatnode.recon.threads import Clock
from tests.support.depth_camera import DepthCamera, add_depths, measure, whitewash

VIEWS, SIZE = 6, (320, 240)
WITHIN = 0.02  # of the true depth: found
SHIFT_PX = 4.0
KINDS = {
    "good": DepthCamera(),
    "noisy": DepthCamera(noise_px=0.5),  # twice what it says
    "shifted": DepthCamera(shift_px=(SHIFT_PX, 0.0)),
}


@dataclass(frozen=True)
class Surface:
    """What is found of the surface that the photographs of a place show. None where the place was refused."""

    place: int
    walls: str  # as they are, or whitewashed
    with_depth: bool
    verdict: str
    found: float | None  # share of the pixels whose depth is right to WITHIN
    known: float | None  # share of the pixels that have any depth
    median_error: float | None  # of those, as a share
    seconds: float


@dataclass(frozen=True)
class Judgement:
    """What the images say of one depth camera."""

    place: int
    kind: str
    code: str
    unit_error: float | None  # of metres a unit, as a share
    bound: float | None  # 95 %, as a share


def reconstruct(place: synthetic.Config, walls: str, frames: Sequence[Frame]) -> tuple[Surface, Reconstruction]:
    """Cameras and depth of a place, and what is found of its surface."""
    began = time.perf_counter()
    estimate, _ = estimate_frames(frames, preset("fast"), Clock())
    seconds = time.perf_counter() - began
    with_depth = any(frame.depth is not None for frame in frames)
    code = estimate.verdict.code.value
    if not estimate.verdict.publishable:
        return Surface(place.seed, walls, with_depth, code, None, None, None, seconds), estimate
    unit, errors, known = find_unit(estimate, place), [], []
    for pointmap in estimate.pointmaps.values():
        true = synthetic.depth(place, pointmap.frame_id)
        height, width = pointmap.depth.shape
        rows, columns = (
            ((np.arange(size) + 0.5) * full / size).astype(int)
            for size, full in zip((height, width), true.shape, strict=True)
        )
        true = true[np.ix_(rows, columns)]
        seen = np.isfinite(true)
        has = seen & (pointmap.depth > 0)
        error = np.where(has, np.abs(unit * pointmap.depth / np.where(seen, true, 1.0) - 1.0), np.inf)
        errors.append(error[seen])
        known.append(has[seen])
    error, has = np.concatenate(errors), np.concatenate(known)
    found, share = float((error <= WITHIN).mean()), float(has.mean())
    return Surface(place.seed, walls, with_depth, code, found, share, float(np.median(error[has])), seconds), estimate


def find_unit(estimate: Reconstruction, place: synthetic.Config) -> float:
    """True metres for one unit of the estimate, by the distances between its cameras."""
    assert estimate.registration is not None
    true = synthetic.scene_cameras(place)
    keyframes = estimate.graph.keyframes
    own = np.array([camera.T_world_camera[:3, 3] for camera in estimate.registration.cameras])
    theirs = np.array(
        [true[keyframes[camera.index].frame.frame_id][0][:3, 3] for camera in estimate.registration.cameras]
    )
    pairs = np.triu_indices(len(own), 1)
    apart = (np.linalg.norm((each[:, None] - each[None])[pairs], axis=-1) for each in (theirs, own))
    return float(np.median(np.divide(*apart)))


def judge(estimate: Reconstruction, place: synthetic.Config, kind: str, seed: int) -> Judgement:
    """What the points of the photographs say of one more depth camera."""
    assert estimate.registration is not None
    camera = replace(KINDS[kind], seed=seed)
    if kind == "shifted":
        angle = 2 * np.pi * np.random.default_rng([seed, 7]).random()
        camera = replace(camera, shift_px=(SHIFT_PX * float(np.cos(angle)), SHIFT_PX * float(np.sin(angle))))
    views = []
    for each in estimate.registration.cameras:
        keyframe = estimate.graph.keyframes[each.index]
        number = keyframe.frame.frame_id
        depth = measure(synthetic.depth(place, number), camera, number)
        keyframe = replace(keyframe, frame=replace(keyframe.frame, depth=depth))
        views.append(make_depth_view(keyframe, estimate.registration, each))
    (fit,) = fit_depth_images(views)
    return Judgement(place.seed, kind, fit.check.code.value, *_compute_errors(fit, find_unit(estimate, place)))


def _compute_errors(fit: DepthFit, true: float) -> tuple[float | None, float | None]:
    if not fit.is_usable:
        return None, None
    return fit.metres_per_unit / true - 1.0, 1.96 * fit.sigma


def summarize(surfaces: Sequence[Surface], judged: Sequence[Judgement]) -> dict[str, object]:
    """Means of found surface, and how many depth cameras are named, rightly or wrongly."""
    means = {}
    for walls in ("as they are", "whitewashed"):
        for with_depth in (False, True):
            rows = [each for each in surfaces if (each.walls, each.with_depth) == (walls, with_depth)]
            answered = [each for each in rows if each.found is not None]
            means[f"{walls}, {'with' if with_depth else 'without'} depth"] = {
                "places": len(rows),
                "answered": len(answered),
                "found": float(np.mean([each.found or 0.0 for each in answered])) if answered else None,
                "median_error": float(np.mean([each.median_error or 0.0 for each in answered])) if answered else None,
            }
    codes = {}
    for kind in KINDS:
        rows = [each for each in judged if each.kind == kind]
        errors = [(abs(each.unit_error), each.bound or 0.0) for each in rows if each.unit_error is not None]
        codes[kind] = {
            "cameras": len(rows),
            "named_shifted": sum(each.code == DepthCode.SHIFTED.value for each in rows),
            "named_otherwise": sum(each.code not in (DepthCode.SHIFTED.value, DepthCode.FITS.value) for each in rows),
            "largest_unit_error": max((error for error, _ in errors), default=None),
            "beyond_bound": sum(error > bound for error, bound in errors),
        }
    return {"surface": means, "depth_cameras": codes}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="JSON file")
    parser.add_argument("--places", type=int, default=10)
    parser.add_argument("--cameras", type=int, default=10, help="depth cameras of each kind and place")
    arguments = parser.parse_args()
    surfaces, judged = [], []
    for seed in range(arguments.places):
        place = synthetic.Config(views=VIEWS, width=SIZE[0], height=SIZE[1], seed=seed)
        frames = list(synthetic.stream(place))
        for walls, images in (("as they are", frames), ("whitewashed", whitewash(frames, place))):
            alone, estimate = reconstruct(place, walls, images)
            measured, _ = reconstruct(place, walls, add_depths(images, place, DepthCamera(seed=seed)))
            surfaces += [alone, measured]
            if walls == "as they are" and alone.found is not None:
                for kind in KINDS:
                    judged += [judge(estimate, place, kind, 100 * seed + n) for n in range(arguments.cameras)]
        told = summarize(surfaces, judged)
        say(f"place {seed}: {json.dumps(told)}")
        content = {"summary": told, "surfaces": list(map(asdict, surfaces)), "judged": list(map(asdict, judged))}
        arguments.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
