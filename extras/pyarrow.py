"""Parquet files within bounds, and the process that reads columns of them for `lerobot.py`. Needs pyarrow."""

from __future__ import annotations

import contextlib
import os
import resource
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from splatnode.capture.process import python
from splatnode.capture.process.config import decoder_of
from splatnode.capture.process.files import open_regular
from splatnode.extras.lerobot import LOST, MOST_ROWS, REFUSED, Columns, Lost, Request, encode_columns, encode_refusal

MEMORY_BYTES = 1_000_000_000  # of the process that reads, whatever the files say of themselves
_READING_S = 120  # of processor time at most
_AT_A_TIME = 50_000  # rows
_MOST_DIRECTORY = 50_000_000  # bytes of a file's own directory, which is in memory at once
_MOST_GROUPS, _MOST_COLUMNS = 100_000, 50_000
_MOST_GROUP_BYTES = 300_000_000  # of a row group, once it is unpacked
_MAGIC = b"PAR1"


class UnusableTable(ValueError):
    """A file that is no Parquet file, or beyond what is read of one; the text says why."""


@contextlib.contextmanager
def open_bounded_table(path: Path) -> Iterator[pq.ParquetFile]:
    """The Parquet file `path`, once what it says of itself is within bounds. Raises UnusableTable, OSError.

    What it says may be a lie: `tables.check_whole` reads it where that ends nothing else.
    """
    with open_regular(path, UnusableTable) as stream:
        _check_directory(stream)
        with pq.ParquetFile(stream, memory_map=False, pre_buffer=False) as table:
            metadata = table.metadata
            for count, most, what in (
                (metadata.num_rows, MOST_ROWS, "rows"),
                (metadata.num_row_groups, _MOST_GROUPS, "row groups"),
                (metadata.num_columns, _MOST_COLUMNS, "columns"),
            ):
                if not 0 <= count <= most:
                    raise UnusableTable(f"a table must have at most {most} {what}, it has {count}; split it")
            for index in range(metadata.num_row_groups):
                if not 0 <= (size := metadata.row_group(index).total_byte_size) <= _MOST_GROUP_BYTES:
                    raise UnusableTable(
                        f"a row group must have at most {_MOST_GROUP_BYTES} bytes, one has {size}; write smaller ones"
                    )
            yield table


def main() -> None:
    """The process: a Request on standard input, on standard output what `tables.encode_...` makes."""
    request = decoder_of(Request).decode(sys.stdin.buffer.read())
    limit()
    sys.stdout.buffer.write(_answer(request))


def limit() -> None:
    """Bounds the memory and the time of this process, which reads what a stranger wrote."""
    pa.set_memory_pool(pa.system_memory_pool())  # the others take address space in advance
    pa.set_cpu_count(1)
    resource.setrlimit(resource.RLIMIT_CPU, (_READING_S, _READING_S))
    python.limit_memory(MEMORY_BYTES)


def _answer(request: Request) -> bytes:
    try:
        return encode_columns(_columns(request))
    except UnusableTable as error:
        return encode_refusal(REFUSED, str(error).encode(errors="replace"))
    except OSError as error:
        if error.errno is not None:
            lost = Lost(error.errno, error.strerror or "", str(error.filename or ""))
            return encode_refusal(LOST, msgspec.msgpack.encode(lost))
        return encode_refusal(REFUSED, _unreadable(error))  # pyarrow says of damaged bytes, too, that they are one
    except MemoryError:
        return encode_refusal(REFUSED, f"its tables take more than {MEMORY_BYTES} bytes of memory".encode())
    except Exception as error:
        return encode_refusal(REFUSED, _unreadable(error))


def _unreadable(error: Exception) -> bytes:
    return f"cannot be read ({type(error).__name__}: {error})".encode(errors="replace")


def _columns(request: Request) -> Columns:
    parts, rows = [], 0
    for file in request.files:
        with open_bounded_table(Path(os.fsdecode(file))) as table:
            if not request.names:
                for index in range(table.num_row_groups):
                    table.read_row_group(index, use_threads=False)
                continue
            for part in _parts(table, request.names):
                rows += len(part)
                if rows > MOST_ROWS:
                    raise UnusableTable(f"a data set must have at most {MOST_ROWS} rows, it has more")
                parts.append(part)
    return np.concatenate(parts) if parts else np.zeros((0, len(request.names)))


def _parts(table: pq.ParquetFile, names: Sequence[str]) -> Iterator[Columns]:
    """The columns of some rows after the other; NaN where a column is not there, or has no value."""
    schema = table.schema_arrow
    there = [name for name in names if name in schema.names]
    if names[0] not in there:
        raise UnusableTable(f"there must be a column {names[0]}")
    for name in there:
        kind = schema.field(name).type
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_null(kind)):
            raise UnusableTable(f"the column {name} must be of numbers, it is of {kind}")
    for some in table.iter_batches(_AT_A_TIME, columns=there, use_threads=False):
        part = np.full((some.num_rows, len(names)), np.nan)
        for index, name in enumerate(names):
            if name in there:
                part[:, index] = some.column(name).cast(pa.float64()).to_numpy(zero_copy_only=False)
        if not np.isfinite(part[:, 0]).all():
            raise UnusableTable(f"the column {names[0]} must have a number in each row")
        yield part


def _check_directory(stream: BinaryIO) -> None:
    """Raises UnusableTable where the directory at the end of the file is not there, or larger than is read."""
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(0, size - 8))
    end = stream.read(8)
    stream.seek(0)
    if size < 12 or end[4:] != _MAGIC:
        raise UnusableTable("must be a Parquet file, which ends with PAR1; it is none, or cut")
    length = int.from_bytes(end[:4], "little")
    if length > min(_MOST_DIRECTORY, size - 12):
        raise UnusableTable(f"its directory must have at most {min(_MOST_DIRECTORY, size - 12)} bytes, not {length}")


if __name__ == "__main__":
    main()
