"""What .spz loses against scene.ply: `python -m tests.bench spz RESULT ... --out spz.json`.

Each RESULT is the folder of a finished `splatnode replay`. Its scene is written as .spz, read back, and rendered from
every camera of the result; the PSNR is that of these renders to those of scene.ply.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from splatnode.recon.result.export import read_cameras, read_gaussians
from splatnode.recon.result.export.formats.spz import decode, encode_spz
from splatnode.recon.result.report import render_rgb
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays


def renders(gaussians: GaussianArrays, cameras: tuple[CameraEstimate, ...]) -> list[np.ndarray]:
    """(H, W, 3) in [0, 1] from each camera."""
    return [render_rgb(gaussians, c.T_world_camera, c.K, c.width, c.height) for c in cameras]


def row(result: Path) -> dict[str, object]:
    """Sizes, and the PSNR of the mean squared error over all cameras."""
    gaussians, cameras = read_gaussians(result / "scene.ply"), read_cameras(result / "cameras.json")
    data = encode_spz(gaussians)
    pairs = zip(renders(gaussians, cameras), renders(decode(data), cameras), strict=True)
    error = float(np.mean([np.mean((before.astype(np.float64) - after) ** 2) for before, after in pairs]))
    return {
        "scene": result.name,
        "cameras": len(cameras),
        "num_gaussians": len(gaussians),
        "ply_bytes": (result / "scene.ply").stat().st_size,
        "spz_bytes": len(data),
        "psnr_to_ply": -10.0 * float(np.log10(error)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path, nargs="+", metavar="RESULT")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    rows = [row(result) for result in args.results]
    for each in rows:
        print(each)
    command = "python -m tests.bench spz " + " ".join(result.name for result in args.results)
    args.out.write_text(json.dumps({"command": command, "rows": rows}, indent=1) + "\n")
