"""The verb export."""

from __future__ import annotations

import argparse

from splatnode.capture.process.terminal import say
from splatnode.recon.result.export.convert import export_scene


def export(args: argparse.Namespace) -> int:
    say(export_scene(args.scene, args.to, args.out))
    return 0
