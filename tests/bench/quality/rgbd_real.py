"""Depth images of recorded scenes: `python -m tests.bench rgbd_real --shared ../shared --out FILE`.

Stereo of all photographs of a scene with their true cameras stands in for a depth camera, where at least two further
photographs agree: with the noise and the holes of a simulated OAK, at a median depth of 3 m. Each case is a few of the
photographs, reconstructed alone and with depth images: the share of the surface so known that is found to 2 %. Depth
cameras are judged as in `rgbd`: good ones, some 4 pixels (of 640) aside, and some whose depths are 3 % too large,
beside a marker. What --out holds is not run again.
"""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame
from splatnode.capture.process.terminal import say
from splatnode.recon.config import preset
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.geometry import Similarity, align_cameras
from splatnode.recon.metric.depth_fit import fit_depth_images, make_depth_view
from splatnode.recon.metric.measurement import Measurement, compute_scale_sigma
from splatnode.recon.metric.metres import measure_by_depth
from splatnode.recon.pipeline import estimate_frames
from splatnode.recon.result.snapshot import DepthCode
from splatnode.recon.threads import Clock
from tests.bench.quality import known_surfaces
from tests.bench.quality.held_out import Folders, load_case
from tests.bench.quality.rgbd import KINDS, MARKER_SIGMA, SHIFT_PX, WITHIN, list_metric_views
from tests.support.depth_camera import DepthCamera, measure

CASES = ("fountain_p11:6", "llff_flower:6", "llff_fern:6", "tum_fr3_office:6", "sceaux:6", "entry_p10:3")
JUDGED = ("good", "shifted", "3 % too large")
MEDIAN_M = 3.0  # of all known depths


@dataclass(frozen=True)
class Row:
    """One case. Counts are of depth cameras; shares are None where the case is refused."""

    case: str
    known: float  # share of the photographs' pixels whose depth the stand-in knows
    alone: str
    verdict: str
    found_alone: float | None
    found: float | None
    cameras: int  # of each kind
    good_named: int  # by the points, or beside the marker; not those that rough cameras leave untested
    shifted_named: int
    scale_named: int
    worst_unit_percent: float | None  # of the good ones, after those that are wrong by what stereo knows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=list(CASES))
    parser.add_argument("--shared", type=Path, default=Path("../shared"), help="folder with scenes/")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    parser.add_argument("--cameras", type=int, default=20, help="depth cameras of each kind and case")
    args = parser.parse_args()
    rows = [Row(**row) for row in json.loads(args.out.read_text())["rows"]] if args.out.exists() else []
    for case in args.cases:
        if case in {row.case for row in rows}:
            continue
        rows.append(measure_case(case, Folders(args.shared / "scenes", args.shared), args.cameras))
        say(json.dumps(asdict(rows[-1])))
        told = "--shared", "../shared", f"--cameras={args.cameras}"
        content = {"command": shlex.join(["python", "-m", "tests.bench", "rgbd_real", *told])}
        args.out.write_text(json.dumps({**content, "rows": list(map(asdict, rows))}, indent=1) + "\n")


def measure_case(name: str, folders: Folders, cameras: int) -> Row:
    """Reconstructs a case alone and with depth images, and judges depth cameras."""
    case = load_case(name, folders)
    frames = case.scene.frames(case.split.train)
    poses = {frame.name: case.scene.cameras[frame.name].T_world_camera for frame in frames}
    alone, _ = estimate_frames(frames, preset("fast"), Clock())
    code = alone.verdict.code.value
    if alone.registration is None or not alone.verdict.publishable:
        return Row(name, 0.0, code, "", None, None, 0, 0, 0, 0, None)
    surfaces = known_surfaces.of_photographs(case.scene, alone.registration.points, _align(alone, poses))
    depths = {frame.name: surfaces.views[frame.name].depth for frame in frames}
    metres = MEDIAN_M / float(np.median(np.concatenate([each[each > 0] for each in depths.values()])))
    true = {each: np.where(depth > 0, metres * depth, np.inf).astype(np.float32) for each, depth in depths.items()}
    measured = [
        replace(frame, depth=measure(true[frame.name], DepthCamera(), number)) for number, frame in enumerate(frames)
    ]
    found, _ = estimate_frames(measured, preset("fast"), Clock())
    known = float(np.mean([np.isfinite(each).mean() for each in true.values()]))
    shares = [_find(each, poses, metres, true) for each in (alone, found)]
    unit = metres * _align(alone, poses).scale
    named, errors = dict.fromkeys(JUDGED, 0), []
    for kind in JUDGED:
        for seed in range(cameras):
            codes, error = judge(alone, frames, true, unit, kind, seed)
            wanted = {"good": DepthCode.FITS, "shifted": DepthCode.SHIFTED, "3 % too large": DepthCode.SCALE}[kind]
            accused = codes[-1] not in (DepthCode.FITS, DepthCode.UNTESTED)
            named[kind] += accused if kind == "good" else wanted in codes
            errors += [abs(error)] if kind == "good" and error is not None else []
    worst = 100 * max(errors) if errors else None
    return Row(name, known, code, found.verdict.code.value, *shares, cameras, *named.values(), worst)


def _align(estimate: Reconstruction, poses: Mapping[str, npt.NDArray[np.float64]]) -> Similarity:
    """From the estimate's world to the true one."""
    assert estimate.registration is not None
    own = {estimate.graph.names[each.index]: each.T_world_camera for each in estimate.registration.cameras}
    return align_cameras(np.stack(list(own.values())), np.stack([poses[name] for name in own]))


def _find(
    estimate: Reconstruction,
    poses: Mapping[str, npt.NDArray[np.float64]],
    metres: float,
    true: Mapping[str, npt.NDArray[np.float32]],
) -> float | None:
    """The share of the known surface that the point maps have to WITHIN."""
    if not estimate.pointmaps:
        return None
    unit, right = metres * _align(estimate, poses).scale, []
    for name, pointmap in estimate.pointmaps.items():
        height, width = pointmap.depth.shape
        rows, columns = (
            ((np.arange(size) + 0.5) * full / size).astype(int)
            for size, full in zip((height, width), true[name].shape, strict=True)
        )
        there = true[name][np.ix_(rows, columns)]
        seen = np.isfinite(there)
        error = np.abs(unit * pointmap.depth / np.where(seen, there, 1.0) - 1.0)
        right.append((error <= WITHIN)[seen])
    return float(np.concatenate(right).mean())


def judge(
    estimate: Reconstruction,
    frames: Sequence[Frame],
    true: Mapping[str, npt.NDArray[np.float32]],
    unit: float,
    kind: str,
    seed: int,
) -> tuple[tuple[DepthCode, DepthCode], float | None]:
    """The codes by the points and beside a marker, and the error of metres a unit."""
    assert estimate.registration is not None
    camera, rng = replace(KINDS[kind], seed=1000 + seed), np.random.default_rng([seed, 7])
    if kind == "shifted":
        angle = 2 * np.pi * rng.random()
        camera = replace(camera, shift_px=(SHIFT_PX * float(np.cos(angle)), SHIFT_PX * float(np.sin(angle))))
    numbers, views = {frame.name: number for number, frame in enumerate(frames)}, []
    for each in estimate.registration.cameras:
        keyframe = estimate.graph.keyframes[each.index]
        depth = measure(true[keyframe.name], camera, numbers[keyframe.name])
        views.append(
            make_depth_view(replace(keyframe, frame=replace(keyframe.frame, depth=depth)), estimate.registration, each)
        )
    (fit,) = fit_depth_images(views)
    marker = Measurement(unit * float(np.exp(MARKER_SIGMA * rng.normal())), MARKER_SIGMA, "a marker")
    _, check = measure_by_depth(fit, compute_scale_sigma(list_metric_views(estimate)), marker)
    return (fit.check.code, check.code), fit.metres_per_unit / unit - 1.0 if fit.is_usable else None


if __name__ == "__main__":
    main()
