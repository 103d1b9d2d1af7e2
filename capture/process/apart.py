"""Our code in a process of its own, with a limit on its memory: what a stranger's file does to it ends there."""

from __future__ import annotations

import resource
import sys


def command(module: str, *arguments: str) -> list[str]:
    """The command of a process that runs `main()` of `module`, with these arguments in its sys.argv.

    Its path of modules is ours, and not the folder in which we happen to be.
    """
    code = f"import sys; sys.path[:] = {sys.path!r}; from {module} import main; main()"
    return [sys.executable, "-I", "-c", code, *arguments]


def limit_memory(further_bytes: int) -> None:
    """Lets this process take so many bytes beyond those that it has now; a later limit may be another one."""
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    limit = _data_bytes() + further_bytes
    resource.setrlimit(resource.RLIMIT_DATA, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))


def _data_bytes() -> int:
    """What RLIMIT_DATA counts, of this process just now."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmData"))
