"""Columns of Parquet files. Needs pyarrow."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

_REMEMBERED = 16  # tables: a few data sets, of each its cameras
_Written = tuple[Path, int, int]  # a file, when it was last written (ns), and its bytes: another file is read anew


def column(files: Sequence[Path], name: str) -> list[Any]:
    """Of all rows of the tables in `files`. Raises OSError and pyarrow's errors."""
    return _table(files, (name,))[name].to_pylist()


def row(files: Sequence[Path], name: str, value: Any, wanted: Sequence[str]) -> dict[str, Any] | None:
    """The last row that has `value` in the column `name`, with those of the `wanted` columns that there are.

    Tables that did not change are read once. Raises OSError and pyarrow's errors.
    """
    table = _table(files, (name, *wanted))
    return next(reversed(table.filter(pc.field(name) == value).to_pylist()), None)


def _table(files: Sequence[Path], wanted: tuple[str, ...]) -> pa.Table:
    stats = [(file, file.stat()) for file in files]
    return _read(tuple((file, stat.st_mtime_ns, stat.st_size) for file, stat in stats), wanted)


@lru_cache(_REMEMBERED)
def _read(written: tuple[_Written, ...], wanted: tuple[str, ...]) -> pa.Table:
    return pa.concat_tables([_columns(file, wanted) for file, *_ in written], promote_options="permissive")


def _columns(file: Path, wanted: Sequence[str]) -> pa.Table:
    there = set(pq.read_schema(file).names)
    return pq.read_table(file, columns=[name for name in wanted if name in there])
