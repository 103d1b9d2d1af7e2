"""The verbs of the command line that reconstruct, convert and measure: their arguments, and what runs them.

A flag of the reconstruction that is not given is None, so that the configuration file, then the preset, decides.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from splatnode.capture.process import plugins
from splatnode.capture.process.arguments import (
    Verb,
    add_json,
    angle,
    box,
    import_lazily,
    length,
    megabytes,
    names,
    natural,
    percent,
    positive,
    seconds,
)
from splatnode.recon.metric.arguments import add_baseline, add_frame, add_marker, add_poses, add_stereo

# `splatnode replay` on the command line: its arguments, which other verbs of reconstruction share, and what runs it.
#
# A flag that is not given is None, so that the configuration file, then the preset, decides.


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


# The verbs of the command line that reconstruct, convert and measure: their arguments, and what runs them.

_FORMATS_FOLDER = Path(__file__).parent / "result" / "export" / "formats"


def list_export_formats() -> tuple[str, ...]:
    """The names of all formats, without an import, which would take time."""
    return plugins.list_names(_FORMATS_FOLDER, plugins.EXPORT_FORMATS)


def _recon_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("config", type=Path, nargs="?", metavar="CONFIG", help="YAML: what differs from the defaults")
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="DIR",
        help="where it keeps what it goes on from when it is started again; another folder begins with nothing",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="where finished scenes go (default: out)")
    parser.add_argument(
        "--finish",
        action="store_true",
        help="finalize all scenes, merge those of each map, and end; a node that runs already does it, and this waits",
    )
    add_marker(parser)
    add_frame(parser)


def _remove_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="of the keyframe, as the viewer and the report show it")
    parser.add_argument("--config", type=Path, metavar="CONFIG", help="of the daemon; default: the one on this machine")


def _export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", type=Path, metavar="SCENE", help="a result's folder, or a .ply, .spz or .splat file")
    parser.add_argument("--to", required=True, choices=list_export_formats(), help="the format")
    parser.add_argument("--out", type=Path, metavar="PATH", help="default: beside the scene")
    add_multi_view_only(parser)
    parser.add_argument(
        "--no-background",
        action="store_true",
        help="leave out the far background alone: it is all around, and from outside it hides the scene",
    )
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
    add_lens(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found into this file, too")


def _occupancy_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("result", type=Path, metavar="RESULT", help="the folder that replay wrote, with depth.npz")
    parser.add_argument("--out", type=Path, metavar="DIR", help="default: RESULT/occupancy")
    parser.add_argument("--voxel", type=length, metavar="SIZE", help="default: a 64th of the median depth")
    parser.add_argument(
        "--band", type=float, nargs=2, metavar=("LOW", "HIGH"), help="heights of which nav2's map.pgm is made"
    )
    parser.add_argument(
        "--up", type=float, nargs=3, metavar=("X", "Y", "Z"), help="where up is in the result's world, if it is known"
    )
    parser.add_argument(
        "--relative",
        action="store_true",
        help="write nav2's map.pgm of a result without metres, too: nav2 will take its lengths for metres",
    )


def _merge_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="OUT_FOLDER", help="that a node writes its scenes into")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where the merged scenes go (default: OUT_FOLDER)")
    parser.add_argument("--max-gaussians", type=positive, metavar="N", help="at most so many Gaussians in each")
    parser.add_argument("--max-mb", type=megabytes, metavar="MB", help="a scene.ply of at most so many 10^6 bytes")
    add_json(parser)


def _weights_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", choices=("list", "fetch", "verify"))
    parser.add_argument("names", nargs="*", metavar="NAME", help="which (list and verify: all, if none is named)")
    parser.add_argument(
        "--from", dest="source", type=Path, metavar="FOLDER", help="take them from a folder: no network"
    )
    add_json(parser)


def _doctor_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--rates",
        nargs="*",
        type=positive,
        metavar="VIEWS",
        help="measure the seconds of each step of a growing scene with so many views (default: 3 6 12; two minutes)",
    )
    add_json(parser)


VERBS = (
    REPLAY,
    Verb(
        "export",
        "write a scene in another format",
        _export_arguments,
        import_lazily("splatnode.recon.result.export", "export"),
    ),
    Verb(
        "locate",
        "tell where further photographs of a scene were taken",
        _locate_arguments,
        import_lazily("splatnode.recon.locating.localize", "locate"),
    ),
    Verb(
        "occupancy",
        "tell which space of a scene is free, occupied, or not seen",
        _occupancy_arguments,
        import_lazily("splatnode.recon.occupancy.files", "map_result"),
    ),
    Verb(
        "merge",
        "make one scene of the scenes of a long walk",
        _merge_arguments,
        import_lazily("splatnode.recon.merging", "merge"),
    ),
    Verb(
        "recon",
        "run the mapping node: keyframes in, scenes out",
        _recon_arguments,
        import_lazily("splatnode.recon.daemon.node", "recon"),
    ),
    Verb(
        "remove-keyframe",
        "take a keyframe out of the scene of a running node",
        _remove_arguments,
        import_lazily("splatnode.recon.daemon.node", "remove_keyframe"),
    ),
    Verb(
        "weights",
        "get and check the weights of optional networks",
        _weights_arguments,
        import_lazily("splatnode.recon.networks", "command"),
    ),
    Verb(
        "doctor",
        "tell what is installed and what is missing, or how fast this machine is",
        _doctor_arguments,
        import_lazily("splatnode.recon.doctor", "doctor"),
    ),
)
