"""Pieces of a node that write, each interrupted at every point: run in a fork, looked at by who starts after it.

A piece is `prepare` (what lies there before), `work` (in the fork, whose disk fails; it tells what it has promised) and
`after` (whole old or whole new, and the work can be done again; raises AssertionError).
"""

from __future__ import annotations

import os
import signal
import tempfile
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from splatnode.command_line import exit_code
from tests.support.disk_faults import KINDS, NOWHERE, Point, arm, points, struck

Tell = Callable[[str], None]
PATIENCE_S = 300  # for one run
FULL, KILLED = 74, -signal.SIGKILL


@dataclass(frozen=True)
class Piece:
    name: str
    prepare: Callable[[Path], None]
    work: Callable[[Path, Tell], None]
    after: Callable[[Path, list[str]], None]  # with what was told
    kinds: tuple[str, ...] = KINDS


@dataclass(frozen=True)
class Ended:
    """How a fork ended."""

    code: int  # as of the command line; negative: by this signal
    told: list[str]
    error: str  # the traceback, where there was an error
    reached: bool  # whether the fault struck
    points: list[Point]


def points_of(piece: Piece) -> list[Point]:
    """All points of an undisturbed run, after which all must be well."""
    with _place() as place:
        ended = _run(piece, Path(place).resolve(), NOWHERE, "")
        if ended.code:
            raise AssertionError(f"{piece.name} fails undisturbed: {ended.error}")
        piece.after(Path(place).resolve() / "disk", ended.told)
        return ended.points


def outcomes(piece: Piece, found: list[Point]) -> Iterator[tuple[Point, str, str]]:
    """Each point and kind of fault, with what was wrong afterwards; empty where all was well."""
    for point in found:
        for kind in filter(point.kinds.__contains__, piece.kinds):
            with _place() as place:
                yield point, kind, _wrong(piece, Path(place).resolve(), point, kind)


def _place() -> tempfile.TemporaryDirectory[str]:
    """In memory where that is possible: writing through to a real disk would only take time."""
    return tempfile.TemporaryDirectory(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None)


def _wrong(piece: Piece, place: Path, point: Point, kind: str) -> str:
    ended = _run(piece, place, point, kind)
    if not ended.reached:
        return "the point was not reached"
    expected = {KILLED} if kind == "kill" else {0, FULL}
    if ended.code not in expected:
        return f"ended with {ended.code}: {ended.error}"
    try:
        piece.after(place / "disk", ended.told)
    except Exception:
        left = sorted(str(path.relative_to(place)) for path in place.rglob("*"))
        return f"afterwards: {traceback.format_exc(limit=-3)} told {ended.told}; there: {left}"
    return ""


def _run(piece: Piece, place: Path, point: Point, kind: str) -> Ended:
    disk, listing, told, error = place / "disk", place / "points", place / "told", place / "error"
    disk.mkdir()
    piece.prepare(disk)
    child = os.fork()
    if child == 0:
        code = 70
        try:
            with told.open("a", buffering=1) as file:
                arm([disk], point, kind, listing)
                code = _code_of(lambda: piece.work(disk, lambda what: print(what, file=file)), error)
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    return Ended(
        os.waitstatus_to_exitcode(status),
        told.read_text().splitlines() if told.exists() else [],
        error.read_text() if error.exists() else "",
        struck(listing),
        points(listing),
    )


def in_a_fork(work: Callable[[], None]) -> None:
    """Does `work` undisturbed in a process of its own. Raises AssertionError where it does not end with 0."""
    with tempfile.NamedTemporaryFile() as error:
        child = os.fork()
        if child == 0:
            os._exit(_code_of(work, Path(error.name)))
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if code:
            raise AssertionError(f"the next start ended with {code}: {Path(error.name).read_text()}")


def _code_of(work: Callable[[], None], where: Path) -> int:
    """As the command line ends with what `work` raises."""
    signal.alarm(PATIENCE_S)
    try:
        work()
    except SystemExit as error:
        return error.code if isinstance(error.code, int) else 1
    except BaseException as error:
        where.write_text(traceback.format_exc(limit=-6))
        return exit_code(error)
    return 0
