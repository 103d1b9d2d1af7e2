"""A verb of the command line. Each room lists its own in `verbs.py`, which loads nothing that takes time."""

from __future__ import annotations

import argparse
import gc
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

from splatnode.capture.process.progress import show_waiting

Command = Callable[[argparse.Namespace], int]  # returns the exit code


@dataclass(frozen=True)
class Verb:
    name: str
    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Command


def import_lazily(module: str, function: str) -> Command:
    """`function` of `module`, which is imported when the verb runs and not before."""

    def run(args: argparse.Namespace) -> int:
        return getattr(_load_module(module), function)(args)

    return run


def _load_module(module: str) -> ModuleType:
    """The module, without the collector, which would walk through all that torch brings again and again meanwhile.

    What is there then stays as long as the process, so that no later collection walks through it either.
    """
    gc.disable()
    try:
        with show_waiting("loading splatnode"):
            return import_module(module)
    finally:
        gc.freeze()
        gc.enable()
