"""Arguments of the verbs whose work is done some at a time."""

from __future__ import annotations

import argparse

from splatnode.capture.process.arguments import megabytes


def add_ray(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--ray",
        nargs="?",
        const="",
        metavar="ADDRESS",
        help="on the Ray cluster at this address, such as 10.0.0.1:6379 or auto; without one, on a Ray of this machine",
    )


def add_max_memory(parser: argparse.ArgumentParser, what: str) -> None:
    """`what` is that which takes the memory: "a recording"."""
    parser.add_argument("--max-memory", type=megabytes, metavar="MB", help=f"end {what} that takes more, in 10^6 bytes")
