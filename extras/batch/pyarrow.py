"""Tables as Parquet: that of the batch, and the cameras of a data set."""

from __future__ import annotations

import contextlib
import heapq
from collections.abc import Container, Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from splatnode.capture.process.text import guard_untrusted, sanitize_text
from splatnode.extras.batch import Outcome
from splatnode.extras.lerobot import UnusableDataSet, check_whole
from splatnode.extras.pyarrow import open_bounded_table

_ROWS, _AT_A_TIME = 10_000, 500  # in memory at a time: of a batch, and of cameras
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
_Seen = tuple[int, str]  # an episode, and the key of a camera


def write(path: Path, rows: Iterable[Outcome]) -> None:
    """Raises OSError."""
    _write(path, map(msgspec.structs.asdict, rows), SCHEMA, _ROWS)


def write_cameras(source: Path, target: Path, rows: Iterable[Mapping[str, Any]], anew: Container[_Seen]) -> None:
    """A table of what cameras of episodes are known: `rows`, and those of `source`, if it is there, but of `anew`.

    `anew` are the episodes and cameras of `rows`. Both are in the order of these, and so is `target`. Raises
    UnusableDataSet where `source` is no such table, OSError.
    """
    kept = (row for row in _read_rows(source) if _row_key(row) not in anew) if source.exists() else ()
    _write(target, heapq.merge(kept, rows, key=_row_key), _SIDE, _AT_A_TIME)


def _row_key(row: Mapping[str, Any]) -> _Seen:
    return row["episode_index"], row["camera"]


@contextlib.contextmanager
def _raise_as_unusable_data_set(said: str) -> Iterator[None]:
    """Raises failures inside as UnusableDataSet. pyarrow raises OSError for damaged bytes, too."""
    with guard_untrusted(UnusableDataSet, said):
        try:
            yield
        except OSError as error:
            if error.errno is not None:
                raise
            raise ValueError(str(error)) from error


def _read_rows(file: Path) -> Iterator[dict[str, Any]]:
    """The rows of a table that `write_cameras` wrote, some at a time.

    Raises UnusableDataSet where it is none, OSError.
    """
    shown = sanitize_text(str(file))
    must = f"{shown!r} must be a table of cameras that splatnode wrote, for others to be added"
    said = f"{must}; move it away, or mend it"
    check_whole(file, UnusableDataSet, said)
    with _raise_as_unusable_data_set(said), open_bounded_table(file) as table:
        names = set(table.schema_arrow.names)
        if others := sorted(names - set(_SIDE.names)):
            raise UnusableDataSet(
                f"{must}; it has other columns ({sanitize_text(', '.join(others), 200)}): move it away"
            )
        if missing := sorted({"episode_index", "camera"} - names):
            raise UnusableDataSet(f"{must}; it has no column {missing[0]}: move it away")
        for some in table.iter_batches(_AT_A_TIME):
            if some.column("episode_index").null_count or some.column("camera").null_count:
                raise UnusableDataSet(f"{must}; it has rows of no episode or no camera: move it away")
            columns = {name: some.column(name).cast(_SIDE.field(name).type) for name in names}
            yield from pa.table(columns).to_pylist()


def write_with_columns(source: Path, target: Path, by_camera: Mapping[str, Mapping[int, Mapping[str, Any]]]) -> None:
    """A table of episodes with further columns, splatnode/CAMERA/..., for the cameras and episodes of `by_camera`.

    All other columns stay, and so does what earlier ones of these names have of other episodes. What is not known of
    an episode is null. Raises UnusableDataSet where `source` cannot be read or has other columns of these names,
    OSError.
    """
    shown = repr(sanitize_text(str(source)))
    check_whole(source, UnusableDataSet, shown)
    with contextlib.ExitStack() as opened:
        with _raise_as_unusable_data_set(shown):
            table = opened.enter_context(open_bounded_table(source))
        writer: pq.ParquetWriter | None = None
        for index in range(table.num_row_groups):
            with _raise_as_unusable_data_set(shown):
                some = table.read_row_group(index, use_threads=False)
            some = _add_columns(some, by_camera, shown)
            writer = writer or opened.enter_context(pq.ParquetWriter(target, some.schema, compression="snappy"))
            writer.write_table(some)
        if writer is None:
            empty = _add_columns(table.schema_arrow.empty_table(), by_camera, shown)
            pq.write_table(empty, target, compression="snappy")


def _add_columns(table: pa.Table, by_camera: Mapping[str, Mapping[int, Mapping[str, Any]]], shown: str) -> pa.Table:
    """As `write_with_columns`, of some rows. Raises UnusableDataSet."""
    with _raise_as_unusable_data_set(shown):
        episodes = table.column("episode_index").to_pylist()
    for camera, known in by_camera.items():
        is_known = pa.array([episode in known for episode in episodes], pa.bool_())
        for name, kind in _OF_EPISODE.items():
            title = f"{_PREFIX}/{camera}/{name}"
            values = pa.array([known[episode][name] if episode in known else None for episode in episodes], kind)
            if title in table.column_names:
                with _raise_as_unusable_data_set(f"{shown}: the column {sanitize_text(title)}"):
                    before = table.column(title).cast(kind)
                merged = pc.call_function("if_else", [is_known, values, before])
                table = table.set_column(table.column_names.index(title), title, merged)
            else:
                table = table.append_column(title, values)
    return table


def _write(path: Path, rows: Iterable[Mapping[str, Any]], schema: pa.Schema, at_a_time: int) -> None:
    remaining = iter(rows)
    with pq.ParquetWriter(path, schema) as writer:
        while some := list(islice(remaining, at_a_time)):
            writer.write_table(pa.Table.from_pylist(some, schema=schema))
