"""The verb export."""

from __future__ import annotations

import argparse

from splatnode.capture.process.terminal import say, show_waiting
from splatnode.recon.result.export.format import export_scene
from splatnode.recon.result.export.prepare import Box, Selection


def export(args: argparse.Namespace) -> int:
    within = None if args.crop is None else Box(args.crop[:3], args.crop[3:])
    with show_waiting(f"writing the scene as {args.to}"):
        written = export_scene(
            args.scene, args.to, args.out, Selection(args.multi_view_only, within, args.no_background)
        )
    say(written)
    return 0
