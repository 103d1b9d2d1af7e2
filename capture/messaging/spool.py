"""Keyframes on disk until recon has answered them: bounded, oldest first, whole or not there.

The name of a message's file gives the order, which is kept from one process to the next: what a killed process left is
delivered before what its successor adds. What recon refuses, and what the disk damaged, goes to the quarantine beside
it.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec

from splatnode.capture.messaging.wire import MAGIC, VERSION, Name, Part, Text, check
from splatnode.capture.process.config import Internal, record_in
from splatnode.capture.process.files import (
    StrayFile,
    exclusive,
    list_own_files,
    make_owner_only_folder,
    read_own,
    remove_leftovers,
    shortage,
    state_directory,
    write_atomically,
)
from splatnode.capture.process.system import raise_shortage
from splatnode.capture.process.text import LONGEST_NAME, LONGEST_TEXT, guard_untrusted, sanitize_text

# A message as a file: as it goes over the wire, with a checksum, whole or not there.

LARGEST = 4 << 30  # bytes of a body, unless the reader knows better

_HEAD = struct.Struct("<8sIQI")  # magic, parts, bytes of the body, its CRC-32
_MAGIC = b"SPLSPOOL"
_SIZE = struct.Struct("<Q")
# Of files that earlier versions wrote: what they lack in today's headers has a default.
_EARLIER = tuple(MAGIC[:-1] + bytes([version]) for version in range(1, VERSION))


def size_in_file(parts: Sequence[Part]) -> int:
    """Bytes of the body that `write_message` writes."""
    return sum(_SIZE.size + memoryview(part).nbytes for part in parts)


def write_message(path: Path, parts: Sequence[Part]) -> None:
    """Returns when the message is on the disk. Raises OSError, with what was there before intact."""
    body = [piece for part in parts for piece in (_SIZE.pack(memoryview(part).nbytes), part)]
    checksum = 0
    for piece in body:
        checksum = zlib.crc32(piece, checksum)
    write_atomically(path, [_HEAD.pack(_MAGIC, len(parts), size_in_file(parts), checksum), *body])


class MessageFileError(ValueError):
    """The file is no message that was written here, or the disk has lost a part of it; the text names it."""


def read_message(path: Path, most_bytes: int = LARGEST) -> list[Part]:
    """The parts as they were written. Raises OSError, MessageFileError; StrayFile for a link, a pipe, a larger file."""
    content = memoryview(read_own(path, most_bytes + _HEAD.size))
    if len(content) < _HEAD.size:
        raise MessageFileError(f"{path} is no stored message")
    magic, count, size, checksum = _HEAD.unpack_from(content)
    body = content[_HEAD.size :]
    if magic != _MAGIC or len(body) != size or zlib.crc32(body) != checksum:
        raise MessageFileError(f"{path} is damaged")
    parts: list[Part] = list(_parts(body, count, path))
    return [MAGIC, *parts[1:]] if parts and parts[0] in _EARLIER else parts


def _parts(body: memoryview, count: int, path: Path) -> Iterator[memoryview]:
    for _ in range(count):
        length = _SIZE.unpack_from(body)[0] if len(body) >= _SIZE.size else 0
        if not 0 <= length <= len(body) - _SIZE.size:
            raise MessageFileError(f"{path} is damaged: its {count} parts are larger than the file")
        yield body[_SIZE.size : _SIZE.size + length]
        body = body[_SIZE.size + length :]
    if len(body):
        raise MessageFileError(f"{path} is damaged: its {count} parts are smaller than the file")


# Keyframes that nobody takes: recon refused them, or the disk damaged them. Kept to be looked at, within a bound.
#
# A message's file lies under a number beside a record of why it is here. The oldest go where there are too many.

log = logging.getLogger(__name__)

_QUARANTINED = re.compile(r"[0-9]{12,18}\.frame")
_LARGEST_RECORD = 16 << 10  # bytes
_SEEN = "seen"  # a file with the number of the newest one that somebody has seen


class QuarantineConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keyframes that nobody takes: recon refused them, or the disk damaged them. Kept to be looked at, within a
    bound."""

    max_frames: Annotated[int, msgspec.Meta(ge=1)] = 1000  # keyframes that are kept; beyond, the oldest goes
    max_mb: Annotated[int, msgspec.Meta(ge=1)] = 512  # their size, in 2^20 bytes; beyond, the oldest goes


class QuarantinedKeyframe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A keyframe that was set aside."""

    name: Name  # of the frame; a question mark where it does not tell
    reason: Text
    file: Name  # in which it waited


class Quarantine:
    """Takes files over from the spool beside it, whose lock it lies under. No failure of the disk is raised."""

    def __init__(self, directory: Path, config: QuarantineConfig) -> None:
        """Goes on with what lies in the directory. Raises OSError where it cannot be made, NotPrivate."""
        self.config = config
        self.directory = directory
        make_owner_only_folder(directory, "spool.directory (or $XDG_STATE_HOME)", ours=True)
        self._records: dict[int, QuarantinedKeyframe] = {}  # oldest first
        self._bytes: dict[int, int] = {}
        remove_leftovers(directory)
        for path in list_own_files(directory, _QUARANTINED, ".frame"):
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


class SpoolConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keyframes on disk until recon has answered them: bounded, oldest first, whole or not there."""

    # None: $STATE_DIRECTORY, else $XDG_STATE_HOME/splatnode, else ~/.local/state/splatnode
    directory: Path | None = None
    # Keyframes that wait for recon; when there are so many, no further one is taken
    max_frames: Annotated[int, msgspec.Meta(ge=1)] = 200
    # Their size, in 2^20 bytes, at which likewise no further one is taken
    max_mb: Annotated[int, msgspec.Meta(ge=1)] = 1024
    quarantine: Internal[QuarantineConfig] = QuarantineConfig()  # keyframes that recon refused


_FILE = re.compile(r"[0-9]{12,18}-[0-9a-f]{32}-[0-9]{1,18}\.frame")  # number, session, sequence


class SpoolFull(RuntimeError):
    """No keyframe can be added now: the spool has reached its bound, or the disk does not take it."""


class Key(NamedTuple):
    """Identifies a keyframe: the session of the capture process, and the number in it."""

    session: str
    sequence: int


class Spool:
    """Survives its process: what was put in is there until it is removed. One process at a time uses a directory."""

    def __init__(self, config: SpoolConfig, camera_id: str = "") -> None:
        """Takes over what lies in the directory; what is damaged is put aside. Raises OSError, Held, NotPrivate.

        Captures beside one another have a camera id each, and so a spool each.
        """
        self.config = config
        self.directory = spool_directory(config, camera_id)
        make_owner_only_folder(self.directory, "spool.directory (or $XDG_STATE_HOME)", ours=True)
        self._resources = contextlib.ExitStack()
        self._resources.enter_context(exclusive(self.directory / "lock"))
        self._files: dict[Key, Path] = {}  # oldest first
        self._bytes: dict[Key, int] = {}
        self._acknowledged: list[Path] = []  # that are still to be removed
        self.quarantine = Quarantine(self.directory.with_name(_name("quarantine", camera_id)), config.quarantine)
        remove_leftovers(self.directory)
        found = list_own_files(self.directory, _FILE, ".frame")
        for path in found:
            self._take_over(path)
        self._number = max((_number(path) for path in found), default=-1) + 1

    def close(self) -> None:
        """Lets another process use the directory."""
        self._resources.close()

    def __len__(self) -> int:
        return len(self._files)

    def __iter__(self) -> Iterator[Key]:
        """Oldest first."""
        return iter(tuple(self._files))

    def __contains__(self, key: object) -> bool:
        return key in self._files

    @property
    def size_bytes(self) -> int:
        return sum(self._bytes.values())

    def shortage(self) -> str:
        """Why the disk may be full before the bound is reached; empty where it has room."""
        further_bytes = (self.config.max_mb << 20) - self.size_bytes
        return shortage(self.directory, further_bytes, "further keyframes (spool.max_mb)")

    def check_room(self, size: int) -> None:
        """Raises SpoolFull where a message of so many bytes would exceed the bound."""
        if len(self) >= self.config.max_frames or self.size_bytes + size > self.config.max_mb << 20:
            raise SpoolFull(
                f"{len(self)} keyframes ({self.size_bytes >> 20} MB) wait in {self.directory}, which is the bound; "
                "is splatnode recon running?"
            )

    def store(self, key: Key, parts: Sequence[Part]) -> None:
        """Returns when the message is on the disk.

        Raises SpoolFull; what is_shortage tells, where another time may do.
        """
        size = size_in_file(parts)
        self.check_room(size)
        path = self.directory / f"{self._number:012d}-{key.session}-{key.sequence}.frame"
        try:
            write_message(path, parts)
        except OSError as error:  # full, read-only, failing: it may be so for a while, and the camera goes on
            raise_shortage(error)
            raise SpoolFull(f"keyframes cannot be kept in {self.directory}: {error.strerror}") from error
        self._files[key], self._bytes[key] = path, size
        self._number += 1
        self._remove_acknowledged()

    def get(self, key: Key) -> list[Part]:
        """The parts as they were put in. Raises OSError or ValueError where the disk has lost them."""
        return read_message(self._files[key], self.config.max_mb << 20)

    def remove(self, key: Key) -> None:
        """Removes an acknowledged message. Nothing happens where it is gone already."""
        path = self._files.pop(key, None)
        self._bytes.pop(key, None)
        if path is not None:
            self._acknowledged.append(path)
            self._remove_acknowledged()

    def move_to_quarantine(self, key: Key, name: str, reason: str) -> None:
        """Moves the message that carries the frame `name` to the quarantine: it is not delivered any more."""
        self._bytes.pop(key)
        self.quarantine.take(self._files.pop(key), name, reason)

    def _remove_acknowledged(self) -> None:
        """Removes acknowledged keyframes. One that the disk keeps is removed later; after a restart it comes again."""
        while self._acknowledged:
            try:
                self._acknowledged[-1].unlink(missing_ok=True)
            except OSError as error:
                log.debug("an acknowledged keyframe cannot be removed: %s", error)
                return
            self._acknowledged.pop()

    def _take_over(self, path: Path) -> None:
        _, session, sequence = path.stem.split("-")
        key = Key(session, int(sequence))
        if key in self._files:  # the older one is sent
            log.warning("left alone a copy of a keyframe: %s", path)
            return
        try:
            read_message(path, self.config.max_mb << 20)
            size = path.stat().st_size
        except StrayFile as error:
            log.warning("left alone: %s (spool.max_mb)", error)
        except (OSError, MessageFileError) as error:
            raise_shortage(error)
            log.error("put aside a damaged keyframe: %s", error)
            self.quarantine.take(path, "?", f"damaged on the disk: {error}")
        else:
            self._files[key], self._bytes[key] = path, size


def _number(path: Path) -> int:
    return int(path.name.split("-")[0])


def spool_directory(config: SpoolConfig, camera_id: str = "") -> Path:
    return (config.directory or state_directory()) / _name("spool", camera_id)


def _name(folder: str, camera_id: str) -> str:
    return f"{folder}-{camera_id}" if camera_id else folder
