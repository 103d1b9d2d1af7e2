"""A file that holds all that was measured, and beside it a journal of what it does not hold yet.

A campaign of thousands of runs cannot write all of them after each. So each run is a line of the journal, on the disk
before the next begins in its place, and the whole is written now and then, and at the end.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any

from splatnode.capture.process.durable import open_itself

WRITE_EVERY_S = 5.0  # the whole, at most so often,
_SHARE = 20.0  # and so seldom that writing it takes at most this part of the time: 1 / 20


class Journal:
    """Use it as a context manager: at the end, however that comes, the whole is written and the journal removed."""

    def __init__(self, journal: Path, write: Callable[[], None]) -> None:
        """`write` writes the whole, with all that was added. Raises OSError where there can be no journal."""
        self._path, self._write = journal, write
        self._file: IO[bytes] = open_itself(journal, "a+b")
        self._unwritten, self._next_s = 0, time.monotonic() + WRITE_EVERY_S

    def recover_records(self) -> list[Any]:
        """The records that a killed process has left, to be asked for before any is added.

        Half a line is dropped, and so is a record with a number that is not finite, which `write` could not write.
        """
        self._file.seek(0)
        content = self._file.read()
        end = content.rfind(b"\n") + 1
        self._file.truncate(end)
        records = list(_parse_records(content[:end].splitlines()))
        self._unwritten = len(records)
        return records

    def add(self, record: Any) -> None:
        """`record` is of JSON. Whoever calls has put it where `write` finds it. Raises ValueError for NaN, infinity."""
        self._file.write(f"{json.dumps(record, allow_nan=False)}\n".encode())
        self._file.flush()
        os.fsync(self._file.fileno())
        self._unwritten += 1
        if time.monotonic() >= self._next_s:
            self._write_all()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            if self._unwritten:
                self._write_all()
            self._path.unlink(missing_ok=True)
        finally:
            self._file.close()

    def _write_all(self) -> None:
        began_s = time.monotonic()
        self._write()
        self._file.truncate(0)
        self._unwritten, ended_s = 0, time.monotonic()
        self._next_s = ended_s + max(WRITE_EVERY_S, _SHARE * (ended_s - began_s))


def _parse_records(lines: Iterable[bytes]) -> Iterator[Any]:
    """The records of the lines but those with NaN or an infinity, which Python reads and JSON does not have."""
    for line in lines:
        odd: list[str] = []
        record = json.loads(line, parse_constant=odd.append)
        if not odd:
            yield record
