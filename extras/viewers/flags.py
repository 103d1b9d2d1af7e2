"""`splatnode view --rerun` and `--viser`: their flags, and what runs them."""

from __future__ import annotations

import argparse
from importlib import import_module
from typing import TYPE_CHECKING

from splatnode.capture.process.terminal import say
from splatnode.viewer.verbs import FurtherViewer

if TYPE_CHECKING:
    from splatnode.viewer.sources import Source


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rerun-url", metavar="URL", help="of --rerun, where the viewer is elsewhere")


def _check_arguments(args: argparse.Namespace) -> None:
    if args.rerun_url is not None and not args.rerun:
        raise ValueError("--rerun-url needs --rerun")


def _show_rerun(source: Source, args: argparse.Namespace) -> None:
    from splatnode.extras.viewers.rerun_stream import URL, stream

    stream(source, args.rerun_url or URL)


RERUN = FurtherViewer(
    "rerun",
    "show it in the rerun viewer that runs on this machine, or that ssh -R leads to; of a node each update, until "
    "Ctrl-C",
    "shows it in the rerun viewer",
    _show_rerun,
    _add_arguments,
    _check_arguments,
)


def _show_viser(source: Source, args: argparse.Namespace) -> None:
    viser = import_module("splatnode.extras.viewers.viser")  # an extra
    viser.show(source, args.listen, viser.PORT if args.port is None else args.port, say)


VISER = FurtherViewer(
    "viser",
    "show it in a browser by viser, with the means of that (needs the extra viser); --web lets in fewer",
    "shows it in a browser",
    _show_viser,
    is_server=True,
)
