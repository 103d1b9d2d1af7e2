"""Boundaries with a defect of each kind, by which the judgement is judged; they are attacked where they are named."""

from __future__ import annotations

import os
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.support.adversary.boundary import Boundary, Reader

_REFUSES = Reader((ValueError,), ())


def _raise(data: bytes, folder: Path) -> object:
    raise KeyError("nobody foresaw it")


def _refuse_in_lines(data: bytes, folder: Path) -> object:
    raise ValueError("the file is wrong\nevent=forged")


def _give_no_number(data: bytes, folder: Path) -> object:
    return {"depth": [1.0, float("nan")]}


def _speak(data: bytes, folder: Path) -> object:
    return os.write(2, b"libpng error: nobody asked\n")


def _write_elsewhere(data: bytes, folder: Path) -> object:
    path = Path(tempfile.gettempdir()).parent / "outside-of-the-case"
    try:
        path.write_bytes(b"")
    finally:
        path.unlink(missing_ok=True)
    return None


def _take_long(data: bytes, folder: Path) -> object:
    until = time.process_time() + 1.1
    while time.process_time() < until:
        pass
    return None


def _take_memory(data: bytes, folder: Path) -> object:
    return len(data * (75 << 20))  # whose every byte is written


def _end(data: bytes, folder: Path) -> object:
    sys.stderr.flush()
    os.kill(os.getpid(), 9)
    return None


def _draw(rng: random.Random) -> bytes:
    return rng.randbytes(4)


def _planted(name: str, read: Callable[[Any, Path], object]) -> Boundary:
    """From its third case on the boundary does what it must not: what comes before only warms up."""

    def reading(case: Any, folder: Path) -> object:
        _seen[name] = _seen.get(name, 0) + 1
        return read(case, folder) if _seen[name] > _WARM_UP else None

    return Boundary(f"planted: {name}", _draw, reading, _REFUSES, 10, tidy=False)


_WARM_UP = 42
_seen: dict[str, int] = {}
# By name, what is said of each defect.
PROBLEMS = {
    "raises": "KeyError: ",
    "refuses in lines": "it has 2 lines: ",
    "gives no number": "value['depth'][1] is nan",
    "speaks": "said on stderr: ",
    "writes elsewhere": "open outside: ",
    "takes long": "took ",
    "takes memory": "took ",
    "ends": "the process ended with -9",
}
_READS = (
    _raise,
    _refuse_in_lines,
    _give_no_number,
    _speak,
    _write_elsewhere,
    _take_long,
    _take_memory,
    _end,
)
PLANTED = tuple(_planted(name, read) for name, read in zip(PROBLEMS, _READS, strict=True))
