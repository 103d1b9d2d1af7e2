"""Arguments that several verbs of reconstruction take."""

from __future__ import annotations

import argparse
from pathlib import Path

from splatnode.capture.process.arguments import angle


def add_device(parser: argparse.ArgumentParser) -> argparse.Action:
    return parser.add_argument(
        "--device",
        choices=("cpu", "cuda", "auto"),
        help="where Gaussians are refined (default: cpu; auto: a GPU where one can be used)",
    )


def add_multi_view_only(parser: argparse.ArgumentParser) -> argparse.Action:
    return parser.add_argument(
        "--multi-view-only",
        action="store_true",
        help="leave out what no two photographs confirm, and the far background: holes in place of guesses",
    )


def add_lens(parser: argparse.ArgumentParser) -> None:
    """Adds the lens of the images that are looked at, as a file or as an angle."""
    lens = parser.add_mutually_exclusive_group()
    lens.add_argument(
        "--intrinsics",
        type=Path,
        metavar="FILE",
        help="their lens: YAML with width, height, fx, ..., COLMAP's cameras.txt, or Kalibr's camchain",
    )
    lens.add_argument("--fov", type=angle, metavar="DEGREES", help="their angle of view, across the longer side")
