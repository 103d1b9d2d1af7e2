"""The command line: one line a verb in `VERBS`, each of which imports its room only when it runs.

Exit codes: 0 good; 2 usage or configuration; 65 the frames cannot be reconstructed (the verdict says why);
69 camera unavailable; 70 internal; 73, 74 cannot write; 75 try again; 77 not allowed; 130 interrupted.
SIGTERM is a clean stop with 0.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import logging
import math
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

# libgomp's threads spin while they wait. On a robot's busy processor that doubles the time of torch's operations.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

Command = Callable[[argparse.Namespace], int]  # returns the exit code

EXPORT_FILES = {
    "ply": "scene.ply",
    "spz": "scene.spz",
    "splat": "scene.splat",
    "colmap": "colmap",
    "nerfstudio": "transforms.json",
    "tum": "trajectory.tum",
}


@dataclass(frozen=True)
class Verb:
    name: str
    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Command


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the verb that `argv` names and returns the exit code. Raises SystemExit for usage errors and SIGTERM."""
    parser = build_parser()
    args = parser.parse_args(argv)
    if args.verb is None:
        parser.print_help(sys.stderr)
        return 2
    logging.basicConfig(format="%(message)s", stream=sys.stderr)
    for room in ("capture", "recon", "viewer"):
        logging.getLogger(room).setLevel(logging.INFO)
    stopping = threading.Event()

    def stop(_signal: int, _frame: object) -> None:
        stopping.set()
        sys.exit(0)

    signal.signal(signal.SIGTERM, stop)
    try:
        code = args.run(args)
        sys.stdout.flush()
        return code
    except (Exception, KeyboardInterrupt) as error:
        if stopping.is_set():  # a package that was being imported makes an ImportError of the exit
            return 0
        if args.debug:
            traceback.print_exc()
        code = exit_code(error)
        print(f"splatnode: {explain(error, code)}", file=sys.stderr)
        return code


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="splatnode",
        description="Photographs in, camera poses and a 3D Gaussian scene out, on a CPU.",
        allow_abbrev=False,
    )
    parser.set_defaults(verb=None)
    verbs = parser.add_subparsers(metavar="VERB")
    for verb in VERBS:
        subparser = verbs.add_parser(verb.name, help=verb.summary, description=verb.summary, allow_abbrev=False)
        verb.add_arguments(subparser)
        subparser.add_argument("--debug", action="store_true", help="show the traceback of an error")
        subparser.set_defaults(verb=verb.name, run=verb.run)
    return parser


def exit_code(error: BaseException) -> int:
    """What an exception that ended a verb tells the shell. Rooms raise ValueError for what the user can put right.

    An exception of a room that knows better has an `exit_code` of its own.
    """
    if isinstance(error, KeyboardInterrupt):
        return 130
    if (own := getattr(error, "exit_code", None)) is not None:
        return own
    if isinstance(error, OSError):
        return _os_exit_code(error)
    return 2 if isinstance(error, ValueError) else 70


def explain(error: BaseException, code: int) -> str:
    """One line, or the error's own text where that has more."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}: {error.filename}" if error.filename is not None else error.strerror
    if code == 70:
        return f"internal error: {type(error).__name__}: {error} (--debug shows where; splatnode doctor may tell why)"
    return str(error)


def _os_exit_code(error: OSError) -> int:
    if _is_write_error(error):
        no_room = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EPIPE}
        return 74 if error.errno in no_room else 73
    if isinstance(error, (FileNotFoundError, NotADirectoryError, IsADirectoryError)):
        return 2
    return 77 if isinstance(error, PermissionError) else 74


def _is_write_error(error: OSError) -> bool:
    """ResultWriteError can only have been raised by a room that has been imported."""
    staged = sys.modules.get("recon.export.staged")
    return staged is not None and isinstance(error, staged.ResultWriteError)


def _lazily(module: str, function: str) -> Command:
    def run(args: argparse.Namespace) -> int:
        return getattr(importlib.import_module(module), function)(args)

    return run


# A flag of the reconstruction that is not given is None, so that the configuration file, then the preset, decides.


def _demo_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="default: out/demo")
    parser.add_argument("--seed", type=_natural, metavar="N")
    _json_argument(parser)


def _replay_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="photographs of one place, in any order")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the scene and its report go")
    parser.add_argument("--config", type=Path, metavar="FILE", help="YAML with what differs from the defaults")
    parser.add_argument("--preset", metavar="P", help="a named set of parameters (default: balanced)")
    parser.add_argument("--prior", metavar="K", help="what gives poses and first points (default: classical)")
    parser.add_argument("--size", type=_positive, metavar="PIXELS", help="longer side as modelled (default: 512)")
    parser.add_argument("--budget-s", type=_seconds, metavar="S", help="the best scene within this many seconds")
    parser.add_argument("--max-gaussians", type=_positive, metavar="N", help="and with at most so many Gaussians")
    parser.add_argument("--max-mb", type=_megabytes, metavar="MB", help="and of this size of scene.ply, in 10^6 bytes")
    parser.add_argument(
        "--baseline", nargs=3, metavar=("A", "B", "METRES"), help="how far apart photographs A and B were taken"
    )
    parser.add_argument("--seed", type=_natural, metavar="N")
    parser.add_argument("--view", action="store_true", help="watch it in a window (the run does not wait for it)")
    chosen = parser.add_mutually_exclusive_group()
    chosen.add_argument("--views", type=_positive, metavar="N", help="use N frames, evenly spread")
    chosen.add_argument("--frames", type=_names, metavar="A,B,C", help="use these frames, by name")
    _json_argument(parser)


def _export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", type=Path, metavar="SCENE", help="a result's folder, or a .ply, .spz or .splat file")
    parser.add_argument("--to", required=True, choices=EXPORT_FILES, help="the format")
    parser.add_argument("--out", type=Path, metavar="PATH", help="default: beside the scene")


def _bench_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenes", type=Path, nargs="*", metavar="SCENE", help="folders with images and true cameras")
    parser.add_argument(
        "--views", type=_counts, default=(3, 6, 12), metavar="N,N,N", help="training views (default: 3,6,12)"
    )
    parser.add_argument(
        "--methods",
        type=_names,
        default=("balanced",),
        metavar="A,B,C",
        help="by name, or the sets presets, rivals, ablation (default: balanced)",
    )
    parser.add_argument("--checkpoints", type=_counts, default=(), metavar="N,N", help="iterations scored on the way")
    parser.add_argument("--seeds", type=_positive, default=1, metavar="N", help="runs of each, with seeds 0 to N-1")
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
    parser.add_argument("--rows", type=_counts, default=(), metavar="N,N", help="rows of the matrix (default: all)")
    parser.add_argument("--seeds", type=_positive, default=4, metavar="N", help="trials of each row (default: 4)")
    parser.add_argument(
        "--methods", type=_names, default=("splatnode",), metavar="A,B,C", help="splatnode, colmap, glomap"
    )
    parser.add_argument("--jobs", type=_positive, default=1, metavar="N", help="trials at a time (default: 1)")
    parser.add_argument("--timeout-s", type=_seconds, default=120.0, metavar="S", help="of one trial (default: 120)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="trials that it holds are not run again")


def _view_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "what",
        type=Path,
        nargs="?",
        metavar="SCENE|DIR|CONFIG",
        help="a scene file, a result's folder, or a node's configuration (.yaml); default: the node on this machine",
    )
    parser.add_argument("--photographs", type=Path, metavar="DIR", help="where a finished result's photographs are")
    parser.add_argument("--headless", action="store_true", help="write pictures instead of opening a window")
    parser.add_argument("--export", type=Path, metavar="FILE.mp4", help="write a turntable, without a window")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where pictures go (default: view, beside the scene)")
    parser.add_argument("--size", type=_size, metavar="WxH", help="of the window, or of pictures (960x720)")
    parser.add_argument("--pictures", type=_positive, default=100, metavar="N", help="of a turntable (default: 100)")
    parser.add_argument("--until-final", action="store_true", help="without a window: stop when a scene is finished")


def _camera_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("config", type=Path, metavar="CONFIG", help="YAML that names the camera; see configs/")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="a change to it, such as camera.loops=2"
    )


def _record_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="a new folder for the recording")
    parser.add_argument("--seconds", type=_seconds, metavar="S", help="stop after so many seconds")
    _camera_arguments(parser)


def _recon_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("config", type=Path, nargs="?", metavar="CONFIG", help="YAML: what differs from the defaults")
    parser.add_argument("--checkpoint", type=Path, metavar="DIR", help="what a killed daemon goes on from")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where finished scenes go (default: out)")


def _retract_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="of the key frame, as the viewer and the report show it")
    parser.add_argument("--config", type=Path, metavar="CONFIG", help="of the daemon; default: the one on this machine")


def _find_arguments(parser: argparse.ArgumentParser) -> None:
    _json_argument(parser)


def _keys_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where this machine's keys are, or will be made")
    change = parser.add_mutually_exclusive_group()
    change.add_argument("--allow", nargs=2, metavar=("NAME", "KEY"), help="let the machine with this public key in")
    change.add_argument("--server", metavar="KEY", help="connect to the machine with this public key")


def _status_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, metavar="FILE", help="where it says how to reach the processes: network")
    _json_argument(parser)


def _doctor_arguments(parser: argparse.ArgumentParser) -> None:
    _json_argument(parser)


def _weights_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", choices=("list", "fetch", "verify"))
    parser.add_argument("names", nargs="*", metavar="NAME", help="which (list and verify: all, if none is named)")
    parser.add_argument(
        "--from", dest="source", type=Path, metavar="FOLDER", help="take them from a folder: no network"
    )
    _json_argument(parser)


def _json_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object for programs")


def _export(args: argparse.Namespace) -> int:
    from recon.export import export_scene

    beside = args.scene if args.scene.is_dir() else args.scene.parent
    destination = args.out or beside / EXPORT_FILES[args.to]
    if args.out is None and destination.exists():
        raise ValueError(f"{destination} is there already: give another place with --out PATH")
    print(export_scene(args.scene, args.to, destination))
    return 0


def _whole_number(least: int) -> Callable[[str], int]:
    def convert(text: str) -> int:
        if not text.strip().isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"must be a whole number, {least} or more; got {text!r}")
        return int(text)

    return convert


_positive, _natural = _whole_number(1), _whole_number(0)


def _seconds(text: str) -> float:
    return _above_zero(text, "seconds")


def _megabytes(text: str) -> float:
    return _above_zero(text, "megabytes")


def _above_zero(text: str, unit: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number of {unit} above 0; got {text!r}")
    return number


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise argparse.ArgumentTypeError(f"must be values with commas between them; got {text!r}")
    return names


def _size(text: str) -> tuple[int, int]:
    sides = [int(side) for side in text.split("x") if side.isdecimal()]
    if len(sides) != 2 or not 16 <= min(sides) <= max(sides) <= 4096:
        raise argparse.ArgumentTypeError(f"must be WIDTHxHEIGHT, from 16 to 4096 pixels; got {text!r}")
    return sides[0], sides[1]


def _counts(text: str) -> tuple[int, ...]:
    return tuple(_positive(name) for name in _names(text))


VERBS = (
    Verb("demo", "reconstruct the built-in capture", _demo_arguments, _lazily("recon.cli", "demo")),
    Verb("replay", "reconstruct a folder of photographs", _replay_arguments, _lazily("recon.cli", "replay")),
    Verb("view", "show a result, a scene or a running node", _view_arguments, _lazily("viewer.cli", "view")),
    Verb("recon", "reconstruct what comes, for ever", _recon_arguments, _lazily("recon.daemon.daemon", "recon")),
    Verb("retract", "take a key frame back", _retract_arguments, _lazily("recon.daemon.control", "retract")),
    Verb("export", "write a scene in another format", _export_arguments, _export),
    Verb("bench", "measure held-out quality, poses and seconds", _bench_arguments, _lazily("recon.cli", "bench")),
    Verb(
        "stability",
        "measure how often the answer is wrong",
        _stability_arguments,
        _lazily("recon.evaluate.stability.command", "stability"),
    ),
    Verb(
        "weights",
        "get and check the weights of optional networks",
        _weights_arguments,
        _lazily("recon.weights", "command"),
    ),
    Verb("capture", "run the camera's process", _camera_arguments, _lazily("capture.cli", "capture")),
    Verb("record", "write what a camera sees into a folder", _record_arguments, _lazily("capture.cli", "record")),
    Verb("find", "list the cameras that are connected", _find_arguments, _lazily("capture.cli", "find")),
    Verb("keys", "make this machine's keys; say who may connect", _keys_arguments, _lazily("capture.cli", "keys")),
    Verb("status", "tell how the running processes are", _status_arguments, _lazily("capture.cli", "status")),
    Verb("doctor", "tell what is installed and what is missing", _doctor_arguments, _lazily("recon.doctor", "doctor")),
)

if __name__ == "__main__":
    sys.exit(main())
