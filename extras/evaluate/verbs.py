"""The verbs of the command line that measure: their arguments, and what runs them."""

from __future__ import annotations

import argparse
from pathlib import Path

from splatnode.capture.process.arguments import Verb, add_json, counts, import_lazily, names, natural, positive, seconds
from splatnode.extras.jobs.arguments import add_max_memory, add_ray
from splatnode.recon.shared_arguments import add_device


def _demo_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="default: out/demo")
    parser.add_argument("--seed", type=natural, metavar="N", help="of what is drawn by chance (default: 0)")
    add_device(parser)
    add_json(parser)


def _bench_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenes", type=Path, nargs="*", metavar="SCENE", help="folders with images and true cameras")
    parser.add_argument(
        "--views", type=counts, default=(3, 6, 12), metavar="N,N,N", help="training views (default: 3,6,12)"
    )
    parser.add_argument(
        "--methods",
        type=names,
        default=("balanced",),
        metavar="A,B,C",
        help="by name, or the sets presets, rivals, published, ablation (default: balanced)",
    )
    parser.add_argument("--checkpoints", type=counts, default=(), metavar="N,N", help="iterations scored on the way")
    parser.add_argument(
        "--interpolate-start",
        action="store_true",
        help="seek a held-out view's pose from between its neighbours, not from the true one: 300 steps, three sizes",
    )
    parser.add_argument(
        "--color-correct",
        action="store_true",
        help="bring each render to the exposure and white balance of the held-out photograph before it is scored",
    )
    parser.add_argument(
        "--score-regions", action="store_true", help="score also what two training photographs show, one, or none"
    )
    parser.add_argument("--seeds", type=positive, default=1, metavar="N", help="runs of each, with seeds 0 to N-1")
    _add_engine(parser, "runs", "a run", 3600.0)
    add_device(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument(
        "--resume", action="store_true", help="go on: of the runs that --out holds, those that failed are run again"
    )
    parser.add_argument(
        "--redraw", type=Path, nargs="+", metavar="BENCH.json", help="measure nothing: tables and charts of these"
    )
    parser.add_argument("--weights-dir", type=Path, metavar="DIR", help="LPIPS networks (default: $SPLATNODE_WEIGHTS)")


def _stability_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scenes", type=Path, nargs="*", metavar="SCENE", help="folders with images and true cameras (default: built in)"
    )
    parser.add_argument("--rows", type=counts, default=(), metavar="N,N", help="rows of the matrix (default: all)")
    parser.add_argument("--seeds", type=positive, default=4, metavar="N", help="trials of each row (default: 4)")
    parser.add_argument(
        "--methods",
        type=names,
        metavar="A,B,C",
        help="splatnode, colmap, glomap (default: splatnode; with --windows all that are installed)",
    )
    parser.add_argument(
        "--counts", type=counts, default=(3, 6, 12), metavar="N,N,N", help="photographs of a window (default: 3,6,12)"
    )
    parser.add_argument(
        "--known-lens",
        choices=("nothing", "exif", "given"),
        default="nothing",
        help="windows of a known camera: splatnode is told the true lens, or EXIF's focal length within 3 %%",
    )
    _add_engine(parser, "trials", "a trial", 120.0)
    parser.add_argument(
        "--windows", action="store_true", help="instead of the matrix: windows of 3, 6 and 12 consecutive photographs"
    )
    parser.add_argument(
        "--windows-per-kind",
        type=positive,
        default=2,
        metavar="N",
        help="windows of a scene, count and stride (default: 2)",
    )
    parser.add_argument(
        "--no-cache",
        action="store_true",
        help="time each window from its photographs on, too, with nothing kept of others",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="trials that it holds are not run again")


def _add_engine(parser: argparse.ArgumentParser, several: str, one: str, timeout_s: float) -> None:
    """Adds where runs are made, how many at a time, and what ends `one` of `several`."""
    parser.add_argument(
        "--cores",
        type=positive,
        metavar="N",
        help=f"{several} at a time, each on one core (default: one at a time, on all cores)",
    )
    add_ray(parser)
    add_max_memory(parser, one)
    parser.add_argument(
        "--timeout-s",
        type=seconds,
        default=timeout_s,
        metavar="S",
        help=f"end {one} that takes longer (default: {timeout_s:g})",
    )


DEMO = Verb(
    "demo",
    "reconstruct the built-in capture",
    _demo_arguments,
    import_lazily("splatnode.extras.evaluate.command", "demo"),
)

BENCH = Verb(
    "bench",
    "measure held-out quality, poses and seconds",
    _bench_arguments,
    import_lazily("splatnode.extras.evaluate.command", "bench"),
)

STABILITY = Verb(
    "robustness",
    "measure how often the answer is wrong",
    _stability_arguments,
    import_lazily("splatnode.extras.evaluate.stability.campaign", "stability"),
)
