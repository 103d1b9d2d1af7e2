"""What a case may touch: where it writes, how much memory it takes, and that the terminal stays quiet."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_PEAK = "/proc/self/clear_refs"  # where the kernel takes the order to forget the peak
_PATHS = {  # events of Python's audit that change the disk, and which of their arguments are paths
    **{
        name: (0,) for name in ("os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod", "os.chown", "os.mkfifo")
    },
    **{name: (0, 1) for name in ("os.rename", "os.link")},
    "os.symlink": (1,),
}


def confined_to(folder: Path) -> list[str]:
    """From now on every path outside of `folder` that this process writes to is added to the list returned."""
    outside: list[str] = []
    inside = os.path.realpath(folder)

    def audit(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            path, mode, flags = arguments
            writes = any(letter in mode for letter in "wax+") if isinstance(mode, str) else bool((flags or 0) & _WRITES)
            paths = [path] if writes else []
        else:
            paths = [arguments[index] for index in _PATHS.get(event, ())]
        for path in paths:
            if isinstance(path, (str, bytes, os.PathLike)) and not _within(os.fsdecode(path), inside):
                outside.append(f"{event} outside: {os.fsdecode(path)!r}")

    sys.addaudithook(audit)
    return outside


def _within(path: str, inside: str) -> bool:
    """Relative paths count from the folder: the process has changed into it, or into one that it opened there."""
    whole = os.path.normpath(os.path.join(inside, path))
    return whole == inside or whole.startswith(inside + os.sep) or whole in (os.devnull, _PEAK)


def peak_mb() -> float:
    """The most resident memory since the last call, in 2^20 bytes."""
    status = Path("/proc/self/status").read_text()
    peak = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))
    with open(_PEAK, "w") as file:
        file.write("5")
    return peak / 1024


def silence() -> None:
    """Decoders in C write what they think of a file to the standard error."""
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 2)
    os.close(quiet)
