"""batch.csv, and batch.parquet where pyarrow is installed: a row for each recording, written row by row."""

from __future__ import annotations

import contextlib
import csv
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec

from splatnode.capture.process.durable import sync_folder
from splatnode.capture.process.printable import cell, escape_text
from splatnode.recon.batch.answer import Outcome

CSV, PARQUET = "batch.csv", "batch.parquet"
COLUMNS = Outcome.__struct_fields__
BEING_WRITTEN = ".partial"  # the end of the hidden name under which a file is written; a killed process leaves it


def write_csv(path: Path, rows: Iterable[Outcome]) -> None:
    """Writes rows; the unknown is empty, text is what a spreadsheet takes for text. Raises OSError."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            writer.writerow(map(cell, msgspec.structs.astuple(escape_source(row))))


def write_parquet(path: Path, rows: Iterable[Outcome]) -> None:
    """Raises ModuleNotFoundError without pyarrow, OSError."""
    from splatnode.recon.batch import pyarrow  # takes half a second, and is an extra

    with replacing(path) as temporary:
        pyarrow.write(temporary, map(escape_source, rows))


def escape_source(row: Outcome) -> Outcome:
    """Returns the row with its source as text: bytes of a file's name that are no UTF-8 become escapes."""
    return msgspec.structs.replace(row, source=escape_text(row.source))


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A new file that takes the place of `path` at the end, and is on the disk then; else it is removed."""
    temporary = path.with_name(f".{path.name}{BEING_WRITTEN}")
    temporary.unlink(missing_ok=True)
    try:
        temporary.touch(exist_ok=False)  # what the name led to, if it was a link, stays as it is
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)
