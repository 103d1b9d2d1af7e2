"""The options of the command line that give a scene metres, and what they are in a configuration."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path
from typing import Any

from splatnode.capture.process.text import measurement_argument, parse_measurement, sanitize_text

# As `FrameChoice` in recon/result/verdict.py has them, which help does not wait for
FRAMES = ("first_camera", "base", "odometry", "upright", "base_link", "odom")
_SHORTEST, _LONGEST = 1e-6, 1e6  # of a direction, whose length does not count
DRIFT_DEG = 0.5  # of odometry's direction after a metre, where nobody tells it


def add_marker(parser: argparse.ArgumentParser) -> argparse.Action:
    """Adds the option --marker, which applies to many recordings alike."""
    return parser.add_argument(
        "--marker",
        type=measurement_argument,
        metavar="LENGTH[@SIGMA]",
        help="look for printed markers (splatnode marker) whose black square has this side, as 100mm, and take the "
        "metres from them; @0.2mm: you measured it to that (standard deviation; default: 0.5mm)",
    )


def add_frame(parser: argparse.ArgumentParser) -> tuple[argparse.Action, ...]:
    """Adds the options --frame and --gravity, which apply to many recordings alike."""
    parser._negative_number_matcher = re.compile(r"-[\d.]")  # else a direction that begins with a minus is no value
    return (
        parser.add_argument(
            "--frame",
            choices=FRAMES,
            metavar="FRAME",
            help="the frame of reference of results: first_camera, base (the robot's at the first image; needs "
            "T_base_camera and metres), odometry (that of given poses) or upright (z up); base_link and odom mean the "
            "same (default: that of given poses, else first_camera)",
        ),
        parser.add_argument(
            "--gravity",
            type=_direction_argument,
            metavar="X,Y,Z",
            help="down in the camera of the first photograph, for --frame upright: x right, y down, z forward, as "
            "0,1,0 of a level camera",
        ),
    )


def _direction_argument(text: str) -> str:
    """The text itself, where it is a direction: a batch passes it on."""
    try:
        _parse_direction(text)
        return text
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"must be three numbers with commas, a direction, as 0,1,0; got {sanitize_text(text, 100)!r}"
        ) from error


def _parse_direction(text: str) -> tuple[float, float, float]:
    """Raises ValueError."""
    x, y, z = (float(part) for part in text.split(","))
    if not _SHORTEST <= math.hypot(x, y, z) <= _LONGEST:
        raise ValueError("it has no length")
    return x, y, z


def collect_frame_changes(args: argparse.Namespace) -> dict[str, Any]:
    """Collects the changes that --frame and --gravity set."""
    changes = {"frame": args.frame, "gravity": None if args.gravity is None else _parse_direction(args.gravity)}
    return {key: value for key, value in changes.items() if value is not None}


def add_baseline(parser: argparse.ArgumentParser) -> argparse.Action:
    return parser.add_argument(
        "--baseline",
        nargs=3,
        action="append",
        metavar=("A", "B", "METRES"),
        help="how far apart photographs A and B were taken; given again, the distances check one another",
    )


def add_poses(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="FILE",
        help="poses of the photographs in metres, from odometry or a tracker: a TUM trajectory, nerfstudio's "
        "transforms.json, or the folder of a COLMAP model; they give metres and the world's axes, and each that does "
        "not fit the photographs is named",
    )
    parser.add_argument(
        "--poses-sigma",
        type=_parse_two_sigmas,
        metavar="METRES,DEGREES",
        help="how unsure each pose is: the standard deviation of its position and of its orientation, absolute in the "
        "poses' world; a file may tell it for single poses (two more columns of TUM, or sigma_m and sigma_deg in "
        "transforms.json). With a lens that is told (--intrinsics) the poses then hold the cameras, also where "
        "photographs share no matches; poses that the photographs contradict are named and let go",
    )
    parser.add_argument(
        "--poses-drift",
        type=_parse_drift,
        metavar="PERCENT[,DEGREES]",
        help="with sigmas: the poses are odometry's and drift from the first photograph on, a step by PERCENT of its "
        "length (standard deviation in each direction, and of all lengths alike), its direction by DEGREES a metre, "
        "growing with the root of the way (default: 0.5), as 2%%,0.5",
    )
    parser.add_argument(
        "--check-poses",
        action="store_true",
        help="only compare the poses with the cameras that the photographs alone tell, and take metres and axes from "
        "them, as without --poses-sigma",
    )


def add_stereo(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--stereo",
        type=Path,
        metavar="FOLDER",
        help="the photographs of a second camera, to the right of the first, named as their partners; rectified pairs",
    )
    parser.add_argument(
        "--stereo-baseline",
        type=measurement_argument,
        metavar="LENGTH[@SIGMA]",
        help="how far apart the two cameras of the pairs are, as 75mm; @0.1mm: you know it to that (standard "
        "deviation; default: 0.3mm)",
    )


def _parse_two_sigmas(text: str) -> tuple[float, float]:
    try:
        metres, degrees = map(float, text.split(","))
    except ValueError:
        metres = degrees = 0.0
    if not (0.0 < metres <= 1e6 and 0.0 < degrees <= 180.0):
        raise argparse.ArgumentTypeError(
            f"must be metres and degrees above 0 with a comma between them, as 0.01,2; got {sanitize_text(text, 100)!r}"
        )
    return metres, degrees


def _parse_drift(text: str) -> tuple[float, float]:
    percent, _, degrees = text.partition(",")
    try:
        share, turn = float(percent.strip().removesuffix("%")) / 100.0, float(degrees) if degrees else DRIFT_DEG
    except ValueError:
        share = turn = -1.0
    if not (0.0 < share <= 0.5 and 0.0 <= turn <= 90.0):
        raise argparse.ArgumentTypeError(
            f"must be a share above 0 %, up to 50 %, and degrees if you know them, as 2%,0.5; got "
            f"{sanitize_text(text, 100)!r}"
        )
    return share, turn


def collect_drift_changes(args: argparse.Namespace) -> dict[str, float]:
    """Collects the changes of the configuration's `registration` that --poses-drift sets. Raises ValueError."""
    if args.poses_drift is None:
        return {}
    if args.poses is None:
        raise ValueError("--poses-drift is of --poses FILE, which is not given: which poses drift?")
    return dict(zip(("poses_drift", "poses_drift_deg"), args.poses_drift, strict=True))


def trusts_poses(args: argparse.Namespace, has_file_sigmas: bool = False) -> bool:
    """Whether the given poses hold the cameras: who says how unsure they are trusts them so far.

    `has_file_sigmas`: their file says it of some.
    """
    return (has_file_sigmas or args.poses_sigma is not None) and not args.check_poses


def collect_metric_changes(args: argparse.Namespace) -> dict[str, Any]:
    """Collects the changes of the configuration's `metric` that these arguments set. Raises ValueError."""
    changes: dict[str, Any] = {}
    if args.baseline is not None:
        first, *further = ([*names, _parse_metres(metres)] for *names, metres in args.baseline)
        changes |= {"baseline": first, "further_baselines": further}
    changes |= collect_marker_changes(args) | collect_frame_changes(args)
    if (args.stereo is None) != (args.stereo_baseline is None):
        raise ValueError("--stereo and --stereo-baseline belong together: the right photographs, and how far apart")
    if args.stereo_baseline is not None:
        changes |= _parse_length("stereo_baseline", args.stereo_baseline)
    if args.poses_sigma is not None and args.poses is None:
        raise ValueError("--poses-sigma is of --poses FILE, which is not given: how unsure are which poses?")
    if args.check_poses and args.poses is None:
        raise ValueError("--check-poses is of --poses FILE, which is not given: which poses are to be checked?")
    if args.poses_sigma is not None:
        changes["poses_sigma_m"], changes["poses_sigma_deg"] = args.poses_sigma
    return changes


def collect_marker_changes(args: argparse.Namespace) -> dict[str, float]:
    """Collects the changes that --marker alone sets. Raises ValueError."""
    return {} if args.marker is None else _parse_length("marker_size", args.marker)


def _parse_length(what: str, text: str) -> dict[str, float]:
    length_m, sigma_m = parse_measurement(text)
    return {f"{what}_m": length_m} | ({} if sigma_m is None else {f"{what}_sigma_m": sigma_m})


def _parse_metres(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise ValueError(f"--baseline must end with a distance in metres, got {text!r}") from error
