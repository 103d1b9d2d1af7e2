"""The verbs of the command line that reconstruct, convert and measure: their arguments, and what runs them.

A flag of the reconstruction that is not given is None, so that the configuration file, then the preset, decides.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from pkgutil import iter_modules

from splatnode.capture.process.arguments import (
    add_json,
    angle,
    box,
    counts,
    megabytes,
    names,
    natural,
    percent,
    positive,
    seconds,
)
from splatnode.capture.process.verb import Verb, lazily

_FORMATS_FOLDER = Path(__file__).parent / "result" / "export" / "formats"
EXPORT_FORMATS = tuple(
    sorted(module.name for module in iter_modules([str(_FORMATS_FOLDER)]))
)  # no import: it takes time


def _demo_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="default: out/demo")
    parser.add_argument("--seed", type=natural, metavar="N", help="of what is drawn by chance (default: 0)")
    _add_device(parser)
    add_json(parser)


def _add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--device",
        choices=("cpu", "cuda", "auto"),
        help="that Gaussians are refined on (default: cpu; auto: a GPU where one can be used)",
    )


def _replay_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source",
        type=Path,
        nargs="+",
        metavar="SOURCE",
        help="a folder with photographs of one place, in any order, or some photographs of a folder, or a video, or "
        "what `splatnode record` wrote; of a video, and of more than 30 photographs, keyframes are chosen as a live "
        "camera's are",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the scene and its report go")
    parser.add_argument("--config", type=Path, metavar="FILE", help="YAML with what differs from the defaults")
    parser.add_argument("--preset", metavar="P", help="a named set of parameters (default: balanced)")
    parser.add_argument("--prior", metavar="K", help="what gives poses and first points (default: classical)")
    _add_device(parser)
    parser.add_argument("--size", type=positive, metavar="PIXELS", help="longer side as modelled (default: 512)")
    parser.add_argument(
        "--budget-s",
        type=seconds,
        metavar="S",
        help="the best scene within this many seconds from the first photograph on; starting the program, reading "
        "photographs and writing files come on top, and cameras and first points take what they take",
    )
    parser.add_argument(
        "--quick", action="store_true", help="refuse at once: try nothing that takes longer before the answer is no"
    )
    parser.add_argument(
        "--require",
        type=percent,
        metavar="PERCENT",
        help="refuse what is rougher: positions must be known to so much of the distance to the scene (95 %% bound)",
    )
    parser.add_argument("--max-gaussians", type=positive, metavar="N", help="and with at most so many Gaussians")
    parser.add_argument("--max-mb", type=megabytes, metavar="MB", help="and of this size of scene.ply, in 10^6 bytes")
    parser.add_argument(
        "--baseline", nargs=3, metavar=("A", "B", "METRES"), help="how far apart photographs A and B were taken"
    )
    parser.add_argument("--seed", type=natural, metavar="N", help="of what is drawn by chance (default: 0)")
    add_only_seen(parser)
    _add_masks(parser)
    parser.add_argument("--view", action="store_true", help="watch it in a window (the run does not wait for it)")
    chosen = parser.add_mutually_exclusive_group()
    chosen.add_argument(
        "--views", type=positive, metavar="N", help="use N photographs (of a video: keyframes), evenly spread"
    )
    chosen.add_argument("--frames", type=names, metavar="A,B,C", help="use these photographs, by name")
    chosen.add_argument(
        "--every-frame",
        action="store_true",
        help="use all photographs, or frames of a video, that are sharp and no copies",
    )
    parser.add_argument(
        "--map",
        action="store_true",
        help="of a long recording: use all keyframes, however many; they become linked scenes, and one merged map",
    )
    add_json(parser)


def _add_masks(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--masks",
        type=Path,
        metavar="FOLDER",
        help="masks, of the names of their photographs: white (any value above 0) is used, black is ignored; or one "
        "file, for all photographs",
    )


def add_only_seen(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--only-seen",
        action="store_true",
        help="leave out what no two photographs confirm, and the far background: holes in place of guesses",
    )


def _recon_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("config", type=Path, nargs="?", metavar="CONFIG", help="YAML: what differs from the defaults")
    parser.add_argument("--checkpoint", type=Path, metavar="DIR", help="what a killed daemon goes on from")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where finished scenes go (default: out)")


def _retract_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="of the keyframe, as the viewer and the report show it")
    parser.add_argument("--config", type=Path, metavar="CONFIG", help="of the daemon; default: the one on this machine")


def _export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", type=Path, metavar="SCENE", help="a result's folder, or a .ply, .spz or .splat file")
    parser.add_argument("--to", required=True, choices=EXPORT_FORMATS, help="the format")
    parser.add_argument("--out", type=Path, metavar="PATH", help="default: beside the scene")
    add_only_seen(parser)
    parser.add_argument(
        "--crop",
        type=box,
        metavar="X0,Y0,Z0,X1,Y1,Z1",
        help="keep the Gaussians in this box; in the frame and the unit of the scene",
    )
    parser._negative_number_matcher = re.compile(r"-[\d.]")  # else a box that begins with a minus is no value


def _locate_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("result", type=Path, metavar="RESULT", help="the folder that replay wrote, with landmarks.npz")
    parser.add_argument(
        "images", type=Path, nargs="+", metavar="IMAGE", help="photographs, or folders of them, by any camera"
    )
    lens = parser.add_mutually_exclusive_group()
    lens.add_argument("--calibration", type=Path, metavar="FILE", help="YAML with their lens: width, height, fx, ...")
    lens.add_argument("--fov", type=angle, metavar="DEGREES", help="their angle of view, across the longer side")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found into this file, too")


def _merge_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="OUT_FOLDER", help="that a node writes its scenes into")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where the merged scenes go (default: OUT_FOLDER)")
    parser.add_argument("--max-gaussians", type=positive, metavar="N", help="at most so many Gaussians in each")
    parser.add_argument("--max-mb", type=megabytes, metavar="MB", help="and of this size of scene.ply, in 10^6 bytes")
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
        help="by name, or the sets presets, rivals, ablation (default: balanced)",
    )
    parser.add_argument("--checkpoints", type=counts, default=(), metavar="N,N", help="iterations scored on the way")
    parser.add_argument(
        "--interpolated-start",
        action="store_true",
        help="seek a held-out view's pose from between its neighbours, not from the true one: 300 steps, three sizes",
    )
    parser.add_argument(
        "--by-region", action="store_true", help="score also what two training photographs show, one, or none"
    )
    parser.add_argument("--seeds", type=positive, default=1, metavar="N", help="runs of each, with seeds 0 to N-1")
    _add_device(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--resume", action="store_true", help="go on: runs that --out holds are not run again")
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
        "--given-lens", action="store_true", help="windows of a calibrated camera: splatnode is told the true lens"
    )
    parser.add_argument("--jobs", type=positive, default=1, metavar="N", help="trials at a time (default: 1)")
    parser.add_argument("--timeout-s", type=seconds, default=120.0, metavar="S", help="of one trial (default: 120)")
    parser.add_argument(
        "--windows", action="store_true", help="instead of the matrix: windows of 3, 6 and 12 consecutive photographs"
    )
    parser.add_argument(
        "--per-kind", type=positive, default=2, metavar="N", help="windows of a scene, count and stride (default: 2)"
    )
    parser.add_argument(
        "--fresh",
        action="store_true",
        help="time each window from its photographs on, too, with nothing kept of others",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="trials that it holds are not run again")


def _weights_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", choices=("list", "fetch", "verify"))
    parser.add_argument("names", nargs="*", metavar="NAME", help="which (list and verify: all, if none is named)")
    parser.add_argument(
        "--from", dest="source", type=Path, metavar="FOLDER", help="take them from a folder: no network"
    )
    add_json(parser)


VERBS = (
    Verb("demo", "reconstruct the built-in capture", _demo_arguments, lazily("splatnode.recon.cli", "demo")),
    Verb(
        "replay",
        "reconstruct a folder of photographs, or a video",
        _replay_arguments,
        lazily("splatnode.recon.cli", "replay"),
    ),
    Verb(
        "export",
        "write a scene in another format",
        _export_arguments,
        lazily("splatnode.recon.result.export.command", "export"),
    ),
    Verb(
        "locate",
        "tell where further photographs of a scene were taken",
        _locate_arguments,
        lazily("splatnode.recon.locating.command", "locate"),
    ),
    Verb(
        "merge",
        "make one scene of the scenes of a long walk",
        _merge_arguments,
        lazily("splatnode.recon.merging.command", "merge"),
    ),
    Verb(
        "recon", "reconstruct what comes, for ever", _recon_arguments, lazily("splatnode.recon.daemon.daemon", "recon")
    ),
    Verb("retract", "take a keyframe back", _retract_arguments, lazily("splatnode.recon.daemon.control", "retract")),
    Verb(
        "bench", "measure held-out quality, poses and seconds", _bench_arguments, lazily("splatnode.recon.cli", "bench")
    ),
    Verb(
        "stability",
        "measure how often the answer is wrong",
        _stability_arguments,
        lazily("splatnode.recon.evaluate.stability.command", "stability"),
    ),
    Verb(
        "weights",
        "get and check the weights of optional networks",
        _weights_arguments,
        lazily("splatnode.recon.networks.weights_command", "command"),
    ),
    Verb("doctor", "tell what is installed and what is missing", add_json, lazily("splatnode.recon.doctor", "doctor")),
)
