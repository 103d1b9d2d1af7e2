"""The checkpoint: all that a daemon needs to continue after it was killed.

    ledger              where the present place begins, and which frames are no longer stored
    frames/<number>     a keyframe as it came; numbers count all keyframes that ever came
    graph               features and matches
    judgement           the cameras that they lead to, the evidence and the verdict
    fallbacks           what was tried for want of matches, and gained nothing: it is not tried again
    scene               cameras and Gaussians as they are shown
    pointmaps           depth maps of its views, from which it grows
    left/<place>/       a place that was left and whose scene is not final yet: a checkpoint of its own
    finished/<place>/   one whose scene is final: frames, graph and judgement
    codes               in the folder of a place that was left: that it is judged, and by what it is recognised

Graph, judgement, fallbacks, scene and pointmaps are computed again where they are missing. A keyframe is acknowledged
once its file is there. Every file is whole or not there, and has a checksum. A place is what one scene shows.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import threading
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.messaging.keyframe_messages import ReceivedFrame
from splatnode.capture.messaging.wire import Message
from splatnode.capture.process.durable import remove_leftovers
from splatnode.capture.process.lock import LockHeld, exclusive
from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.capture.process.printable import LONGEST_NAME, sanitize_text
from splatnode.capture.process.private import list_own_files, make_owner_only_folder
from splatnode.recon.daemon.checkpoint import left, made_anew
from splatnode.recon.daemon.checkpoint.ledger import CheckpointError, Ledger, ensure_identity, write_ledger
from splatnode.recon.daemon.checkpoint.made_anew import MADE_ANEW
from splatnode.recon.daemon.checkpoint.stored_frame import FILE, StoredFrame, file_name, read_frame, write_frame

log = logging.getLogger(__name__)

REMEMBERED = 1000  # removed frames that are recognised if their sender missed the acknowledgement
REMEMBERED_DROPPED = 1000  # names and reasons, of a place
_INSTEAD = "--checkpoint (or $XDG_STATE_HOME)"


class Store:
    """Reads and writes a checkpoint, from any thread. One process at a time uses a directory."""

    def __init__(self, directory: Path) -> None:
        """Raises CheckpointError where another process uses it, or where it is of another version or damaged.

        Raises NotPrivate where another user could read or change it, and OSError.
        """
        self.directory = directory
        self._frames = directory / "frames"
        make_owner_only_folder(directory, _INSTEAD, ours=(directory / "ledger").is_file() or self._frames.is_dir())
        make_owner_only_folder(self._frames, _INSTEAD, ours=True)
        self._resources = contextlib.ExitStack()
        try:
            self._resources.enter_context(exclusive(directory / "lock"))
        except LockHeld as error:
            raise CheckpointError(
                f"another process uses the checkpoint in {directory}; stop it, or give another --checkpoint"
            ) from error
        remove_leftovers(directory)
        remove_leftovers(self._frames)
        self.ledger = ensure_identity(directory)
        left.remove_incomplete(directory, self.ledger.place)
        self._keys: dict[int, tuple[str, int]] = {}
        self._names: dict[str, int] = {}
        self._next = self.ledger.next
        self._writing = threading.RLock()
        self._found = deque(self._read_frames())

    def close(self) -> None:
        self._resources.close()

    @property
    def scene_id(self) -> str:
        return self.ledger.scene_id

    @property
    def identity(self) -> str:
        """The identity of this checkpoint: 32 hexadecimal digits that never change."""
        return self.ledger.identity or ""

    @property
    def names(self) -> set[str]:
        """The names of the stored frames."""
        return set(self._names)

    def names_before(self, number: int) -> set[str]:
        """Returns the names of the stored frames that came before frame `number`."""
        names = self._names.copy()  # at once: another thread may store a frame meanwhile
        return {name for name, each in names.items() if each < number}

    def holds(self, frame: Frame) -> bool:
        """Whether this very frame, and no other of its name, is stored."""
        return self._names.get(frame.name) == frame.frame_id

    @property
    def frames_dropped(self) -> list[DroppedFrame]:
        return [DroppedFrame(*entry) for entry in self.ledger.dropped]

    @property
    def frame_keys(self) -> list[tuple[str, int]]:
        """Session and sequence of the frames that were taken, which need not be sent again."""
        return [*self.ledger.gone, *self._keys.values()]

    def frames(self) -> Iterator[StoredFrame]:
        """The present place's frames that an earlier process stored, oldest first; each is returned once."""
        while self._found:
            yield self._found.popleft()

    def _read_frames(self) -> Iterator[StoredFrame]:
        """The stored frames; a damaged one is renamed and logged, one that is there already left alone."""
        for path in list_own_files(self._frames, FILE, ".frame"):
            number = int(path.stem)
            try:
                self._next = max(self._next, number + 1)
                stored = read_frame(path) if number >= self.ledger.first else None
                if stored is None or stored.key in self.ledger.gone:  # its removal did not come to its end
                    self._remove(number)
                    continue
            except (OSError, ValueError) as error:
                raise_shortage(error)
                log.error("a keyframe is lost on the disk, put aside: %s", error)
                path.rename(path.with_suffix(".damaged"))
                continue
            if stored.key in self._keys.values() or stored.frame.name in self._names:
                log.warning("left alone a copy of keyframe %s: %s", stored.frame.name, path)
                continue
            self._remember(stored)
            yield stored

    def add_frame(self, received: ReceivedFrame) -> StoredFrame | None:
        """Returns when the frame is on the disk, under a name that no other has; None for one that was dropped.

        Raises OSError where the disk does not take it.
        """
        key, frame = (received.session, received.sequence), received.frame
        with self._writing:
            if isinstance(frame, DroppedFrame):
                self._drop_frame({}, key, (frame.name, frame.reason))
                return None
            number = self._next
            name = self._make_unique_name(frame.name, number)
            write_frame(self._frames / file_name(number), key, replace(frame, name=name))
            stored = StoredFrame(number, key, replace(frame, frame_id=number, name=name, encoded=None))
            self._next = number + 1
            self._remember(stored)
            return stored

    def forget(self, name: str, reason: str) -> None:
        """Removes a frame, if it is there, and records it with the reason as dropped. Raises OSError."""
        with self._writing:
            if name in self._names:
                number = self._names[name]
                self._drop_frame({number: name}, self._keys[number], (name, reason))

    def request_removal(self, name: str, scenes: Iterable[str]) -> None:
        """Records that these scenes, whose places were left, are to lose a frame. Raises OSError."""
        with self._writing:
            retracted = dict.fromkeys((*self.ledger.retracted, *((scene, name) for scene in scenes)))
            self._write(msgspec.structs.replace(self.ledger, retracted=tuple(retracted)))

    def confirm_removal(self, scene: str, name: str) -> None:
        """Records that the scene has lost the frame. Raises OSError."""
        with self._writing:
            retracted = tuple(each for each in self.ledger.retracted if each != (scene, name))
            self._write(msgspec.structs.replace(self.ledger, retracted=retracted))

    def leave_submap(self, first: int, shared: Collection[str] = ()) -> None:
        """Begins another place as `begin_submap` does, and keeps what there is of the present one. Raises OSError.

        `shared` are frames from `first` on that belong to both. A death in between leaves the place as it was.
        """
        with self._writing:
            own = (number for name, number in self._names.items() if number < first or name in shared)
            frames = [f"frames/{file_name(number)}" for number in own]
            made = [name for name in MADE_ANEW if (self.directory / name).exists()]
            ledger = msgspec.structs.replace(self.ledger, next=self._next, gone=(), identity=None, retracted=())
            left.link_left_checkpoint(self.directory, ledger, [*frames, *made], _INSTEAD)
            self.begin_submap(first, shared)

    def split_off(self, names: Collection[str], present: bool = False) -> str:
        """Makes a place of its own of frames of this place, forgets them, and returns its id. Raises OSError.

        It waits among the places that were left. `present`: this place is where the camera is, else it was left, too.
        """
        with self._writing:
            numbers = sorted(self._names[name] for name in names)
            began = {
                "part": numbers[0] + 1,
                "first": numbers[0],
                "gone": (),
                "dropped": (),
                "follows": "",
                "shared": (),
            }
            ledger = msgspec.structs.replace(self.ledger, next=self._next, identity=None, retracted=(), **began)
            frames = [f"frames/{file_name(number)}" for number in numbers]
            left.link_split_checkpoint(self.directory, ledger, frames, _INSTEAD, present)
            for name in names:
                self.forget(name, f"it shows another place: {ledger.scene_id}")
            return ledger.scene_id

    def begin_submap(self, first: int, shared: Collection[str] = ()) -> None:
        """Begins another place with frame `first`; the frames before it and their scene are removed. Raises OSError.

        It goes on from the present one where they have `shared` frames.
        """
        with self._writing:
            # First: what a death leaves of the place before can be made anew, of this one not.
            made_anew.remove(self.directory, *MADE_ANEW)
            before = {number: name for name, number in self._names.items() if number < first}
            gone = (*self.ledger.gone, *(self._keys[number] for number in before))
            place = self.ledger.place + 1
            began = {"place": place, "first": first, "next": self._next, "gone": gone[-REMEMBERED:], "dropped": ()}
            chain = {"follows": self.scene_id if shared else "", "shared": tuple(sorted(shared))}
            self._write(msgspec.structs.replace(self.ledger, **began, **chain))
            self._unlink(before)

    def save(self, name: str, header: msgspec.Struct, arrays: list[Any]) -> None:
        """Writes one of the files that can be made anew. Raises OSError."""
        made_anew.save(self.directory, name, header, arrays)

    def load(self, name: str, schema: Any) -> Message[Any] | None:
        """Loads what `save` wrote under this name; None where it is missing or damaged."""
        return made_anew.load(self.directory, name, schema)

    def remove_scene_files(self) -> None:
        """Removes what only a scene that grows has need of. Raises OSError."""
        made_anew.remove(self.directory, *made_anew.SHOWN)

    def finalize(self) -> None:
        """Takes a place that was left among the finished ones. Nothing is read or written here afterwards.

        Raises OSError.
        """
        left.move_to_finished(self.directory, _INSTEAD)

    def _drop_frame(self, frames: dict[int, str], key: tuple[str, int], dropped: tuple[str, str]) -> None:
        ledger = self.ledger
        shown = sanitize_text(dropped[0], LONGEST_NAME), sanitize_text(dropped[1])
        self._write(
            msgspec.structs.replace(
                ledger,
                next=self._next,
                gone=(*ledger.gone, key)[-REMEMBERED:],
                dropped=(*ledger.dropped, shown)[-REMEMBERED_DROPPED:],
            )
        )
        self._unlink(frames)

    def _unlink(self, frames: dict[int, str]) -> None:
        for number, name in frames.items():
            self._remove(number)
            del self._names[name], self._keys[number]

    def _remove(self, number: int) -> None:
        """The ledger says already that the frame is gone: where the disk keeps the file, the next start removes it."""
        try:
            (self._frames / file_name(number)).unlink(missing_ok=True)
        except OSError as error:
            log.warning("frame %d is gone, but its file cannot be removed now: %s", number, error.strerror)

    def _remember(self, stored: StoredFrame) -> None:
        self._names[stored.frame.name] = stored.number
        self._keys[stored.number] = stored.key

    def _make_unique_name(self, name: str, number: int) -> str:
        """The name, or one made of it that no other frame has."""
        further = (f"{number:06d}-{copy}-{name}" for copy in itertools.count(2))
        names = (each[:LONGEST_NAME] for each in itertools.chain((name, f"{number:06d}-{name}"), further))
        # What is saved of a frame that was dropped may still be on the disk: no other gets its name.
        taken = {*self._names, *(dropped for dropped, _ in self.ledger.dropped)}
        return next(each for each in names if each not in taken)

    def _write(self, ledger: Ledger) -> None:
        write_ledger(self.directory, ledger)
        self.ledger = ledger
