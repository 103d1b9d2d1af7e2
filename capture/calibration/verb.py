"""`splatnode calibrate` on the command line: its arguments, and what runs it."""

from __future__ import annotations

import argparse
from pathlib import Path

from splatnode.capture.process.arguments import Verb, import_lazily, millimetres, positive, seconds

_MODELS = ("auto", "pinhole", "opencv2", "opencv4", "fisheye", "opencv5", "opencv8")


def _arguments(parser: argparse.ArgumentParser) -> None:
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


CALIBRATE = Verb(
    "calibrate",
    "find a camera's lens from a printed board",
    _arguments,
    import_lazily("splatnode.capture.calibration.collect", "calibrate"),
)
