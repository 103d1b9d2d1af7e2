"""The verb of the command line that shows things: its arguments, and what runs it.

Viewers that are installed beside this one are each a flag of `splatnode view`, and show what this one would.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from splatnode.capture.process import plugins
from splatnode.capture.process.arguments import Verb, address, import_lazily, port, positive, size

if TYPE_CHECKING:
    from splatnode.viewer.sources import Source


def add_nothing(parser: argparse.ArgumentParser) -> None:
    """Adds no option: the flag says it all."""


def check_nothing(args: argparse.Namespace) -> None:
    """Checks no option: there is none that is of this viewer alone."""


@dataclass(frozen=True)
class FurtherViewer:
    """A viewer that an entry point of `splatnode.viewers` names, in a module that imports nothing that takes time."""

    name: str  # its flag is --NAME
    summary: str  # of the flag
    shows: str  # how it shows the scene, in a sentence that begins with the flag
    show: Callable[[Source, argparse.Namespace], None]  # until nothing more will come; it closes the source
    add_arguments: Callable[[argparse.ArgumentParser], None] = add_nothing  # further options, of this viewer alone
    check: Callable[[argparse.Namespace], None] = check_nothing  # raises ValueError where they do not go together
    is_server: bool = False  # it takes --port and --listen, as --web does


def load_viewers() -> tuple[FurtherViewer, ...]:
    """All that are installed, in the order of their entry points."""
    return tuple(plugins.load_all(plugins.VIEWERS, _try_viewer).values())


def _try_viewer(viewer: FurtherViewer) -> None:
    """Raises what a viewer of another package fails with when it is offered."""
    parser = argparse.ArgumentParser()
    parser.add_argument(f"--{viewer.name}", help=viewer.summary)
    viewer.add_arguments(parser)
    parser.format_help()


def find_chosen(args: argparse.Namespace) -> FurtherViewer | None:
    """The viewer whose flag is given. Raises ValueError where two are."""
    chosen = [viewer for viewer in load_viewers() if getattr(args, viewer.name)]
    if len(chosen) > 1:
        raise ValueError(f"--{chosen[0].name} and --{chosen[1].name} are two viewers; give one of them")
    return chosen[0] if chosen else None


def _view_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "what",
        type=Path,
        nargs="?",
        metavar="SCENE|DIR|CONFIG",
        help="a scene file, a result's folder, the folder of all scenes of a node, or a node's configuration (.yaml); "
        "default: the node on this machine",
    )
    parser.add_argument("--images", type=Path, metavar="DIR", help="where a finished result's photographs are")
    parser.add_argument(
        "--max-gaussians",
        type=positive,
        metavar="N",
        help="of a map of several scenes, loaded at once: the near in full, the far coarsely (default: 1500000)",
    )
    parser.add_argument(
        "--web",
        action="store_true",
        help="show it in a browser: this machine needs neither a display nor Open3D. The address that is printed is "
        "this machine's own; from another one, ssh -L leads to it",
    )
    parser.add_argument(
        "--port", type=port, metavar="N", help="of --web or --viser (default: 8347 or 8080; 0: any that is free)"
    )
    parser.add_argument(
        "--listen",
        type=address,
        metavar="ADDRESS",
        help="with --web: let other machines in at this address of this one (0.0.0.0: at all), with a key, which the "
        "address that is printed has; with --viser: likewise, without a key",
    )
    parser.add_argument(
        "--key",
        type=Path,
        metavar="FILE",
        help="with --web: ask for the key in FILE, made if it is not there; otherwise each start has a new one",
    )
    for viewer in load_viewers():
        parser.add_argument(f"--{viewer.name}", action="store_true", help=viewer.summary)
        viewer.add_arguments(parser)
    parser.add_argument("--headless", action="store_true", help="write pictures instead of opening a window")
    parser.add_argument("--export", type=Path, metavar="FILE.mp4", help="write a turntable, without a window")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where pictures go (default: view, beside the scene)")
    parser.add_argument("--size", type=size, metavar="WxH", help="of the window, or of pictures (960x720)")
    parser.add_argument("--num-frames", type=positive, default=100, metavar="N", help="of a turntable (default: 100)")
    parser.add_argument(
        "--exit-when-final", action="store_true", help="without a window: stop when a scene is finished"
    )


VERBS = (
    Verb(
        "view",
        "show a result, a scene or a running node",
        _view_arguments,
        import_lazily("splatnode.viewer.cli", "view"),
    ),
)
