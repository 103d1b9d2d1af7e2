"""What reading each crafted file comes to, and the memory that it takes: in a process of its own, which may end."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from importlib import import_module

from tests.conftest import ROOT
from tests.support.crafted.crafted import Crafted

_ADDRESS_SPACE = 6 << 30  # bytes, so that what takes all there is does not take the machine's
MARGIN = 200_000_000  # bytes beyond a stated bound, as issue 19 has it


@dataclass(frozen=True)
class Reading:
    name: str
    trick: str
    size: int  # bytes of the file
    taken: int  # bytes of memory at its peak, beyond what the process had before
    outcome: str  # what the reader returned, or "TYPE: message" of what it raised


def readings(corpus: str, reader: str) -> list[Reading]:
    """Of each file of `corpus`, read by `reader`: "module:function" each. A reader takes a Crafted and returns text.

    Raises AssertionError, with the name of the file, where the process ends.
    """
    command = [sys.executable, "-c", f"from {__name__} import _read_all; _read_all({corpus!r}, {reader!r})"]
    environment = {**os.environ, "OPENCV_LOG_LEVEL": "SILENT"}
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600)
    lines = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("{")]
    last = lines[-1]["name"] if lines else "none"
    assert run.returncode == 0 and lines, f"ended with {run.returncode} at {last}: {run.stderr[-1000:]}"
    return [Reading(**line) for line in lines if len(line) > 1]


def _read_all(corpus: str, reader: str) -> None:
    crafted: Callable[[], Iterable[Crafted]] = _named(corpus)
    read: Callable[[Crafted], str] = _named(reader)
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    for file in crafted():
        print(json.dumps({"name": file.name}), flush=True)
        before = _reset_peak()
        try:
            outcome = read(file)
        except Exception as error:
            outcome = f"{type(error).__name__}: {error}"
        print(
            json.dumps(asdict(Reading(file.name, file.trick, len(file.data), _memory("VmHWM") - before, outcome))),
            flush=True,
        )


def _named(name: str) -> Callable:
    module, _, function = name.partition(":")
    return getattr(import_module(module), function)


def _reset_peak() -> int:
    """The memory just now, from which the peak is counted afresh."""
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
    return _memory("VmRSS")


def _memory(field: str) -> int:
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith(field))
