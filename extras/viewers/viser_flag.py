"""`splatnode view --viser`: its flag, and what runs it."""

from __future__ import annotations

import argparse
from importlib import import_module
from typing import TYPE_CHECKING

from splatnode.capture.process.terminal import say
from splatnode.viewer.further import FurtherViewer

if TYPE_CHECKING:
    from splatnode.viewer.sources import Source


def _show(source: Source, args: argparse.Namespace) -> None:
    viser = import_module("splatnode.extras.viewers.viser")  # an extra
    viser.show(source, args.listen, viser.PORT if args.port is None else args.port, say)


VISER = FurtherViewer(
    "viser",
    "show it in a browser by viser, with the means of that (needs the extra viser); --web lets in fewer",
    "shows it in a browser",
    _show,
    is_server=True,
)
