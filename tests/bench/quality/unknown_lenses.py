"""How well a lens is found of which nothing is known: the built-in capture through lenses that bend lines.

    python -m tests.bench unknown_lenses --out unknown_lenses.json

Photographs carry no calibration. A lens is told by its coefficients: OpenCV's k1 and k2, whose focal length is .78 of
the picture's width, or a fisheye's degrees from left to right. `corner_error_px` is how far from a corner of the
picture the estimated lens shows what the true one shows there; `corner_moves_pct` is by how much of its distance from
the middle the true lens moves that corner.
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Intrinsics
from splatnode.capture.lenses import unproject
from splatnode.capture.process.terminal import say
from splatnode.extras.evaluate.protocol import compare_cameras
from splatnode.recon.config import ReconstructionConfig, preset
from splatnode.recon.estimation import Reconstruction, estimate_cameras, prepare
from splatnode.recon.geometry import distortion
from splatnode.recon.matching.view_graph import match
from tests.bench.quality.fisheyes import equidistant

Array = npt.NDArray[np.float64]

WIDTH, HEIGHT = 1024, 768
FOCAL = 0.78  # of the width, of lenses that are told by their coefficients
RADIAL = ((0.0, 0.0), (-0.05, 0.0), (-0.1, 0.0), (0.1, 0.0), (0.08, -0.02), (-0.1, 0.02), (-0.15, 0.03), (-0.2, 0.05))
FISHEYES_DEG = (70.0, 90.0, 120.0, 170.0)
CORNERS = np.array([[0.0, 0.0], [WIDTH, 0.0], [0.0, HEIGHT], [WIDTH, HEIGHT]])


@dataclass(frozen=True)
class Row:
    lens: str
    seed: int
    views: int
    corner_moves_pct: float | None  # None: the corner looks sideways, or back
    verdict: str
    published: bool
    radial: tuple[float, float] | None  # as estimated; None: no cameras
    focal_error_pct: float | None  # against the lens near the middle of its picture
    corner_error_px: float | None  # the largest
    rotation_error_deg: float | None
    centre_error_pct: float | None


def bending(k1: float, k2: float) -> Intrinsics:
    focal = FOCAL * WIDTH
    return Intrinsics(WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, "calibration", (k1, k2, 0.0, 0.0))


def lenses() -> dict[str, Intrinsics]:
    radial = {f"k1 {k1:+g}, k2 {k2:+g}": bending(k1, k2) for k1, k2 in RADIAL}
    return {**radial, **{f"fisheye {across:g}": equidistant(across, WIDTH, HEIGHT) for across in FISHEYES_DEG}}


def measured(name: str, lens: Intrinsics, views: int, seed: int, config: ReconstructionConfig) -> Row:
    place = synthetic.Config(views=views, width=WIDTH, height=HEIGHT, seed=seed, lens=lens)
    frames = [replace(frame, intrinsics=None) for frame in synthetic.stream(place)]
    graph = match((prepare(frame, config) for frame in frames), config.matching)
    estimate = estimate_cameras(graph, (), config)
    row = Row(name, seed, views, None, estimate.verdict.code.value, estimate.publishable, *(None,) * 5)
    row = replace(row, corner_moves_pct=corner_moves_pct(lens))
    true = [T for T, _ in synthetic.scene_cameras(place)]
    return against_truth(row, estimate, lens, true, unproject(CORNERS, lens))


def corner_moves_pct(lens: Intrinsics) -> float | None:
    """By how much of its distance from the middle a lens moves a corner at most; None where one looks back."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]) * (lens.width, lens.height)
    rays = unproject(corners, lens)
    if (rays[:, 2] <= 0).any():
        return None
    pinhole = lens.fx * rays[:, :2] / rays[:, 2:] + (lens.cx, lens.cy)
    furthest = np.linalg.norm(pinhole - corners, axis=1).max()
    return 100 * float(furthest) / math.hypot(lens.width / 2, lens.height / 2)


def against_truth(row: Row, estimate: Reconstruction, lens: Intrinsics, Ts_true: Sequence[Array], rays: Array) -> Row:
    """With the errors of the cameras and of their lens."""
    if estimate.registration is None or not estimate.registration.cameras:
        return row
    cameras = estimate.registration.cameras
    Ks = np.stack([np.diag([camera.focal, camera.focal, 1.0]) for camera in cameras])
    true = np.stack([Ts_true[camera.index] for camera in cameras])
    errors = compare_cameras(
        np.stack([each.T_world_camera for each in cameras]), true, Ks, np.stack([lens.K] * len(Ks))
    )
    first = cameras[0]
    corner_error = None
    if (rays[:, 2] > 0).all():
        straight = rays[:, :2] / rays[:, 2:]
        seen = first.focal * distortion((straight**2).sum(1), first.radial)[:, None] * straight + first.principal
        corner_error = float(np.linalg.norm(seen - CORNERS, axis=1).max())
    return replace(
        row,
        radial=(float(first.radial[0]), float(first.radial[1])),
        focal_error_pct=100 * (first.focal / lens.fx - 1),
        corner_error_px=corner_error,
        rotation_error_deg=errors.rotation_deg,
        centre_error_pct=errors.centre_pct,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench unknown_lenses",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--seeds", type=int, default=2, help="places, each with its photographer's path")
    parser.add_argument("--lenses", nargs="+", default=list(lenses()), metavar="LENS", help="of these names alone")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write; other lenses that it has are kept")
    args = parser.parse_args()
    command = shlex.join(["python", "-m", "tests.bench", "unknown_lenses", *sys.argv[1:]])
    before = json.loads(args.out.read_text()) if args.out.exists() else {"rows": []}
    rows = [row for row in before["rows"] if row["lens"] not in args.lenses]
    command = f"{before['command']}; {command}" if rows else command
    for name in args.lenses:
        for seed in range(args.seeds):
            rows.append(asdict(measured(name, lenses()[name], args.views, seed, preset("balanced"))))
            say(str(rows[-1]))
            args.out.write_text(json.dumps({"command": command, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
