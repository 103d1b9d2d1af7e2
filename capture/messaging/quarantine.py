"""Keyframes that nobody takes: recon refused them, or the disk damaged them. Kept to be looked at, within a bound.

A message's file lies under a number beside a record of why it is here. The oldest go where there are too many.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import re
from pathlib import Path
from typing import Annotated

import msgspec

from splatnode.capture.messaging.values import Name, Text, check
from splatnode.capture.process.durable import remove_leftovers, write_atomically
from splatnode.capture.process.foreign import guard_untrusted
from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.capture.process.printable import LONGEST_NAME, LONGEST_TEXT, sanitize_text
from splatnode.capture.process.private import StrayFile, list_own_files, make_owner_only_folder, read_own
from splatnode.capture.process.records import record_in

log = logging.getLogger(__name__)

_FILE = re.compile(r"[0-9]{12,18}\.frame")
_LARGEST_RECORD = 16 << 10  # bytes
_SEEN = "seen"  # a file with the number of the newest one that somebody has seen


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    max_frames: Annotated[int, msgspec.Meta(ge=1)] = 1000  # keyframes that are kept; beyond, the oldest goes
    max_mb: Annotated[int, msgspec.Meta(ge=1)] = 512  # their size, in 2^20 bytes; beyond, the oldest goes


class QuarantinedKeyframe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A keyframe that was set aside."""

    name: Name  # of the frame; a question mark where it does not tell
    reason: Text
    file: Name  # in which it waited


class Quarantine:
    """Takes files over from the spool beside it, whose lock it lies under. No failure of the disk is raised."""

    def __init__(self, directory: Path, config: Config) -> None:
        """Goes on with what lies in the directory. Raises OSError where it cannot be made, NotPrivate."""
        self.config = config
        self.directory = directory
        make_owner_only_folder(directory, "spool.directory (or $XDG_STATE_HOME)", ours=True)
        self._records: dict[int, QuarantinedKeyframe] = {}  # oldest first
        self._bytes: dict[int, int] = {}
        remove_leftovers(directory)
        for path in list_own_files(directory, _FILE, ".frame"):
            self._records[int(path.stem)] = _record(path)
            self._bytes[int(path.stem)] = path.stat().st_size
        self._last_seen = _number_in(directory / _SEEN)
        self._number = max(max(self._records, default=-1), self._last_seen) + 1
        self._keep_bound()

    def __len__(self) -> int:
        return len(self._records)

    @property
    def unseen(self) -> int:
        """How many of those that are here came after `mark_seen` was last called."""
        return sum(number > self._last_seen for number in self._records)

    def newest(self, count: int) -> tuple[QuarantinedKeyframe, ...]:
        """The last ones that came, newest first."""
        return tuple(itertools.islice(reversed(self._records.values()), count))

    def mark_seen(self) -> None:
        """Somebody has seen all that are here."""
        self._last_seen = self._number - 1
        try:
            write_atomically(self.directory / _SEEN, [b"%d\n" % self._last_seen])
        except OSError as error:
            log.warning("what was seen of %s is forgotten with this process: %s", self.directory, error)

    def take(self, path: Path, name: str, reason: str) -> None:
        """Moves the message's file here. Where the disk does not let it, it stays and comes again after a restart."""
        record = QuarantinedKeyframe(
            sanitize_text(name, LONGEST_NAME) or "?",
            sanitize_text(reason, LONGEST_TEXT),
            sanitize_text(path.name, LONGEST_NAME),
        )
        number = self._number
        try:
            write_atomically(self._file(number).with_suffix(".json"), [msgspec.json.encode(record)])
        except OSError as error:
            log.error("%s: the reason why it is set aside cannot be kept: %s", record.name, error)
        try:
            size = path.lstat().st_size
            path.rename(self._file(number))
        except OSError as error:
            log.error("%s: cannot be moved to the quarantine: %s", record.name, error)
            return
        self._number += 1
        self._records[number], self._bytes[number] = record, size
        self._keep_bound()

    def _keep_bound(self) -> None:
        while len(self) > self.config.max_frames or sum(self._bytes.values()) > self.config.max_mb << 20:
            oldest = next(iter(self._records))
            log.info("removed from the quarantine, which is full: %s", self._records[oldest].name)
            del self._records[oldest], self._bytes[oldest]
            for path in (self._file(oldest), self._file(oldest).with_suffix(".json")):
                with contextlib.suppress(OSError):
                    path.unlink()

    def _file(self, number: int) -> Path:
        return self.directory / f"{number:012d}.frame"


def _record(path: Path) -> QuarantinedKeyframe:
    """Why the message is here, as far as that is known."""
    beside = path.with_suffix(".json")
    try:
        with guard_untrusted(ValueError, beside):
            record = record_in(read_own(beside, _LARGEST_RECORD), QuarantinedKeyframe)
            check(record)
            return record
    except (OSError, ValueError) as error:
        raise_shortage(error)
        return QuarantinedKeyframe("?", "its reason was lost", sanitize_text(path.name, LONGEST_NAME))


def _number_in(path: Path) -> int:
    """-1 where there is none."""
    try:
        text = read_own(path, 20).strip()
    except (OSError, StrayFile) as error:
        raise_shortage(error)
        return -1
    return int(text) if re.fullmatch(b"[0-9]{1,18}", text) else -1
