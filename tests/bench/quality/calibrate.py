"""How right `splatnode calibrate` is: photographs of a rendered board through known lenses, the model left to it.

    python -m tests.bench calibrate --out calibrate.json

The board is shown as somebody would who follows the grid. The corner error is how far from a corner of the picture the
found lens sees the ray that the true lens sees there; nothing is aligned before.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from splatnode.capture import lenses
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.extras.calibration.board import Board
from splatnode.extras.calibration.collect import (
    CORNERS,
    ENOUGH,
    Gathering,
    describe_missing_coverage,
    describe_uncertainty,
)
from splatnode.extras.calibration.estimate import choose, pixel_sigmas
from tests.support.board_photographs import Photographer, waved

WIDTH, HEIGHT = 960, 720
CX, CY = 485.3, 355.8  # not the picture's middle


def _lens(fx: float, fy: float, terms: tuple[float, ...] = (), model: str = "opencv") -> Intrinsics:
    return Intrinsics(WIDTH, HEIGHT, fx, fy, CX, CY, "given", terms, model)


def _across(degrees: float) -> float:
    """The focal length of an equidistant fisheye that sees so much from left to right."""
    return WIDTH / math.radians(degrees)


LENSES = {
    "pinhole": _lens(800.0, 801.0),
    "k1 = −.3": _lens(960.0, 961.0, (-0.3, 0.0, 0.0, 0.0)),
    "8 terms": _lens(560.0, 561.0, (1.2, 0.15, 0.0006, -0.0004, 0.01, 1.5, 0.42, 0.02)),
    "fisheye, 120 degrees": _lens(_across(120.0), _across(120.0), (0.01, -0.005, 0.002, -0.0004), "fisheye"),
    "fisheye, 170 degrees": _lens(_across(170.0), _across(170.0), (0.01, -0.005, 0.001, -0.0002), "fisheye"),
}


@dataclass(frozen=True)
class Result:
    lens: str
    seed: int
    photographs: int
    views: int  # that were kept of them
    model: str  # that was taken
    focal_error_pct: float  # the larger of fx and fy
    focal_sigma_pct: float  # as it is told
    corner_error_px: float  # the largest of four
    corner_sigma_px: float  # as it is told, of that corner
    residual_px: float
    missing: tuple[str, ...]  # for which the verb would have refused
    seconds: float  # without those of the rendering


def measured(name: str, photographs: int, seed: int) -> Result:
    true, board = LENSES[name], Board()
    photographer = Photographer(board, true)
    gathering, taken_s = Gathering(board, moving=False), 0.0
    for number, T in enumerate(waved(board, true, photographs, seed)):
        frame = Frame(number, f"{number:03d}", number, photographer.photograph(T, 1000 * seed + number), None)
        began_s = time.monotonic()
        gathering.take(frame)
        taken_s += time.monotonic() - began_s
    began_s = time.monotonic()
    choice, coverage = choose(gathering.views, board, WIDTH, HEIGHT), gathering.coverage
    taken_s += time.monotonic() - began_s
    if choice is None or coverage is None:
        raise ValueError(f"no lens explains the views of {name}, seed {seed}")
    found = choice.taken.estimate
    missing = [*filter(None, [describe_missing_coverage(coverage)]), *describe_uncertainty(found, coverage, ENOUGH)]
    corners = np.array([[x * WIDTH, y * HEIGHT] for x, y in CORNERS.values()], np.float64)
    errors = np.linalg.norm(lenses.project(lenses.unproject(corners, true), found.lens) - corners, axis=1)
    worst = int(np.argmax(errors))
    return Result(
        name,
        seed,
        photographs,
        len(found.names),
        found.model.name,
        100 * max(abs(found.lens.fx / true.fx - 1), abs(found.lens.fy / true.fy - 1)),
        100 * found.focal_sigma,
        float(errors[worst]),
        float(pixel_sigmas(found, corners)[worst]),
        found.rms_px,
        tuple(missing),
        round(taken_s, 2),
    )


def write(path: Path, found: Sequence[Result]) -> None:
    """All that was measured, with the command that did it or added to it."""
    command = " ".join(["python -m tests.bench calibrate", *sys.argv[1:]])
    path.write_text(json.dumps({"command": command, "results": [asdict(each) for each in found]}, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench calibrate", description=__doc__)
    parser.add_argument("--photographs", type=int, default=60, metavar="N")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3], metavar="N")
    parser.add_argument(
        "--out", type=Path, required=True, help="JSON, written after each; what it holds is not run again"
    )
    args = parser.parse_args()
    before = json.loads(args.out.read_text())["results"] if args.out.exists() else []
    found = [Result(**{**each, "missing": tuple(each["missing"])}) for each in before]
    done = {(each.lens, each.seed, each.photographs) for each in found}
    for seed in args.seeds:
        for name in LENSES:
            if (name, seed, args.photographs) not in done:
                found.append(measured(name, args.photographs, seed))
                write(args.out, found)
                print(found[-1], flush=True)
    write(args.out, found)
