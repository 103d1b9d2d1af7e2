"""A boundary: what is drawn for it, what reads it, and the only errors that may come of it."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.support.adversary.mutants import mutant


@dataclass(frozen=True)
class Reader:
    """The errors by which modules refuse; any other is a defect. Good cases run most of the modules' lines."""

    refusals: tuple[type[BaseException], ...]
    modules: tuple[str, ...]


@dataclass(frozen=True)
class Boundary:
    """What is drawn, what reads it, and the memory that reading may take beside the process itself."""

    name: str
    draw: Callable[[random.Random], Any]
    read: Callable[[Any, Path], object]  # with a folder of its own
    reader: Reader
    bound_mb: float
    share: float = 1.0  # of all cases
    mutants: int = 0  # of each case that is drawn, with one more thing done to it
    tidy: bool = True  # whether the folder is emptied between cases: who overwrites its one file need not
    printed: bool = False  # whether all texts in what is read must be printable


def case_of(boundary: Boundary, seed: int, number: int) -> Any:
    """The case of this number: drawn, or a mutant of one that was."""
    drawn, step = divmod(number, 1 + boundary.mutants)
    case = boundary.draw(random.Random(f"{seed} {boundary.name} {drawn}"))
    return mutant(random.Random(f"{seed} {number}"), case) if step else case


def cases_of(boundary: Boundary, seed: int, first: int, end: int) -> Any:
    """As `case_of`, one after the other; what is drawn is drawn once."""
    known, case = -1, None
    for number in range(first, end):
        drawn, step = divmod(number, 1 + boundary.mutants)
        if drawn != known:
            known, case = drawn, boundary.draw(random.Random(f"{seed} {boundary.name} {drawn}"))
        yield number, mutant(random.Random(f"{seed} {number}"), case) if step else case


def attempt(boundary: Boundary, case: Any, folder: Path) -> str:
    """ "read" or "refused". Raises whatever else the boundary raised: a defect."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    try:
        boundary.read(case, folder)
        return "read"
    except boundary.reader.refusals:
        return "refused"
    finally:
        shutil.rmtree(folder, ignore_errors=True)
