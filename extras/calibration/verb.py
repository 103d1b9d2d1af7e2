"""`splatnode calibrate` and `splatnode marker` on the command line: their arguments, and what runs them."""

from __future__ import annotations

import argparse
from pathlib import Path

from splatnode.capture.process.arguments import Verb, import_lazily, millimetres, natural, positive, seconds
from splatnode.capture.process.text import metres_argument

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
    _arguments,
    import_lazily("splatnode.extras.calibration.collect", "calibrate"),
)

MARKER = Verb(
    "marker",
    "write markers of known size as a PDF to print: in a scene, they give it metres",
    _marker_arguments,
    import_lazily("splatnode.extras.calibration.board", "command"),
)
