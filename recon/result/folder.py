"""The folder that results are written into: one process at a time, checked before the work, not left behind empty."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Iterator
from pathlib import Path

from splatnode.capture.process.files import LockHeld, claim_folder, shortage
from splatnode.recon.result.export.staged import ResultWriteError, explain_error, finish_interrupted_write


class FolderInUse(LockHeld):
    """Another process writes results into this folder."""

    def __init__(self, folder: Path, pid: int | None) -> None:
        who = f"process {pid}" if pid else "another process"
        super().__init__(f"{who} writes its results into {folder} already; stop it, or give another --out", pid)


@contextlib.contextmanager
def hold_result_folder(out: Path, needed_bytes: int = 0) -> Iterator[None]:
    """Holds the folder `out` for this process. Folders that it made and that are empty are removed at the end.

    Raises ResultWriteError where nothing can be written into it or fewer than `needed_bytes` are free, and FolderInUse
    where another process holds it: all before the work and not after it. What a killed process had begun is finished.
    """
    with contextlib.ExitStack() as resources:
        try:
            resources.enter_context(claim_folder(out))
            finish_interrupted_write(out, (path for path in out.iterdir() if path.is_dir() and not path.is_symlink()))
            why = shortage(out, needed_bytes, "the result")
        except LockHeld as error:
            raise FolderInUse(out, error.pid) from error
        except OSError as error:
            raise ResultWriteError(error.errno, explain_error(error, out)) from error
        if why:
            raise ResultWriteError(errno.ENOSPC, f"{why}. Free some space or choose another folder")
        yield
