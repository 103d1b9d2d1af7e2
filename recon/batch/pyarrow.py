"""Tables as Parquet: that of the batch, and the cameras of a data set."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from splatnode.recon.batch.answer import Outcome

_ROWS, _SEEN = 10_000, 500  # in memory at a time
_KINDS = {"str": pa.string(), "bool": pa.bool_(), "int": pa.int64(), "float": pa.float64()}
SCHEMA = pa.schema(
    [(name, _KINDS[str(kind).removesuffix(" | None")]) for name, kind in Outcome.__annotations__.items()]
)
_NUMBERS = pa.list_(pa.float64())
_OF_EPISODE = {  # what is known of a camera in an episode; lists are of its keyframes
    "verdict": pa.string(),
    "message": pa.string(),
    "rotation_deg": pa.float64(),
    "centre_percent": pa.float64(),
    "focal_percent": pa.float64(),
    "frame_index": pa.list_(pa.int64()),
    "timestamp": _NUMBERS,
    "T_world_camera": pa.list_(_NUMBERS),
    "K": pa.list_(_NUMBERS),
    "width": pa.list_(pa.int64()),
    "height": pa.list_(pa.int64()),
}
_SIDE = pa.schema({"episode_index": pa.int64(), "camera": pa.string(), **_OF_EPISODE})
_PREFIX = "splatnode"  # of columns in a table of somebody else


def write(path: Path, rows: Iterable[Outcome]) -> None:
    """Raises OSError."""
    _write(path, map(msgspec.structs.asdict, rows), SCHEMA, _ROWS)


def write_seen(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """A table of what cameras of episodes are known. Raises OSError."""
    _write(path, rows, _SIDE, _SEEN)


def write_with_columns(source: Path, target: Path, by_camera: Mapping[str, Mapping[int, Mapping[str, Any]]]) -> None:
    """A table of episodes with further columns, splatnode/CAMERA/..., in place of earlier ones; all others as they are.

    What is not known of an episode is null. Raises OSError and pyarrow's errors.
    """
    table = pq.read_table(source)
    table = table.select([name for name in table.column_names if not name.startswith(f"{_PREFIX}/")])
    episodes = table.column("episode_index").to_pylist()
    for camera, known in by_camera.items():
        for name, kind in _OF_EPISODE.items():
            values = [known[episode][name] if episode in known else None for episode in episodes]
            table = table.append_column(f"{_PREFIX}/{camera}/{name}", pa.array(values, kind))
    pq.write_table(table, target, compression="snappy")


def _write(path: Path, rows: Iterable[Mapping[str, Any]], schema: pa.Schema, at_a_time: int) -> None:
    remaining = iter(rows)
    with pq.ParquetWriter(path, schema) as writer:
        while some := list(islice(remaining, at_a_time)):
            writer.write_table(pa.Table.from_pylist(some, schema=schema))
