"""`splatnode audit` on the command line: its arguments, and what runs it."""

from __future__ import annotations

import argparse
from pathlib import Path

from splatnode.capture.process.arguments import Verb, import_lazily
from splatnode.recon.shared_arguments import add_lens


def _arguments(parser: argparse.ArgumentParser) -> None:
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
    _arguments,
    import_lazily("splatnode.extras.auditing.command", "audit"),
)
