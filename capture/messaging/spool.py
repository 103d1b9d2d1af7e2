"""Keyframes on disk until recon has answered them: bounded, oldest first, whole or not there.

The name of a message's file gives the order, which is kept from one process to the next: what a killed process left is
delivered before what its successor adds. What recon refuses, and what the disk damaged, goes to the quarantine beside
it.
"""

from __future__ import annotations

import contextlib
import logging
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec

from splatnode.capture.messaging import quarantine
from splatnode.capture.messaging.message_file import MessageFileError, read_message, size_in_file, write_message
from splatnode.capture.messaging.wire import Part
from splatnode.capture.process.disk_space import shortage
from splatnode.capture.process.durable import remove_leftovers
from splatnode.capture.process.lock import exclusive
from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.capture.process.private import StrayFile, list_own_files, make_owner_only_folder
from splatnode.capture.process.state_directory import state_directory

log = logging.getLogger(__name__)


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    # None: $STATE_DIRECTORY, else $XDG_STATE_HOME/splatnode, else ~/.local/state/splatnode
    directory: Path | None = None
    # Keyframes that wait for recon; when there are so many, no further one is taken
    max_frames: Annotated[int, msgspec.Meta(ge=1)] = 200
    # Their size, in 2^20 bytes, at which likewise no further one is taken
    max_mb: Annotated[int, msgspec.Meta(ge=1)] = 1024
    quarantine: quarantine.Config = quarantine.Config()  # keyframes that recon refused


_FILE = re.compile(r"[0-9]{12,18}-[0-9a-f]{32}-[0-9]{1,18}\.frame")  # number, session, sequence


class SpoolFull(RuntimeError):
    """No keyframe can be added now: the spool has reached its bound, or the disk does not take it."""


class Key(NamedTuple):
    """Identifies a keyframe: the session of the capture process, and the number in it."""

    session: str
    sequence: int


class Spool:
    """Survives its process: what was put in is there until it is removed. One process at a time uses a directory."""

    def __init__(self, config: Config) -> None:
        """Takes over what lies in the directory; what is damaged is put aside. Raises OSError, Held, NotPrivate."""
        self.config = config
        self.directory = spool_directory(config)
        make_owner_only_folder(self.directory, "spool.directory (or $XDG_STATE_HOME)", ours=True)
        self._resources = contextlib.ExitStack()
        self._resources.enter_context(exclusive(self.directory / "lock"))
        self._files: dict[Key, Path] = {}  # oldest first
        self._bytes: dict[Key, int] = {}
        self._acknowledged: list[Path] = []  # that are still to be removed
        self.quarantine = quarantine.Quarantine(self.directory.with_name("quarantine"), config.quarantine)
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

    def store(self, key: Key, parts: Sequence[Part]) -> None:
        """Returns when the message is on the disk.

        Raises SpoolFull; what is_shortage tells, where another time may do.
        """
        size = size_in_file(parts)
        self._make_sure_of_room(size)
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

    def _make_sure_of_room(self, size: int) -> None:
        if len(self) >= self.config.max_frames or self.size_bytes + size > self.config.max_mb << 20:
            raise SpoolFull(
                f"{len(self)} keyframes ({self.size_bytes >> 20} MB) wait in {self.directory}, which is the bound; "
                "is splatnode recon running?"
            )

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


def spool_directory(config: Config) -> Path:
    return (config.directory or state_directory()) / "spool"
