"""One process at a time: a lock that the kernel lets go of when its holder dies, however it dies."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO


class LockHeld(RuntimeError):
    """Another process holds the lock."""

    exit_code = 75

    def __init__(self, message: str, pid: int | None) -> None:
        super().__init__(message)
        self.pid = pid


@contextlib.contextmanager
def exclusive(path: Path) -> Iterator[None]:
    """Holds the lock file at `path`, which is this user's and tells the holder's process id. Raises Held, OSError.

    The file stays, unless its holder removes it.
    """
    with contextlib.ExitStack() as resources:
        file = resources.enter_context(_hold_lock(path))
        while not _is_at(path, file):  # the holder before removed the file after it was opened here
            file = resources.enter_context(_hold_lock(path))
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield


@contextlib.contextmanager
def _hold_lock(path: Path) -> Iterator[TextIO]:
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with open(os.open(path, flags, 0o600), "a+", errors="replace") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EEXIST, "something lies where the lock belongs; remove it", str(path))
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            text = file.read(32).strip()
            pid = int(text) if text.isdecimal() else None
            raise LockHeld(f"{path} is held by {f'process {pid}' if pid else 'another process'}", pid) from error
        yield file


def _is_at(path: Path, file: TextIO) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False
