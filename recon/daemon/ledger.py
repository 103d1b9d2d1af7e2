"""The ledger of a checkpoint: where its submap begins, and which frames are no longer stored."""

from __future__ import annotations

import logging
import os
import re
import shutil
import uuid
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from splatnode.capture.frame import Frame
from splatnode.capture.messaging.keyframe_queue import read_message, write_message
from splatnode.capture.messaging.messages import (
    Limits,
    Message,
    SessionId,
    StoredFrameMeta,
    WireError,
    arrays_of,
    decode,
    describe_stored_frame,
    encode,
    frame_in,
)
from splatnode.capture.process.files import make_owner_only_folder, remove_leftovers, sync_folder
from splatnode.capture.process.system import raise_shortage

log = logging.getLogger(__name__)

# Of a checkpoint's files: 1 knew no time of capture, 2 no split submaps, 3 no masks, 4 no fisheyes, 5 neither given
# poses nor lenses that were estimated, 6 one radial coefficient of a lens, 7 nothing brighter than white, 8 no frames
# that were stored together.
VERSION = 9
LEDGER_FILE = "ledger"
# Of what this process wrote itself.
LIMITS = Limits(header_bytes=64 << 20, arrays=1 << 20, total_bytes=4 << 30, own=True)


class CheckpointError(ValueError):
    """The checkpoint cannot be used; the text says what to do."""


class Ledger(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    version: int = VERSION
    number: int = msgspec.field(default=1, name="place")  # of the active submap, from 1
    first: int = 0  # number of the active submap's first frame
    next: int = 0  # at least this is the number of the next frame
    gone: tuple[tuple[str, int], ...] = ()  # session and sequence of frames that are no longer stored
    dropped: tuple[tuple[str, str], ...] = ()  # name and reason, newest last
    identity: SessionId | None = None  # of this checkpoint, for whoever sends keyframes to it
    follows: str = ""  # the scene that the present one goes on from; empty: it began anew
    shared: tuple[str, ...] = ()  # names of the frames that both have
    part: int = 0  # of a submap that turned out to be several: number of its first frame, from 1; 0: no part
    retracted: tuple[tuple[str, str], ...] = ()  # scene and name of frames that inactive submaps are to lose

    @property
    def scene_id(self) -> str:
        """The id of the active submap's scene."""
        return f"scene-{self.number:04d}" + (f"-{self.part}" if self.part else "")


def read_ledger(directory: Path) -> Ledger:
    """An empty one where there is none yet. Raises CheckpointError."""
    try:
        found = decode(read_message(directory / LEDGER_FILE), Ledger, LIMITS).header
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
    write_message(directory / LEDGER_FILE, encode(ledger))


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


# Inactive submaps, each a checkpoint of its own: left/scene-NNNN while its scene is not final yet.
#
# What turns out to show another place than the rest becomes left/scene-NNNN-M: M is its first frame's number, from 1.
# A folder counts from the moment when it has a ledger, and no longer once it has none. One whose scene is final is
# finished/scene-NNNN: by what it holds a submap is recognised when the camera comes back.

LEFT, FINISHED = "left", "finished"


def link_left_checkpoint(directory: Path, ledger: Ledger, files: Iterable[str], instead: str) -> None:
    """Links `files` of the checkpoint in `directory`, which go with `ledger`, into a folder of their own there.

    `files` are relative paths. Raises OSError, and NotOwnerOnly, which names what to set `instead`.
    """
    _link_files(directory, directory / LEFT / ledger.scene_id, ledger, files, instead)


def link_split_checkpoint(folder: Path, ledger: Ledger, files: Iterable[str], instead: str, present: bool) -> None:
    """Links `files` of a submap, in `folder`, into a folder of their own among those that were left, as
    `link_left_checkpoint` does.

    `present`: it is the active submap, else an inactive one. A part that is there already, from a process
    that did not get any further, stays as it is.
    """
    target = folder / LEFT / ledger.scene_id if present else folder.with_name(ledger.scene_id)
    if not (target / LEDGER_FILE).exists():
        _link_files(folder, target, ledger, files, instead)


def _link_files(source: Path, target: Path, ledger: Ledger, files: Iterable[str], instead: str) -> None:
    remove_left_checkpoint(target)
    for each in (target.parent, target, target / "frames"):
        make_owner_only_folder(each, instead, ours=True)
    for name in files:
        os.link(source / name, target / name)
    sync_folder(target / "frames")
    write_ledger(target, ledger)


def list_left_folders(directory: Path) -> list[Path]:
    """Lists the folders of the inactive submaps, oldest first."""
    return sorted((path.parent for path in (directory / LEFT).glob(f"scene-*/{LEDGER_FILE}")), key=_parse_place_number)


def make_finished_path(directory: Path, scene_id: str) -> Path:
    """Returns the path of a finished scene's checkpoint, if there is one."""
    return directory / FINISHED / scene_id


def find_folder(directory: Path, scene_id: str) -> Path:
    """Returns the path of an inactive submap's checkpoint, finished or not, if there is one."""
    folder = make_finished_path(directory, scene_id)
    return folder if (folder / LEDGER_FILE).exists() else directory / LEFT / scene_id


def list_finished_folders(directory: Path) -> list[Path]:
    """The folders of the finished scenes, oldest first."""
    return sorted(
        (path.parent for path in (directory / FINISHED).glob(f"scene-*/{LEDGER_FILE}")), key=_parse_place_number
    )


def move_to_finished(folder: Path, instead: str) -> None:
    """Moves the checkpoint of an inactive submap to the finished ones.

    Raises OSError, and NotOwnerOnly as `link_left_checkpoint`.
    """
    target = make_finished_path(folder.parent.parent, folder.name)
    make_owner_only_folder(target.parent, instead, ours=True)
    remove_left_checkpoint(target)
    folder.rename(target)
    sync_folder(target.parent)


def reopen(directory: Path, scene_id: str) -> Path | None:
    """The folder of an inactive submap, moved back from the finished ones if it is there; None where there is none.

    Raises OSError.
    """
    folder, target = make_finished_path(directory, scene_id), directory / LEFT / scene_id
    if (folder / LEDGER_FILE).exists() and not (target / LEDGER_FILE).exists():
        folder.rename(target)
        sync_folder(target.parent)
    return target if (target / LEDGER_FILE).exists() else None


def remove_left_checkpoint(folder: Path) -> None:
    """Removes the checkpoint of an inactive submap. What the disk keeps of it, the next start removes."""
    (folder / LEDGER_FILE).unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)


def remove_incomplete(directory: Path, active: int) -> None:
    """Removes half-written files, and folders of submaps that are not inactive yet, `active` among them, or removed.

    A part of `active` stays: it is a submap of its own from the moment when its folder has a ledger.
    """
    for folder in (directory / LEFT).glob("scene-*"):
        number, *part = _parse_place_number(folder)
        if number > active or (number == active and not part) or not (folder / LEDGER_FILE).exists():
            remove_left_checkpoint(folder)
    for folder in (*list_left_folders(directory), *list_finished_folders(directory)):
        remove_leftovers(folder)


def _parse_place_number(folder: Path) -> tuple[int, ...]:
    """Returns the number of the submap, and of the part of it; 0 for what is no number."""
    return tuple(int(each) if each.isdecimal() else 0 for each in folder.name.removeprefix("scene-").split("-"))


# The files of a checkpoint that can be made anew from its keyframes: where one is missing or damaged, it is.


MADE_ANEW = ("graph", "judgement", "fallbacks", "scene", "pointmaps")
SHOWN = ("scene", "pointmaps")  # those of them that only a scene that grows has need of


def save(directory: Path, name: str, header: msgspec.Struct, arrays: list[Any]) -> None:
    """Whole or not at all. Raises OSError."""
    write_message(directory / name, encode(header, arrays))


def load(directory: Path, name: str, schema: Any) -> Message[Any] | None:
    """Loads what `save` wrote under this name; None where it is missing or damaged."""
    try:
        return decode(read_message(directory / name), schema, LIMITS)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise_shortage(error)
        log.warning("%s of the checkpoint is made anew: %s", name, error)
        return None


def remove_rebuild_requests(directory: Path, *names: str) -> None:
    """Raises OSError."""
    for name in names:
        (directory / name).unlink(missing_ok=True)


# A keyframe of a checkpoint, in a file of its own: frames/<number>.frame.

FRAME_FILE = re.compile(r"[0-9]{12,18}\.frame")


class FrameRecord(StoredFrameMeta, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A stored keyframe; its arrays are its image and, where it has these, its mask, right image and depth image."""

    version: int
    session: str
    sequence: int
    following: int = 0  # so many frames after it were stored together with it


@dataclass(frozen=True, eq=False)
class StoredFrame:
    number: int
    key: tuple[str, int]  # session and sequence
    frame: Frame  # its frame_id is the number
    following: int = 0  # so many frames after it were stored together with it


def file_name(number: int) -> str:
    return f"{number:012d}.frame"


def write_frame(path: Path, key: tuple[str, int], frame: Frame, following: int = 0) -> None:
    """Whole or not at all; `key` is its session and sequence. Raises OSError.

    `following`: so many frames that are stored together with it have the numbers after its own.
    """
    session, sequence = key
    header = FrameRecord(
        version=VERSION, session=session, sequence=sequence, following=following, **describe_stored_frame(frame)
    )
    write_message(path, encode(header, arrays_of(frame)))


def read_frame(path: Path) -> StoredFrame:
    """The keyframe in a file that is named by its number. Raises OSError and ValueError."""
    number, message = int(path.stem), decode(read_message(path), FrameRecord, LIMITS)
    header = message.header
    if not is_readable(header.version):
        raise WireError(f"frame {number} is of version {header.version}")
    frame = frame_in(header, number, message.arrays)
    return StoredFrame(number, (header.session, header.sequence), frame, header.following)
