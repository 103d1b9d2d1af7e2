"""Arguments that several verbs of reconstruction take."""

from __future__ import annotations

import argparse


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
