"""One process at a time: a lock that the kernel lets go of when its holder dies, however it dies."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path


class Held(RuntimeError):
    """Another process holds the lock."""

    exit_code = 75

    def __init__(self, message: str, pid: int | None) -> None:
        super().__init__(message)
        self.pid = pid


@contextlib.contextmanager
def exclusive(path: Path) -> Iterator[None]:
    """Holds the lock file at `path`, which stays and tells the holder's process id. Raises Held."""
    with open(path, "a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            text = file.read(32).strip()
            pid = int(text) if text.isdecimal() else None
            raise Held(f"{path} is held by {f'process {pid}' if pid else 'another process'}", pid) from error
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield
