"""Is there room on the disk for what is about to be written, and was it the disk that failed?"""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

_OF_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS}


def is_disk_error(error: BaseException) -> bool:
    """Whether something failed because the disk did not take it, which says nothing of what it was."""
    return isinstance(error, OSError) and error.errno in _OF_DISK


def shortage(folder: Path, needed_bytes: int, what: str) -> str:
    """Why `what` may not fit into `folder`, with both numbers; empty where `needed_bytes` are free.

    `folder` need not exist yet. A file system that does not tell its size is taken to have room. Raises OSError.
    """
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    disk = shutil.disk_usage(existing)
    if disk.total == 0 or disk.free >= needed_bytes:
        return ""
    return f"{_megabytes(disk.free)} are free in {folder}, and {what} may take {_megabytes(needed_bytes)}"


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB"
