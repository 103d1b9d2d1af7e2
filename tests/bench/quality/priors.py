"""What learned priors take and how good they are: `python -m tests.bench priors --scene fountain_p11 --json FILE`.

MASt3R at full size has weights generated from their names: its time and its memory are real, its answers are not. The
alignment is that of synthetic pair predictions (tests/recon/priors/test_mast3r_global_alignment.py). PatchmatchNet has
its own weights and the true cameras of a scene; the reference are triangulated SIFT points
(tests/bench/speed/stereo.py). Each part is a process of its own, so that its memory is its own.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch

from splatnode.extras.evaluate.protocol import compare_cameras
from splatnode.recon.priors.mast3r import Mast3r, align_views
from splatnode.recon.priors.stereo import StereoConfig
from splatnode.recon.result.report import peak_rss_mb
from tests.bench.speed.stereo import METHODS, make_case, run
from tests.recon.priors.test_mast3r_global_alignment import cameras, intrinsics, predictions
from tests.support.generated import generated_weights

BARS = {
    "mast3r": {"seconds_pair": 15.0, "peak_rss_mb": 4000.0},
    "alignment": {"rotation_deg": 0.2, "centre_pct": 0.5, "seconds": 5.0},
    "patchmatchnet": {"median_relative_error": 0.0025},
}
"""At most."""


def mast3r(_: Path, repeats: int = 3) -> dict[str, float]:
    """A pair at 512 x 384: both images encoded, decoded once."""
    with torch.device("meta"):
        network = Mast3r()
    network.load_state_dict(generated_weights(Mast3r), assign=True)
    network.eval().requires_grad_(False)
    images = torch.rand(2, 3, 384, 512, generator=torch.Generator().manual_seed(0)) * 2 - 1
    seconds = []
    with torch.inference_mode():
        for _again in range(repeats):
            started = time.perf_counter()
            network.decode(*(network.encode(image) for image in images))
            seconds.append(time.perf_counter() - started)
    peak = peak_rss_mb()
    assert peak is not None
    return {"seconds_pair": min(seconds), "peak_rss_mb": peak, "threads": torch.get_num_threads()}


def alignment(_: Path, count: int = 12) -> dict[str, float]:
    """The worst of five seeds: 12 views, every ordered pair, 1 % noise, a fifth of the pairs wrong."""
    found = []
    for seed in range(5):
        truth = cameras(count)
        pairs = predictions(truth, 0.01, 0.2, np.random.default_rng(seed))
        started = time.perf_counter()
        views = align_views(pairs)
        seconds = time.perf_counter() - started
        estimated = np.stack([view.T_world_camera for view in views])
        Ks = intrinsics([view.focal for view in views])
        errors = compare_cameras(estimated, truth, Ks, intrinsics([45.0] * count))
        found.append((errors.rotation_deg, errors.centre_pct, seconds))
    worst = np.max(np.array(found, np.float64), axis=0)
    return dict(zip(("rotation_deg", "centre_pct", "seconds"), worst.tolist(), strict=True))


def patchmatchnet(scene: Path) -> dict[str, float]:
    """Five neighbouring views, 640 pixels wide."""
    every = [image.name for image in sorted((scene / "images").iterdir())]
    case = make_case(scene, every[3:8], every, longer_side=640)
    _, measured = run(case, StereoConfig(), method=METHODS["patchmatchnet"]())
    return {"median_relative_error": measured["median_relative_error"], "seconds": measured["seconds"]["wall"]}


PARTS = {"mast3r": mast3r, "alignment": alignment, "patchmatchnet": patchmatchnet}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, required=True, help="folder with images and true cameras")
    parser.add_argument("--json", type=Path, help="where the figures go")
    parser.add_argument("--part", choices=PARTS, help="only this one, in this process")
    args = parser.parse_args()
    if args.part:
        print(json.dumps(PARTS[args.part](args.scene)))
        return
    figures = {}
    for part in PARTS:
        command = [sys.executable, "-m", "tests.bench", "priors", "--scene", str(args.scene), "--part", part]
        answer = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ).stdout
        figures[part] = json.loads(answer.splitlines()[-1])
        missed = [name for name, bar in BARS[part].items() if figures[part][name] > bar]
        print(f"{part}: {figures[part]}; {'misses ' + ', '.join(missed) if missed else 'within its bars'}")
    if args.json:
        args.json.write_text(json.dumps({"bars": BARS, "figures": figures}, indent=1) + "\n")
