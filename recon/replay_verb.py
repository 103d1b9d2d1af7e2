"""`splatnode replay` on the command line: its arguments, which other verbs of reconstruction share, and what runs it.

A flag that is not given is None, so that the configuration file, then the preset, decides.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from splatnode.capture.process.arguments import (
    Verb,
    add_json,
    angle,
    import_lazily,
    megabytes,
    names,
    natural,
    percent,
    positive,
    seconds,
)
from splatnode.recon.metric.arguments import add_baseline, add_frame, add_marker, add_poses, add_stereo


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


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source",
        type=Path,
        nargs="+",
        metavar="SOURCE",
        help="a folder with photographs of one place, in any order, or some photographs of a folder, or a video, or "
        "seconds of one (film.mp4#t=10,20.5), or an image topic of an MCAP file (drive.mcap#/front/image), or an "
        "episode of a LeRobot data set (pusht#3/CAMERA), or what `splatnode record` wrote; of a film, and of more than "
        "30 photographs, keyframes are chosen as a live camera's are; several folders, or several films, are those of "
        "several cameras",
    )
    parser.add_argument(
        "--cameras",
        type=names,
        metavar="A,B,C",
        help="the cameras of one robot that SOURCE has, or all: the folders in a folder, the image topics of an MCAP "
        "file, the cameras of an episode (pusht#3); of several sources, their names. They get one scene, and each its "
        "own lens",
    )
    parser.add_argument(
        "--frame-set-tolerance",
        type=seconds,
        metavar="S",
        help="seconds between images of several cameras that were taken together (default: 0.02)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the scene and its report go")
    add_reconstruction_options(parser)
    add_baseline(parser)
    add_poses(parser)
    add_stereo(parser)
    _add_masks(parser)
    parser.add_argument(
        "--depths",
        type=Path,
        metavar="FOLDER",
        help="depth images of the names of their photographs: .png or .tif of millimetres, .npy or .exr of metres",
    )
    parser.add_argument(
        "--intrinsics",
        type=Path,
        metavar="FILE",
        help="the lens of all photographs, or one of each image or camera: YAML as a camera's configuration has it, a "
        "model of COLMAP (its folder, or cameras.txt), or Kalibr's camchain",
    )
    parser.add_argument(
        "--rig",
        type=Path,
        metavar="FILE",
        help="where the cameras of one robot stand to each other, in metres: rig.yaml, COLMAP's rig_config.json, or "
        "Kalibr's camchain; without it the frame sets tell. What is estimated is rig.yaml of the result",
    )
    parser.add_argument("--view", action="store_true", help="watch it in a window (the run does not wait for it)")
    chosen = parser.add_mutually_exclusive_group()
    add_selection_options(chosen)
    chosen.add_argument("--frames", type=names, metavar="A,B,C", help="use these photographs, by name")
    parser.add_argument(
        "--map",
        action="store_true",
        help="of a long recording: use all keyframes, however many; they become linked scenes, and one merged map",
    )
    add_json(parser)


def add_reconstruction_options(parser: argparse.ArgumentParser) -> tuple[argparse.Action, ...]:
    """The options that say how any photographs are reconstructed, whatever they show."""
    add = parser.add_argument
    return (
        add("--config", type=Path, metavar="FILE", help="YAML with what differs from the defaults"),
        add("--preset", metavar="P", help="preview, fast, balanced or quality: from quick to good (default: balanced)"),
        add("--prior", metavar="K", help="what matches photographs: docs/architecture.md (default: classical)"),
        add_device(parser),
        add("--size", type=positive, metavar="PIXELS", help="longer side of photographs as modelled (default: 512)"),
        add(
            "--budget-s",
            type=seconds,
            metavar="S",
            help="the best scene within this many seconds from the first photograph on; starting the program, reading "
            "photographs and writing files come on top, and cameras and first points take what they take",
        ),
        add(
            "--no-fallbacks",
            action="store_true",
            help="refuse at once: try nothing that takes longer before the answer is no",
        ),
        add(
            "--max-position-error",
            type=percent,
            metavar="PERCENT",
            help="refuse what is rougher: positions must be known to so much of the distance to the scene (95 %% "
            "bound)",
        ),
        add_marker(parser),
        *add_frame(parser),
        add("--max-gaussians", type=positive, metavar="N", help="the best scene with at most so many Gaussians"),
        add("--max-mb", type=megabytes, metavar="MB", help="the best scene of at most so many 10^6 bytes"),
        add("--seed", type=natural, metavar="N", help="of what is drawn by chance (default: 0)"),
        add_multi_view_only(parser),
    )


def add_selection_options(group: argparse._MutuallyExclusiveGroup) -> tuple[argparse.Action, ...]:
    """The options that say how many of a recording's photographs are used, whatever their names."""
    return (
        group.add_argument(
            "--views", type=positive, metavar="N", help="use N photographs (of a video: keyframes), evenly spread"
        ),
        group.add_argument(
            "--every-frame",
            action="store_true",
            help="use all photographs, or frames of a video, that are sharp and no copies",
        ),
    )


def _add_masks(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--masks",
        type=Path,
        metavar="FOLDER",
        help="masks, of the names of their photographs: white (any value above 0) is used, black is ignored; or one "
        "file, for all photographs",
    )


REPLAY = Verb(
    "replay",
    "reconstruct a folder of photographs, or a video",
    _arguments,
    import_lazily("splatnode.recon.cli", "replay"),
)
