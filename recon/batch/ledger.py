"""batch.jsonl: what a batch is, then a line for each recording that came to an end. Lines are only added.

A line is on the disk before the next recording begins in its place, so that a driver that is killed repeats at most
what was running. A recording that was run again has a further line, and the last one counts.
"""

from __future__ import annotations

import json
import logging
import math
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO, NamedTuple

import msgspec

from splatnode.capture.process.durable import open_itself
from splatnode.capture.process.logs import event
from splatnode.capture.process.printable import sanitize_text
from splatnode.capture.process.records import record_of
from splatnode.recon.batch.answer import Outcome
from splatnode.recon.batch.sources import BatchRecording

log = logging.getLogger(__name__)

LEDGER = "batch.jsonl"
_FORMAT = 1

Key = tuple[str, str]


class Header(msgspec.Struct, frozen=True):
    """The first line."""

    batch: int  # the version of this format
    command: list[str]  # without the recording and its result folder: all recordings of a batch are run alike


class OtherBatch(ValueError):
    """The ledger that is there is of another batch, or of none."""


class _Last(NamedTuple):
    place: int  # where the last line of a recording begins
    verdict: str


class Ledger:
    """An open ledger. Use it as a context manager."""

    def __init__(self, folder: Path, command: Sequence[str]) -> None:
        """Opens the ledger of `folder`, or begins one. Raises OtherBatch, OSError."""
        self.path = folder / LEDGER
        self._file: IO[bytes] = open_itself(self.path, "a+b")
        self._last: dict[Key, _Last] = {}
        try:
            self._open(list(command))
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Ledger:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, found: Outcome) -> None:
        """Writes a line through to the disk."""
        self._note(found, self._file.seek(0, os.SEEK_END))
        self._write(msgspec.structs.asdict(found))

    def verdict(self, recording: BatchRecording) -> str | None:
        """Returns the verdict of the recording's last run, which may be FAILED; None: it has none."""
        last = self._last.get(_key(recording))
        return last and last.verdict

    def rows(self, wanted: Iterable[BatchRecording]) -> Iterator[Outcome]:
        """The last outcome of each recording, in this order; nothing for one that has none."""
        with self.path.open("rb") as file:
            for last in (self._last.get(_key(recording)) for recording in wanted):
                if last is not None:
                    file.seek(last.place)
                    yield _outcome(file.readline())

    def _open(self, command: list[str]) -> None:
        self._file.seek(0)
        first = self._file.readline()
        if not first.endswith(b"\n"):  # there is none, or its writer was killed
            self._file.truncate(0)
            self._write(msgspec.structs.asdict(Header(_FORMAT, command)))
            return
        self._check(first, command)
        end = place = self._file.tell()
        for line in self._file:
            if line.endswith(b"\n"):  # half a line is what a killed writer leaves
                end = place + len(line)
                self._read(line, place)
            place += len(line)
        self._file.truncate(end)

    def _check(self, first: bytes, command: list[str]) -> None:
        try:
            header = record_of(json.loads(first), Header)
        except ValueError as error:
            raise OtherBatch(f"{self.path} is not the ledger of a batch ({error}); give another --out") from error
        if header.batch != _FORMAT:
            raise OtherBatch(f"{self.path} has format {header.batch}, expected {_FORMAT}; give another --out")
        if header.command != command:
            raise OtherBatch(
                f"{self.path} is of a batch with other options: {sanitize_text(' '.join(header.command))}. Now they are "
                f"{' '.join(command)}. Give the same ones, or another --out"
            )

    def _read(self, line: bytes, place: int) -> None:
        try:
            self._note(_outcome(line), place)
        except ValueError as error:  # its recording is run again
            event(log, logging.WARNING, "line_unreadable", file=self.path, byte=place, error=sanitize_text(error))

    def _note(self, found: Outcome, place: int) -> None:
        self._last[_key(found)] = _Last(place, sys.intern(found.verdict))

    def _write(self, record: dict) -> None:
        self._file.write(f"{json.dumps(record)}\n".encode("ascii"))  # a path may have bytes that are no UTF-8
        self._file.flush()
        os.fsync(self._file.fileno())


def _key(of: BatchRecording | Outcome) -> Key:
    return of.name, of.source


def _outcome(line: bytes) -> Outcome:
    """Raises ValueError where the line is none of ours: Python's JSON has numbers that are not finite."""
    found = record_of(json.loads(line), Outcome)
    numbers = [each for each in msgspec.structs.astuple(found) if isinstance(each, float)]
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"the numbers of a row must be finite, got {numbers}")
    return found
