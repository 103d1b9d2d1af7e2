"""Files that a stranger may have put there: regular ones only, and never more bytes than the reader can use."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


def read_bounded(path: Path, most: int, refusal: type[Exception], source: str = "") -> bytes:
    """The content of `path`, as long as it was when it was opened, if that is at most `most` bytes.

    A pipe or a device, which could be read for ever, is no file; nor is it opened, which some devices take for a
    command. Raises a `refusal` that begins with `source`, or OSError where the bytes cannot be had.
    """
    where = f"{source}: " if source else ""
    with open_regular(path, refusal, source) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise refusal(f"{where}the file has {size} bytes; at most {most} are read")
        return file.read(size)


@contextlib.contextmanager
def open_regular(path: Path, refusal: type[Exception], source: str = "") -> Iterator[BinaryIO]:
    """The file `path`, opened to be read. Raises as `read_bounded`."""
    where = f"{source}: " if source else ""
    if "\0" in str(path):
        raise refusal(f"{where}no file has a null byte in its name")
    _must_be_regular(os.stat(path), refusal, where)
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        _must_be_regular(os.fstat(file.fileno()), refusal, where)  # of what was opened, whatever was there before
        yield file


def _must_be_regular(found: os.stat_result, refusal: type[Exception], where: str) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = "folder" if stat.S_ISDIR(found.st_mode) else "pipe or a device"
        raise refusal(f"{where}must be a file, is a {kind}")
