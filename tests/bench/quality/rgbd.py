"""A simulated depth camera beside the built-in capture's: `python -m tests.bench rgbd --out FILE [--places N]`.

Each place is reconstructed from photographs alone and with depth images, once as it is and once with whitewashed walls,
at the built-in capture's own size and at half of it: the share of the visible surface that is found, to 2 % of its
depth at the pixel's centre. As it is, it is also seen by a depth camera that stands 2 cm aside, told or not.

Then many depth cameras are judged by the points of the same photographs: good ones, some noisier than they say, some
that lie 4 pixels (of 640) beside their photographs, some that stand 2 cm aside, told or not, and some whose depths are
3 % too large. The last are told beside a marker whose size is known to half a per cent. Of the built-in building a part
is seen, by VIEWS neighbouring keyframes of a walk. What --out holds is not run again.
"""

from __future__ import annotations

import argparse
import json
import shlex
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame
from splatnode.capture.process.terminal import say
from splatnode.extras.cameras import building
from splatnode.recon.config import preset
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.metric.depth_fit import DepthFit, fit_depth_images, make_depth_view
from splatnode.recon.metric.measurement import Measurement, MetricView, compute_scale_sigma
from splatnode.recon.metric.metres import measure_by_depth
from splatnode.recon.pipeline import estimate_frames
from splatnode.recon.result.snapshot import DepthCode
from splatnode.recon.threads import Clock
from tests.support.depth_camera import DepthCamera, add_depths, measure, photograph_depth, whitewash

VIEWS, SIZES = 6, ((640, 480), (320, 240))
WITHIN = 0.02  # of the true depth: found
SHIFT_PX = 4.0
ASIDE_M = 0.02
MARKER_SIGMA = 0.005
FEWEST_KEYFRAMES = 120  # of a walk
KINDS = {
    "good": DepthCamera(),
    "noisy": DepthCamera(noise_px=0.5),  # twice what it says
    "shifted": DepthCamera(shift_px=(SHIFT_PX, 0.0)),
    "aside": DepthCamera(aside_m=ASIDE_M),
    "aside, told": DepthCamera(aside_m=ASIDE_M, is_aside_told=True),
    "3 % too large": DepthCamera(scale=1.03),
}
CAMERAS = {"": DepthCamera(), "aside": KINDS["aside"], "aside, told": KINDS["aside, told"]}  # of reconstructions


@dataclass(frozen=True, eq=False)
class Truth:
    """A place as it is: poses, metres, and depths by the number of the photograph."""

    seed: int
    width: int  # of the photographs, pixels
    poses: dict[int, npt.NDArray[np.float64]]  # T_world_camera (4, 4)
    depths: dict[int, npt.NDArray[np.float32]]  # (H, W) z, infinite where nothing is


@dataclass(frozen=True)
class Surface:
    """What is found of the surface that the photographs of a place show. None where the place was refused."""

    place: int
    width: int  # of the photographs, pixels
    walls: str  # as they are, or whitewashed; of the building
    with_depth: bool
    camera: str  # one of CAMERAS
    verdict: str
    found: float | None  # share of the pixels whose depth is right to WITHIN
    known: float | None  # share of the pixels that have any depth
    median_error: float | None  # of those, as a share
    seconds: float  # of the processor


@dataclass(frozen=True)
class Judgement:
    """What the images say of one depth camera."""

    place: int
    kind: str
    code: str  # by the points of the photographs
    beside_marker: str  # the same, where a marker tells metres, too
    unit_error: float | None  # of metres a unit, as a share
    bound: float | None  # 95 %, as a share


def reconstruct(place: Truth, walls: str, frames: Sequence[Frame], camera: str = "") -> tuple[Surface, Reconstruction]:
    """Cameras and depth of a place, and what is found of its surface."""
    began = time.process_time()
    estimate, _ = estimate_frames(frames, preset("fast"), Clock())
    seconds = round(time.process_time() - began, 1)
    with_depth = any(frame.depth is not None for frame in frames)
    told = place.seed, place.width, walls, with_depth, camera, estimate.verdict.code.value
    if not estimate.verdict.publishable:
        return Surface(*told, None, None, None, seconds), estimate
    unit, errors, known = find_unit(estimate, place), [], []
    for pointmap in estimate.pointmaps.values():
        true = place.depths[pointmap.frame_id]
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
    return Surface(*told, found, share, float(np.median(error[has])), seconds), estimate


def find_unit(estimate: Reconstruction, place: Truth) -> float:
    """True metres for one unit of the estimate, by the distances between its cameras."""
    assert estimate.registration is not None
    keyframes = estimate.graph.keyframes
    own = np.array([camera.T_world_camera[:3, 3] for camera in estimate.registration.cameras])
    theirs = np.array(
        [place.poses[keyframes[camera.index].frame.frame_id][:3, 3] for camera in estimate.registration.cameras]
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
        depth = photograph_depth(place, camera, keyframe.frame.frame_id)
        keyframe = replace(keyframe, frame=replace(keyframe.frame, depth=depth))
        views.append(make_depth_view(keyframe, estimate.registration, each))
    (fit,) = fit_depth_images(views)
    true = find_unit(estimate, know(place))
    error = MARKER_SIGMA * float(np.random.default_rng([seed, 8]).normal())
    marker = Measurement(true * float(np.exp(error)), MARKER_SIGMA, "a marker")
    _, check = measure_by_depth(fit, compute_scale_sigma(list_metric_views(estimate)), marker)
    return Judgement(place.seed, kind, fit.check.code.value, check.code.value, *_compute_errors(fit, true))


def list_metric_views(estimate: Reconstruction) -> list[MetricView]:
    """The cameras of an estimate with their bounds; lenses are of no account for them."""
    assert estimate.registration is not None
    found, nothing = [], np.zeros(2)
    for camera in estimate.registration.cameras:
        bound = estimate.bounds[estimate.graph.names[camera.index]].centre
        found.append(MetricView(camera.T_world_camera, 1.0, nothing, nothing, bound))
    return found


def _compute_errors(fit: DepthFit, true: float) -> tuple[float | None, float | None]:
    if not fit.is_usable:
        return None, None
    return fit.metres_per_unit / true - 1.0, 1.96 * fit.sigma


def summarize(surfaces: Sequence[Surface], judged: Sequence[Judgement]) -> dict[str, object]:
    """Means of found surface, and how many depth cameras are named, rightly or wrongly."""
    means: dict[str, list[Surface]] = {}
    for each in surfaces:
        depth = f"with depth{each.camera and f' from a camera {each.camera}'}" if each.with_depth else "without depth"
        means.setdefault(f"{each.width} pixels, walls {each.walls}, {depth}", []).append(each)
    return {
        "surface": {name: _average(rows) for name, rows in means.items()},
        "depth_cameras": {kind: _count(kind, [each for each in judged if each.kind == kind]) for kind in KINDS},
    }


def _average(rows: Sequence[Surface]) -> dict[str, object]:
    answered = [each for each in rows if each.found is not None]
    mean = {
        name: float(np.mean([getattr(each, name) for each in answered])) if answered else None
        for name in ("found", "median_error")
    }
    return {"places": len(rows), "answered": len(answered), **mean}


def _count(kind: str, rows: Sequence[Judgement]) -> dict[str, object]:
    errors = [(abs(each.unit_error), each.bound or 0.0) for each in rows if each.unit_error is not None]
    return {
        "cameras": len(rows),
        "named_shifted": sum(each.code == DepthCode.SHIFTED.value for each in rows),
        "named_otherwise": sum(each.code not in (DepthCode.SHIFTED.value, DepthCode.FITS.value) for each in rows),
        "named_scale_beside_marker": sum(each.beside_marker == DepthCode.SCALE.value for each in rows),
        "largest_unit_error": max((error for error, _ in errors), default=None),
        "beyond_bound": 0 if kind == "3 % too large" else sum(error > bound for error, bound in errors),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="JSON file")
    parser.add_argument("--places", type=int, default=10)
    parser.add_argument("--cameras", type=int, default=10, help="depth cameras of each kind and place")
    arguments = parser.parse_args()
    held = json.loads(arguments.out.read_text()) if arguments.out.exists() else {"surfaces": [], "judged": []}
    surfaces, judged = [Surface(**each) for each in held["surfaces"]], [Judgement(**each) for each in held["judged"]]
    done = {each.place for each in judged}
    for seed in range(arguments.places):
        if seed in done:
            continue
        for width, height in SIZES:
            place = synthetic.Config(views=VIEWS, width=width, height=height, seed=seed)
            rows, estimate = measure_place(place, ("",) if width == SIZES[-1][0] else tuple(CAMERAS))
            surfaces += rows
        surfaces += measure_building(seed)
        assert estimate.registration is not None  # of the smaller photographs, whose depth images are judged
        judged += [judge(estimate, place, kind, 100 * seed + n) for kind in KINDS for n in range(arguments.cameras)]
        told = summarize(surfaces, judged)
        say(f"place {seed}: {json.dumps(told)}")
        command = ["python", "-m", "tests.bench", "rgbd", f"--places={arguments.places}"]
        content = {"command": shlex.join([*command, f"--cameras={arguments.cameras}"]), "summary": told}
        content |= {"surfaces": list(map(asdict, surfaces)), "judged": list(map(asdict, judged))}
        arguments.out.write_text(json.dumps(content, indent=1) + "\n")


def measure_place(place: synthetic.Config, cameras: Sequence[str]) -> tuple[list[Surface], Reconstruction]:
    """What is found of a place, and its reconstruction from photographs alone, walls as they are."""
    frames, true = list(synthetic.stream(place)), know(place)
    alone, estimate = reconstruct(true, "as they are", frames)
    rows = [alone]
    for name in cameras:
        measured = add_depths(frames, place, replace(CAMERAS[name], seed=place.seed))
        rows.append(reconstruct(true, "as they are", measured, name)[0])
    plain = whitewash(frames, place)
    for images in (plain, add_depths(plain, place, DepthCamera(seed=place.seed))):
        rows.append(reconstruct(true, "whitewashed", images)[0])
    return rows, estimate


def know(place: synthetic.Config) -> Truth:
    """The poses and depths of a place of the built-in capture."""
    poses = {index: T for index, (T, _) in enumerate(synthetic.scene_cameras(place))}
    return Truth(place.seed, place.width, poses, {index: synthetic.depth(place, index) for index in poses})


def measure_building(seed: int) -> list[Surface]:
    """What is found of a part of the building, alone and with depth images: another part for each seed."""
    config = building.Config(keyframes=FEWEST_KEYFRAMES, seed=seed)
    indices = range(seed * VIEWS, (seed + 1) * VIEWS)
    true = Truth(
        seed,
        config.width,
        {index: building.scene_camera(config, index)[0] for index in indices},
        {index: building.depth(config, index) for index in indices},
    )
    frames = [
        Frame(index, building.frame_name(index), index, building.render_image(config, index), None) for index in indices
    ]
    camera = DepthCamera(seed=seed)
    measured = [replace(each, depth=measure(true.depths[each.frame_id], camera, each.frame_id)) for each in frames]
    return [reconstruct(true, "of the building", images)[0] for images in (frames, measured)]


if __name__ == "__main__":
    main()
