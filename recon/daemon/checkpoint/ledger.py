"""The ledger of a checkpoint: where its place begins, and which frames are no longer stored."""

from __future__ import annotations

import logging
import uuid
from pathlib import Path

import msgspec

from splatnode.capture.messaging.message_file import read_message, write_message
from splatnode.capture.messaging.values import SessionId
from splatnode.capture.messaging.wire import Limits, decode, encode
from splatnode.capture.process.memory_shortage import raise_shortage

log = logging.getLogger(__name__)

# Of a checkpoint's files: 1 knew no time of capture, 2 no parts of places, 3 no masks, 4 no fisheyes, 5 neither given
# poses nor lenses that were estimated, 6 one radial coefficient of a lens, 7 nothing brighter than white.
VERSION = 8
FILE = "ledger"
# Of what this process wrote itself.
LIMITS = Limits(header_bytes=64 << 20, arrays=1 << 20, total_bytes=4 << 30, own=True)


class CheckpointError(ValueError):
    """The checkpoint cannot be used; the text says what to do."""


class Ledger(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    version: int = VERSION
    place: int = 1  # number of the present place, from 1
    first: int = 0  # number of the present place's first frame
    next: int = 0  # at least this is the number of the next frame
    gone: tuple[tuple[str, int], ...] = ()  # session and sequence of frames that are no longer stored
    dropped: tuple[tuple[str, str], ...] = ()  # name and reason, newest last
    identity: SessionId | None = None  # of this checkpoint, for whoever sends keyframes to it
    follows: str = ""  # the scene that the present one goes on from; empty: it began anew
    shared: tuple[str, ...] = ()  # names of the frames that both have
    part: int = 0  # of a place that turned out to be several: number of its first frame, from 1; 0: no part
    retracted: tuple[tuple[str, str], ...] = ()  # scene and name of frames that places that were left are to lose

    @property
    def scene_id(self) -> str:
        """The id of the active submap's scene."""
        return f"scene-{self.place:04d}" + (f"-{self.part}" if self.part else "")


def read_ledger(directory: Path) -> Ledger:
    """An empty one where there is none yet. Raises CheckpointError."""
    try:
        found = decode(read_message(directory / FILE), Ledger, LIMITS).header
    except FileNotFoundError:
        return Ledger()
    except (OSError, ValueError) as error:
        raise_shortage(error)
        raise CheckpointError(
            f"the checkpoint in {directory} is damaged ({error}). Move the folder away to begin anew; "
            "its keyframes are in frames/"
        ) from error
    if not is_readable(found.version):
        raise CheckpointError(
            f"the checkpoint in {directory} is of version {found.version}, this is version {VERSION}. "
            "Use the splatnode that wrote it, or move the folder away to begin anew"
        )
    return found


def is_readable(version: int) -> bool:
    """Whether files of a checkpoint of this version can be read: what earlier ones lack has a default."""
    return 1 <= version <= VERSION


def write_ledger(directory: Path, ledger: Ledger) -> None:
    """Whole or not at all. Raises OSError."""
    write_message(directory / FILE, encode(ledger))


def ensure_identity(directory: Path) -> Ledger:
    """The ledger with the checkpoint's identity, which it is given where it has none. Raises CheckpointError.

    It is of this version from now on, so that an earlier splatnode leaves alone what it could not read.
    """
    found = read_ledger(directory)
    ledger = msgspec.structs.replace(found, version=VERSION, identity=found.identity or uuid.uuid4().hex)
    if ledger == found:
        return found
    try:
        write_ledger(directory, ledger)
    except OSError as error:
        log.warning("the checkpoint's identity and version are this process's alone: %s", error)
    return ledger
