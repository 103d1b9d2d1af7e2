"""Files that are whole or not there, also after a power cut; and files that no link leads to."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import uuid
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.capture.process.private import create_own

_BUFFER = 1 << 20  # bytes: the many small arrays of a message are one call each else


def write_atomically(path: Path, content: Iterable[bytes | memoryview]) -> None:
    """Writes `path` under a temporary name, through to the disk, then renames it. Raises OSError, nothing left.

    Only this user can read it. A process that is killed may leave the temporary file, `.NAME.*.tmp`.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with open(create_own(temporary), "wb", buffering=_BUFFER) as file:
            file.writelines(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def open_itself(path: Path, mode: str, **options: Any) -> IO[Any]:
    """Opens a file to write into it as `open` does, but not one that a link in its place names. Raises OSError."""
    try:
        return open(path, mode, opener=_open_no_link, **options)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise OSError(error.errno, "a link lies where this file belongs; remove it", str(path)) from error


def _open_no_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)


def remove_leftovers(folder: Path) -> None:
    """Removes what killed processes left of files that they were writing. For the one process that writes there."""
    for leftover in folder.glob(".*.tmp"):
        with contextlib.suppress(OSError):  # where it cannot be removed, it is in nobody's way
            if stat.S_ISREG(leftover.lstat().st_mode):
                leftover.unlink()


def sync_folder(folder: Path) -> None:
    """Makes renames and removals survive a power cut. A file system that cannot do it has done what it can.

    Raises what is_shortage tells: where the folder cannot be opened now, nothing is promised.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise_shortage(error)
