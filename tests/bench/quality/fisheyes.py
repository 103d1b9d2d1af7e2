"""What a calibrated fisheye costs: the built-in capture through one, beside a pinhole that sees the same field.

    python -m tests.bench fisheyes --out fisheyes.json

Both are given their calibration, and both have as many pixels in all. Held-out photographs are taken through the same
lens and scored in the pinhole that it is brought into.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.image_file import encode_png
from splatnode.capture.lenses import undistort_frame, wide_pinhole
from splatnode.extras.evaluate.dataset import Split, load_scene
from splatnode.extras.evaluate.protocol import PerceptualNetworks, Settings
from splatnode.recon.config import preset
from splatnode.recon.pipeline import run
from splatnode.recon.result.export.staged import write_file, write_files
from splatnode.recon.result.export.stored import encode_cameras
from splatnode.recon.result.snapshot import CameraEstimate
from tests.bench.quality.held_out import Case, Scoring

WIDTH, HEIGHT = 640, 480
STEPS = 60  # of the search for a held-out photograph's camera


@dataclass(frozen=True)
class Result:
    across_deg: float  # of the fisheye
    views: int
    lens: str  # fisheye, or the pinhole of the same field
    preset: str
    verdict: str
    psnr: float | None  # dB, mean over the held-out photographs
    rotation_error_deg: float | None
    centre_error_pct: float | None
    num_gaussians: int | None


def equidistant(across_deg: float, width: int = WIDTH, height: int = HEIGHT) -> Intrinsics:
    """A fisheye that sees so much from left to right."""
    focal = width / math.radians(across_deg)
    return Intrinsics(width, height, focal, focal, width / 2, height / 2, "calibration", model="fisheye")


def measured(across_deg: float, views: int, pinhole: bool, chosen: str, folder: Path) -> Result:
    """One reconstruction, scored; photographs as they are modelled lie in `folder` then."""
    fisheye = equidistant(across_deg)
    lens = wide_pinhole("the photograph", fisheye) if pinhole else fisheye
    config = synthetic.Config(views=views, width=lens.width, height=lens.height, lens=lens)
    frames = list(synthetic.stream(config))
    held_out = [
        Frame(number, f"test_{number:03d}.png", number, synthetic.render_image(config, camera, number), lens)
        for number, camera in enumerate(synthetic.evaluation_cameras(config), start=views)
    ]
    poses = [T for T, _ in (*synthetic.scene_cameras(config), *synthetic.evaluation_cameras(config))]
    straight = [undistort_frame(frame) for frame in (*frames, *held_out)]
    cameras = [
        CameraEstimate(each.name, each.frame_id, T, each.intrinsics.K, each.width, each.height)
        for each, T in zip(straight, poses, strict=True)
        if each.intrinsics is not None
    ]
    write_files(folder / "images", {each.name: encode_png(each.image) for each in straight})
    write_file(folder / "cameras.json", encode_cameras(cameras))
    split = Split(tuple(frame.name for frame in frames), tuple(frame.name for frame in held_out))
    snapshot = run(frames, preset(chosen))
    scoring = Scoring(PerceptualNetworks(None, None), Settings(alignment_steps=STEPS))
    scored = Case(load_scene(folder), split).score(snapshot, chosen, scoring)
    errors = scored.rotation_error_deg, scored.centre_error_pct
    name = "pinhole" if pinhole else "fisheye"
    return Result(across_deg, views, name, chosen, scored.verdict, scored.psnr, *errors, scored.num_gaussians)


def write(path: Path, found: Sequence[Result]) -> None:
    """All that was measured, with the command that did it or added to it."""
    command = " ".join(["python -m tests.bench fisheyes", *sys.argv[1:]])
    path.write_text(json.dumps({"command": command, "results": [asdict(each) for each in found]}, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench fisheyes", description=__doc__)
    parser.add_argument("--across", nargs="+", type=float, default=[120.0, 170.0], metavar="DEGREES")
    parser.add_argument("--views", nargs="+", type=int, default=[6, 8], metavar="N")
    parser.add_argument("--preset", default="fast")
    parser.add_argument(
        "--out", type=Path, required=True, help="JSON, written after each; what it holds is not run again"
    )
    args = parser.parse_args()
    before = json.loads(args.out.read_text())["results"] if args.out.exists() else []
    found = [Result(**each) for each in before]
    done = {(each.across_deg, each.views, each.lens, each.preset) for each in found}
    for across_deg in args.across:
        for views in args.views:
            for pinhole, lens in ((False, "fisheye"), (True, "pinhole")):
                if (across_deg, views, lens, args.preset) in done:
                    continue
                with tempfile.TemporaryDirectory() as folder:
                    found.append(measured(across_deg, views, pinhole, args.preset, Path(folder)))
                write(args.out, found)
                print(found[-1], flush=True)
    write(args.out, found)
