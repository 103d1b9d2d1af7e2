"""The table as Parquet."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from splatnode.recon.batch.answer import Outcome

_ROWS = 10_000  # in memory at a time
_KINDS = {"str": pa.string(), "bool": pa.bool_(), "int": pa.int64(), "float": pa.float64()}
SCHEMA = pa.schema(
    [(name, _KINDS[str(kind).removesuffix(" | None")]) for name, kind in Outcome.__annotations__.items()]
)


def write(path: Path, rows: Iterable[Outcome]) -> None:
    """Raises OSError."""
    remaining = iter(rows)
    with pq.ParquetWriter(path, SCHEMA) as writer:
        while some := [msgspec.structs.asdict(row) for row in islice(remaining, _ROWS)]:
            writer.write_table(pa.Table.from_pylist(some, schema=SCHEMA))
