"""A disk that fails at a chosen call: `disk_faults.c`, compiled, and driven from Python.

kill    the process dies there by SIGKILL, a write half done
full    the disk is full from there on, a write half done; what needs no space still succeeds
once    this one call finds no space
io      this one call fails with an error of the disk
"""

from __future__ import annotations

import ctypes
import os
import subprocess
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatnode.recon.core.compile import find_compiler

SOURCE = Path(__file__).with_suffix(".c")
KINDS = ("kill", "full", "once", "io")
_NEEDS_NO_SPACE = ("unlink", "rmdir", "truncate")


@dataclass(frozen=True, order=True)
class Point:
    """The `number`th call (from 1) that is named `name`: what it does and to which file."""

    name: str
    number: int

    def __str__(self) -> str:
        return f"{self.name} #{self.number}"

    @property
    def kinds(self) -> tuple[str, ...]:
        """The faults that can strike there: a full disk still lets files be removed."""
        return ("kill", "io") if self.name.split()[0] in _NEEDS_NO_SPACE else KINDS


NOWHERE = Point("", 0)


def compiled(folder: Path, source: Path = SOURCE) -> Path:
    """The library to preload, made in `folder`."""
    compiler = find_compiler()  # the one that makes the core
    assert compiler is not None
    library = folder / f"{source.stem}.so"
    subprocess.run([*compiler, "-x", "c", "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True)
    return library


def environment(
    library: Path,
    under: Sequence[Path] = (),
    point: Point = NOWHERE,
    kind: str = "",
    listing: Path | str = "",
    room: Path | str = "",
    read_only: Path | str = "",
) -> dict[str, str]:
    """For a process whose disk is to fail; `room`: once this file is there, a full disk is full no longer.

    `read_only`: as long as this file is there, the disk is read-only.
    """
    return {
        "LD_PRELOAD": str(library),
        "DISK_FAULTS_UNDER": ":".join(str(folder.resolve()) for folder in under),
        "DISK_FAULTS_AT": point.name,
        "DISK_FAULTS_NUMBER": str(point.number),
        "DISK_FAULTS_KIND": kind,
        "DISK_FAULTS_LIST": str(listing),
        "DISK_FAULTS_ROOM": str(room),
        "DISK_FAULTS_READ_ONLY": str(read_only),
    }


def arm(under: Sequence[Path], point: Point, kind: str, listing: Path) -> None:
    """In a process with the library: from now on the disk fails there."""
    folders = ":".join(str(folder.resolve()) for folder in under)
    arguments = [os.fsencode(each) for each in (folders, point.name)], [os.fsencode(each) for each in (kind, listing)]
    ctypes.CDLL(None).disk_faults_arm(*arguments[0], point.number, *arguments[1], b"")


def is_loaded() -> bool:
    return hasattr(ctypes.CDLL(None), "disk_faults_arm")


def points(listing: Path) -> list[Point]:
    """The calls of a listing, in their order, each with its number among those of its name."""
    seen: Counter[str] = Counter()
    found = []
    for line in _lines(listing):
        name = line.removeprefix("! ")
        seen[name] += 1
        found.append(Point(name, seen[name]))
    return found


def struck(listing: Path) -> bool:
    """Whether the fault's call was made."""
    return any(line.startswith("! ") for line in _lines(listing))


def _lines(listing: Path) -> Iterable[str]:
    return listing.read_text(errors="replace").splitlines() if listing.exists() else ()
