"""Viewers that are installed beside this one: each is a flag of `splatnode view`, and shows what this one would."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from splatnode.capture.process import plugins

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
