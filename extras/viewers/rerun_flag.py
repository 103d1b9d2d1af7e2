"""`splatnode view --rerun`: its flags, and what runs it."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from splatnode.viewer.further import FurtherViewer

if TYPE_CHECKING:
    from splatnode.viewer.sources import Source


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rerun-url", metavar="URL", help="of --rerun, where the viewer is elsewhere")


def _check_arguments(args: argparse.Namespace) -> None:
    if args.rerun_url is not None and not args.rerun:
        raise ValueError("--rerun-url needs --rerun")


def _show(source: Source, args: argparse.Namespace) -> None:
    from splatnode.extras.viewers.rerun_stream import URL, stream

    stream(source, args.rerun_url or URL)


RERUN = FurtherViewer(
    "rerun",
    "show it in the rerun viewer that runs on this machine, or that ssh -R leads to; of a node each update, until "
    "Ctrl-C",
    "shows it in the rerun viewer",
    _show,
    _add_arguments,
    _check_arguments,
)
