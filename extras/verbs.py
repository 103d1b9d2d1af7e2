"""The verbs and viewers of extras on the command line: their arguments, and what runs them."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from splatnode.capture.process.arguments import (
    Verb,
    add_json,
    counts,
    import_lazily,
    megabytes,
    millimetres,
    names,
    natural,
    positive,
    seconds,
)
from splatnode.capture.process.terminal import say
from splatnode.capture.process.text import metres_argument
from splatnode.recon.verbs import add_device, add_lens, add_reconstruction_options, add_selection_options
from splatnode.viewer.verbs import FurtherViewer

if TYPE_CHECKING:
    from splatnode.viewer.sources import Source


def add_ray(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--ray",
        nargs="?",
        const="",
        metavar="ADDRESS",
        help="on the Ray cluster at this address, such as 10.0.0.1:6379 or auto; without one, on a Ray of this machine",
    )


def add_max_memory(parser: argparse.ArgumentParser, what: str) -> None:
    """`what` is that which takes the memory: "a recording"."""
    parser.add_argument("--max-memory", type=megabytes, metavar="MB", help=f"end {what} that takes more, in 10^6 bytes")


def _audit_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("result", type=Path, metavar="RESULT", help="the folder that replay wrote, with landmarks.npz")
    parser.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="RECORDING",
        help="in the order of time: a folder of photographs (one a camera, of the camera's name, or a folder a "
        "camera), an MCAP file, a LeRobot data set (each episode), a video, a folder that holds such, or a text file "
        "that names them, one a line",
    )
    add_lens(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found into this file, too")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw it into this file (SVG)")


AUDIT = Verb(
    "audit",
    "tell which camera of a station moved, when and by how much",
    _audit_arguments,
    import_lazily("splatnode.extras.audit_command", "audit"),
)


def replay_options(args: argparse.Namespace) -> list[str]:
    """The options of `args` that say how each recording is reconstructed, as the command line of a replay has them."""
    parser = argparse.ArgumentParser()
    options = []
    for action in _options_of_replay(parser):
        given = getattr(args, action.dest)
        if given == action.default:
            continue
        options += action.option_strings if action.nargs == 0 else [action.option_strings[0], str(given)]
    return options


def _options_of_replay(parser: argparse.ArgumentParser) -> tuple[argparse.Action, ...]:
    return *add_reconstruction_options(parser), *add_selection_options(parser.add_mutually_exclusive_group())


def _batch_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "sources",
        type=Path,
        nargs="+",
        metavar="SOURCE",
        help="a folder of photographs, a video, an MCAP file, or a LeRobot data set, or a folder that holds such, or a "
        "text file that names them, one a line",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder for all results")
    parser.add_argument(
        "--resume", action="store_true", help="go on with what is in --out: recordings that came to an end stay"
    )
    parser.add_argument("--retry", action="store_true", help="and run those again that failed")
    parser.add_argument(
        "--cores", type=positive, metavar="N", help="recordings at a time, each on one core (default: all cores)"
    )
    add_max_memory(parser, "a recording")
    parser.add_argument("--timeout-s", type=seconds, metavar="S", help="end a recording that takes longer")
    add_ray(parser)
    parser.add_argument(
        "--results",
        metavar="WHERE",
        help="where the workers of a cluster write: a folder that they share, or an object store (s3://bucket/run); "
        "the tables stay in --out (default: --out)",
    )
    parser.add_argument(
        "--write-back",
        action="store_true",
        help="at the end, write the cameras beside the LeRobot data sets and MCAP files that they are of",
    )
    parser.add_argument(
        "--in-place",
        action="store_true",
        help="into them: columns of a LeRobot data set's own tables in meta/episodes, topics of an MCAP file",
    )
    add_json(parser)
    _options_of_replay(parser)


BATCH = Verb(
    "batch",
    "reconstruct many folders of photographs, videos, logs and data sets",
    _batch_arguments,
    import_lazily("splatnode.extras.batch.command", "batch"),
)


_MODELS = ("auto", "pinhole", "opencv2", "opencv4", "fisheye", "opencv5", "opencv8")


def _calibrate_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "source",
        type=Path,
        nargs="?",
        metavar="SOURCE",
        help="YAML that names the camera, or a folder of photographs, a recording, a video, an MCAP file or an "
        "episode of a LeRobot data set, which show the board",
    )
    add("--out", type=Path, metavar="FILE", help="where the lens goes: YAML, for --intrinsics of other verbs")
    add("--board", type=Path, metavar="FILE", help="write the board to print, a PDF, and do nothing else")
    add("--paper", choices=("a4", "letter"), default="a4", help="of the board to print (default: a4)")
    add("--columns", type=positive, default=10, metavar="N", help="squares of the board across (default: 10)")
    add("--rows", type=positive, default=7, metavar="N", help="squares of the board down (default: 7)")
    add("--square-mm", type=millimetres, default=26.0, metavar="MM", help="side of a square, as measured (default: 26)")
    add("--marker-mm", type=millimetres, metavar="MM", help="side of a marker (default: 19/26 of the square)")
    add("--dictionary", default="5X5_100", metavar="D", help="of the markers, by OpenCV's name (default: 5X5_100)")
    add("--model", choices=_MODELS, default="auto", help="of the lens (default: what predicts held-out views best)")
    add("--seconds", type=seconds, metavar="S", help="of a camera: use what was seen after so many seconds")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="a change to the camera's configuration")


def _marker_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("file", type=Path, metavar="FILE", help="the PDF that is written, such as markers.pdf")
    add("--side", type=metres_argument, default=0.1, metavar="LENGTH", help="of the black square (default: 100mm)")
    add("--count", type=positive, metavar="N", help="how many different ones (default: as many as a page holds)")
    add("--first", type=natural, default=0, metavar="NUMBER", help="of the first one (default: 0)")
    add("--paper", choices=("a4", "letter"), default="a4", help="default: a4")
    add(
        "--dictionary",
        default="4X4_50",
        metavar="NAME",
        help="of OpenCV's ArUco dictionaries (default: 4X4_50), or APRILTAG_36h11",
    )


CALIBRATE = Verb(
    "calibrate",
    "find a camera's lens from a printed board",
    _calibrate_arguments,
    import_lazily("splatnode.extras.calibration.collect", "calibrate"),
)

MARKER = Verb(
    "marker",
    "write markers of known size as a PDF to print: in a scene, they give it metres",
    _marker_arguments,
    import_lazily("splatnode.extras.calibration.board", "command"),
)


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
        help="seek a held-out view's pose from between its neighbours, not from the true one: 500 steps, three sizes",
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
    import_lazily("splatnode.extras.evaluate.runner", "demo"),
)

BENCH = Verb(
    "bench",
    "measure held-out quality, poses and seconds",
    _bench_arguments,
    import_lazily("splatnode.extras.evaluate.runner", "bench"),
)

STABILITY = Verb(
    "robustness",
    "measure how often the answer is wrong",
    _stability_arguments,
    import_lazily("splatnode.extras.evaluate.stability.campaign", "stability"),
)


# `splatnode view --rerun` and `--viser`: their flags, and what runs them.


def _add_rerun_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rerun-url", metavar="URL", help="of --rerun, where the viewer is elsewhere")


def _check_rerun_arguments(args: argparse.Namespace) -> None:
    if args.rerun_url is not None and not args.rerun:
        raise ValueError("--rerun-url needs --rerun")


def _show_rerun(source: Source, args: argparse.Namespace) -> None:
    rerun_stream = import_module("splatnode.extras.viewers.rerun_stream")
    rerun_stream.stream(source, args.rerun_url or rerun_stream.URL)


RERUN = FurtherViewer(
    "rerun",
    "show it in the rerun viewer that runs on this machine, or that ssh -R leads to; of a node each update, until "
    "Ctrl-C",
    "shows it in the rerun viewer",
    _show_rerun,
    _add_rerun_arguments,
    _check_rerun_arguments,
)


def _show_viser(source: Source, args: argparse.Namespace) -> None:
    viser = import_module("splatnode.extras.viewers.viser")  # an extra
    viser.show(source, args.listen, viser.PORT if args.port is None else args.port, say)


VISER = FurtherViewer(
    "viser",
    "show it in a browser by viser, with the means of that (needs the extra viser); --web lets in fewer",
    "shows it in a browser",
    _show_viser,
    is_server=True,
)
