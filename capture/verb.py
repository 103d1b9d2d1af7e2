"""A verb of the command line. Each room lists its own in `verbs.py`, which loads nothing that takes time."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

Command = Callable[[argparse.Namespace], int]  # returns the exit code


@dataclass(frozen=True)
class Verb:
    name: str
    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Command


def lazily(module: str, function: str) -> Command:
    """`function` of `module`, which is imported when the verb runs and not before."""

    def run(args: argparse.Namespace) -> int:
        return getattr(import_module(module), function)(args)

    return run
