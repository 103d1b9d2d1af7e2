"""Columns of Parquet files. Needs pyarrow."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq


def rows(file: Path, wanted: Sequence[str]) -> list[dict[str, Any]]:
    """The rows of a table with those of these columns that it has. Raises OSError and pyarrow's errors."""
    there = set(pq.read_schema(file).names)
    return pq.read_table(file, columns=[name for name in wanted if name in there]).to_pylist()
