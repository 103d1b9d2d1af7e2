"""Columns of numbers in Parquet files, read in a process of its own: `pyarrow.py` is that process.

A file of some megabytes may hold a column of billions of values, or a page that is unpacked to gigabytes. What is read
is bounded by what the files say of themselves and, where they lie, by the limits of that process.
"""

from __future__ import annotations

import importlib.util
import os
import struct
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.process import apart
from splatnode.capture.process.records import decoder_of
from splatnode.capture.process.text import sanitize_text

MOST_ROWS = 1_000_000  # of all files together: more episodes than any data set has
_MOST_FILES = 10_000
_REMEMBERED = 16  # answers: a few data sets, of each its cameras
_HEAD = struct.Struct("<cI")  # the kind of an answer, and its rows, or the bytes of the sentence that refuses
COLUMNS, REFUSED, LOST = b"C", b"R", b"L"  # kinds: rows of float64, what is wrong with the files, or the disk's error
_MOST_SAID = 100_000  # bytes of a sentence
_Written = tuple[bytes, int, int]  # a file, when it was last written (ns), and its bytes: another file is read anew
Columns = npt.NDArray[np.float64]  # (rows, columns), NaN where there is no number


class Request(msgspec.Struct, frozen=True):
    """The request that the process gets on its standard input, as MessagePack."""

    files: tuple[bytes, ...]
    names: tuple[str, ...]  # of columns; the first must be there, and each of its rows must have a number; (): all


class Lost(msgspec.Struct, frozen=True):
    """An error of the disk, as the process says it."""

    number: int
    reason: str
    file: str


def column(files: Sequence[Path], name: str, refusal: type[Exception], where: str) -> Columns:
    """(rows,) of all tables in `files`. Raises as `row`."""
    return _table(files, (name,), refusal, where)[:, 0]


def row(
    files: Sequence[Path], name: str, value: int, wanted: Sequence[str], refusal: type[Exception], where: str
) -> tuple[float, ...] | None:
    """The `wanted` columns, NaN where there is none, of the last row that has `value` in the column `name`.

    Tables that did not change are read once. Raises a `refusal` that begins with `where` for what is no such table or
    beyond its bounds, OSError, and ModuleNotFoundError without pyarrow.
    """
    table = _table(files, (name, *wanted), refusal, where)
    places = np.flatnonzero(table[:, 0] == value)
    return tuple(table[places[-1], 1:].tolist()) if len(places) else None


def check_whole(file: Path, refusal: type[Exception], where: str) -> None:
    """Reads all of a table, a row group at a time, and gives nothing: afterwards it can be read so anywhere.

    Raises as `row`.
    """
    _table((file,), (), refusal, where)


def encode_columns(columns: Columns) -> bytes:
    """The answer of the process that has read them."""
    return _HEAD.pack(COLUMNS, len(columns)) + columns.tobytes()


def encode_refusal(kind: bytes, said: bytes) -> bytes:
    """The answer of the process that cannot read them."""
    return _HEAD.pack(kind, len(said[:_MOST_SAID])) + said[:_MOST_SAID]


def _table(files: Sequence[Path], names: tuple[str, ...], refusal: type[Exception], where: str) -> Columns:
    if importlib.util.find_spec("pyarrow") is None:
        folder = where.partition(": ")[0]
        said = f"{folder} is a LeRobot data set, and its tables are read with pyarrow, which is not installed"
        raise ModuleNotFoundError(said, name="pyarrow")
    if len(files) > _MOST_FILES:
        raise refusal(f"{where}: at most {_MOST_FILES} files are read, there are {len(files)}")
    stats = [(os.fsencode(file.absolute()), file.stat()) for file in files]
    kind, content = _answer(tuple((file, stat.st_mtime_ns, stat.st_size) for file, stat in stats), names)
    if kind == LOST:
        lost = decoder_of(Lost).decode(content)
        raise OSError(lost.number, lost.reason, lost.file)
    if kind == REFUSED:
        raise refusal(f"{where}: {sanitize_text(content.decode(errors='replace'), 500)}")
    return np.frombuffer(content, np.float64).reshape(-1, len(names) or 1)


@lru_cache(_REMEMBERED)
def _answer(written: tuple[_Written, ...], names: tuple[str, ...]) -> tuple[bytes, bytes]:
    """The kind of an answer, and what comes with it."""
    request = msgspec.msgpack.encode(Request(tuple(file for file, *_ in written), names))
    most = _HEAD.size + max(_MOST_SAID, MOST_ROWS * len(names) * 8)
    answer, code = apart.answer("splatnode.extras.lerobot.pyarrow", request, most)
    if len(answer) >= _HEAD.size:
        kind, count = _HEAD.unpack_from(answer)
        if len(answer) == _HEAD.size + count * (len(names) * 8 if kind == COLUMNS else 1):
            return kind, answer[_HEAD.size :]
    return REFUSED, f"its tables are damaged, or take too much memory: their reader ended ({code})".encode()
