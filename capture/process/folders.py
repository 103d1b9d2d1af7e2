"""Folders that a process makes: none is left behind empty, and one process at a time writes into one."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from splatnode.capture.process.lock import exclusive

LOCK = ".splatnode.lock"


@contextlib.contextmanager
def make_folder(folder: Path) -> Iterator[None]:
    """Makes `folder` and the folders above it; at the end removes those that it made and that are empty.

    Raises OSError where one cannot be made.
    """
    with contextlib.ExitStack() as resources:
        _make(folder, resources)
        yield


@contextlib.contextmanager
def claim_folder(folder: Path) -> Iterator[None]:
    """Makes `folder` as `make_folder` does and holds its lock, whose file is removed at the end. Raises Held, OSError."""
    with make_folder(folder), exclusive(folder / LOCK):
        try:
            yield
        finally:
            (folder / LOCK).unlink(missing_ok=True)


def _make(folder: Path, resources: contextlib.ExitStack) -> None:
    if folder.is_dir():
        return
    _make(folder.parent, resources)
    try:
        folder.mkdir()
    except FileExistsError as error:
        if folder.is_dir():  # another process has just made it
            return
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(folder)) from error
    resources.callback(_remove_if_empty, folder)


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):  # it holds files, which is the usual case
        folder.rmdir()
