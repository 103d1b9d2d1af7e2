"""The verbs of the command line that concern cameras and messages: their arguments, and what runs them."""

from __future__ import annotations

import argparse
from pathlib import Path

from splatnode.capture.process.arguments import Verb, add_json, import_lazily, seconds


def _camera_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "config", type=Path, metavar="CONFIG", help="YAML that names the camera (examples: splatnode config)"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="a change to it, such as camera.loops=2"
    )
    parser.add_argument(
        "--intrinsics",
        type=Path,
        metavar="FILE",
        help="the camera's lens, as calibrate writes it; COLMAP's cameras.txt or Kalibr's camchain, too",
    )


def _capture_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--camera-id", metavar="ID", help="of this capture, where several run beside one recon (camera_id)"
    )
    _camera_arguments(parser)


def _config_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--write", type=Path, metavar="DIR", help="write them into this folder, which must be new or empty"
    )


def _record_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="a new folder for the recording")
    parser.add_argument("--seconds", type=seconds, metavar="S", help="stop after so many seconds")
    _camera_arguments(parser)


def _keys_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where this machine's keys are, or will be made")
    change = parser.add_mutually_exclusive_group()
    change.add_argument("--allow", nargs=2, metavar=("NAME", "KEY"), help="let the machine with this public key in")
    change.add_argument("--server", metavar="KEY", help="connect to the machine with this public key")


def _status_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, metavar="FILE", help="where it says how to reach the processes: network")
    parser.add_argument("--acknowledge", action="store_true", help="the problems that are told need not be told again")
    add_json(parser)


VERBS = (
    Verb("capture", "run the camera's process", _capture_arguments, import_lazily("splatnode.capture.cli", "capture")),
    Verb(
        "record",
        "write what a camera sees into a folder",
        _record_arguments,
        import_lazily("splatnode.capture.cli", "record"),
    ),
    Verb(
        "config",
        "list the example configurations, or write them into a folder",
        _config_arguments,
        import_lazily("splatnode.capture.cli", "config"),
    ),
    Verb(
        "list-cameras", "list the cameras that are connected", add_json, import_lazily("splatnode.capture.cli", "find")
    ),
    Verb(
        "keygen",
        "make this machine's keys; say who may connect",
        _keys_arguments,
        import_lazily("splatnode.capture.cli", "keys"),
    ),
    Verb(
        "status",
        "tell how the running processes are",
        _status_arguments,
        import_lazily("splatnode.capture.cli", "status"),
    ),
)
