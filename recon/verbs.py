"""The verbs of the command line that reconstruct, convert and measure: their arguments, and what runs them.

A flag of the reconstruction that is not given is None, so that the configuration file, then the preset, decides.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from pkgutil import iter_modules

from splatnode.capture.process import plugins
from splatnode.capture.process.arguments import (
    Verb,
    add_json,
    box,
    import_lazily,
    length,
    megabytes,
    positive,
)
from splatnode.recon.metric.arguments import add_frame, add_marker
from splatnode.recon.replay_verb import REPLAY, add_lens, add_multi_view_only

_FORMATS_FOLDER = Path(__file__).parent / "result" / "export" / "formats"


def list_export_formats() -> tuple[str, ...]:
    """The names of all formats, without an import, which would take time."""
    own = (module.name for module in iter_modules([str(_FORMATS_FOLDER)]))
    return tuple(sorted({*own, *plugins.entry_points(plugins.EXPORT_FORMATS)}))


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
        import_lazily("splatnode.recon.networks.weights", "command"),
    ),
    Verb(
        "doctor",
        "tell what is installed and what is missing, or how fast this machine is",
        _doctor_arguments,
        import_lazily("splatnode.recon.doctor", "doctor"),
    ),
)
