"""Keyframes from capture to recon, none of which is lost once it is offered.

    capture                                      recon
      offer: to the spool on disk     <------    Ready(capacity, holding, limits): at start and every half second
      which recon is served           ------>    Served(served, limits)
      send while there is capacity    ------>    receive: each frame once
                                                 checkpoint
      remove from the spool           <------    Acknowledge(session, sequence)
      move to the quarantine          <------    Refuse(session, sequence, reason): what it cannot take, now or later

Either process may die at any moment. A frame without an answer stays in the spool and is sent to the next connection
that is ready and does not hold it. An acknowledged one is in recon's checkpoint; if it comes again, because capture
died before it removed it, it is acknowledged again and not delivered. What is larger than recon allows is not sent: it
goes to the quarantine at once. Answers of a recon that is not served (`ConsumerArbiter`) do not count.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import re
import struct
import time
import uuid
import zlib
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import msgspec
import zmq

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.messaging.messages import (
    DELIVERY_PARTS,
    MAGIC,
    VERSION,
    Acknowledge,
    ConsumerStatus,
    Delivery,
    Key,
    Name,
    Numbering,
    Part,
    Ready,
    ReceivedFrame,
    Refuse,
    Request,
    Text,
    WireError,
    add_delivery,
    check,
    decode,
    decode_frame,
    encode,
    encode_frame,
    name_in,
    size_bytes,
)
from splatnode.capture.messaging.network import CAPTURE_KEYFRAMES, REQUEST_LIMITS, Endpoint, Network
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
from splatnode.capture.process.system import is_shortage, may_be_shortage, raise_shortage
from splatnode.capture.process.text import LONGEST_NAME, LONGEST_TEXT, guard_untrusted, sanitize_text

# Keyframes on disk until recon has answered them: bounded, oldest first, whole or not there.
#
# The name of a message's file gives the order, which is kept from one process to the next: what a killed process left
# is delivered before what its successor adds. What recon refuses, and what the disk damaged, goes to the quarantine
# beside it.

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
        """Goes on with what lies in the directory. Raises OSError where it cannot be made, NotOwnerOnly."""
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


class Spool:
    """Survives its process: what was put in is there until it is removed. One process at a time uses a directory."""

    def __init__(self, config: SpoolConfig, camera_id: str = "") -> None:
        """Takes over what lies in the directory; what is damaged is put aside. Raises OSError, LockHeld, NotOwnerOnly.

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


# Which recon gets capture's keyframes: one at a time, for each frame is given away once.
#
# The one that is served stays until it has been silent for a while. Its own next process takes over at once: both have
# the id of their checkpoint. Of two processes with one id, which are a checkpoint and its copy, the later one stays.

SILENT_S = 5.0  # after which another recon is served; one that lives asks twice a second
FORGET_S = 20.0  # without a request, a connection counts as gone
MOST_CONNECTIONS = 64
_ENDED = 16  # processes whose successor has come


@dataclass
class Connection:
    """One connection. What was sent over it arrives, or the connection ends."""

    identity: bytes
    recon: str
    process: str
    heard_s: float  # monotonic
    capacity: int = 0
    message_bytes: int = 0
    outstanding: set[Key] = field(default_factory=set)  # sent or held, neither acknowledged nor refused


class ConsumerArbiter:
    """The connections, and which of them is served."""

    def __init__(self) -> None:
        self._connections: dict[bytes, Connection] = {}
        self._served: Connection | None = None
        self._ended: deque[str] = deque(maxlen=_ENDED)

    @property
    def active(self) -> Connection | None:
        return self._served

    @property
    def num_rejected(self) -> int:
        """Recons that ask and are not served."""
        return len({each.process for each in self._connections.values() if not self._is_active(each)})

    def is_active(self, identity: bytes) -> bool:
        return self._served is not None and self._served.identity == identity

    def handle_ready(self, identity: bytes, request: Ready, spooled: Collection[Key], now_s: float) -> bool:
        """A recon asks for keyframes: whether it gets them."""
        known = self._connections.get(identity)
        if known is None and len(self._connections) >= MOST_CONNECTIONS:
            self.remove_connection(min(self._connections.values(), key=self._eviction_rank).identity)
        asking = known or Connection(identity, request.recon, request.process, now_s)
        self._connections[identity] = asking
        asking.recon, asking.process, asking.heard_s = request.recon, request.process, now_s
        asking.capacity, asking.message_bytes = request.capacity, request.message_bytes
        asking.outstanding |= {key for pair in request.holding if (key := Key(*pair)) in spooled}
        if self._takes_over(asking, now_s):
            before, self._served = self._served, asking
            if before is not None and before.process != asking.process:
                self._handle_takeover(before, asking)
        return self._served is asking

    def record_keep_alive(self, identity: bytes, now_s: float) -> None:
        """The connection has said something."""
        if identity in self._connections:
            self._connections[identity].heard_s = now_s

    def mark_answered(self, key: Key) -> None:
        """The frame is no longer on its way."""
        for each in self._connections.values():
            each.outstanding.discard(key)

    def forget_silent(self, now_s: float) -> None:
        for identity in [name for name, each in self._connections.items() if now_s - each.heard_s > FORGET_S]:
            self.remove_connection(identity)

    def remove_connection(self, identity: bytes) -> None:
        """The connection has ended."""
        self._connections.pop(identity, None)
        if self.is_active(identity):
            self._served = None

    def _handle_takeover(self, before: Connection, after: Connection) -> None:
        """Another process is served now. One with the same checkpoint has ended: if it is a copy, it asks again."""
        self._ended.append(before.process)
        if before.recon == after.recon:
            for identity in [name for name, each in self._connections.items() if each.process == before.process]:
                self.remove_connection(identity)

    def _eviction_rank(self, connection: Connection) -> tuple[bool, float]:
        """The least goes where there are too many, so that nobody can keep others out by asking often."""
        return self.is_active(connection.identity), connection.heard_s

    def _is_active(self, connection: Connection) -> bool:
        return self._served is not None and self._served.process == connection.process

    def _takes_over(self, asking: Connection, now_s: float) -> bool:
        served = self._served
        if served is None or served is asking:
            return True
        if now_s - served.heard_s > SILENT_S or served.process == asking.process:
            return True
        return served.recon == asking.recon and asking.process not in self._ended


READY_EVERY_S = 0.5
REMEMBERED = 10_000  # acknowledged frames that recon recognises if they come again
REMEMBERED_REFUSED = 1000
QUEUE = 64  # messages in a socket; as many as a client may hold (Ready.capacity)
MAX_REQUESTS = 1000  # that one call of `serve` reads


class KeyframeServer(Endpoint):
    """Capture's end: sends what lies in the spool until it is answered."""

    def __init__(self, network: Network, spool: Spool, camera_id: str = "") -> None:
        """Takes the spool over and closes it; `camera_id` is of a capture beside others. Raises AlreadyRunning where
        another process offers its keyframes.
        """
        with contextlib.ExitStack() as taken:
            taken.callback(spool.close)
            service = CAPTURE_KEYFRAMES.select_capture(camera_id)
            super().__init__(network, offers=service)
            self._resources.push(taken.pop_all())
        self.spool = spool
        self.numbering = Numbering()
        self.acknowledged = 0
        self.set_aside = 0  # by this process
        self.ignored = 0  # answers of recons that are not served
        self._turns = ConsumerArbiter()
        self._router = self._bind(service, zmq.ROUTER, queue=QUEUE)
        self._router.router_mandatory = True  # a connection that is gone says so

    @property
    def num_queued(self) -> int:
        """Frames that nobody has answered."""
        return len(self.spool)

    @property
    def is_connected(self) -> bool:
        return self._turns.active is not None

    @property
    def num_rejected_consumers(self) -> int:
        """Recons that ask for keyframes while another one is served."""
        return self._turns.num_rejected

    def offer(self, frame: Frame | DroppedFrame) -> Key:
        """Takes the frame over: on the disk when this returns. Raises SpoolFull, OSError, WireError (too large)."""
        message = encode_frame(frame, self.numbering)
        if size_bytes(message) > self.network.limits.total_bytes:
            raise WireError(f"{frame.name}: {size_bytes(message) >> 20} MB; network.max_message_mb allows less")
        key = Key(self.numbering.session, self.numbering.sequence - 1)
        self.spool.store(key, message)
        self._send_due()
        return key

    def serve(self, timeout_s: float) -> None:
        """Handles the requests that came, waiting at most `timeout_s` for the first."""
        what = "a request for keyframes"
        for identity, request in self._receive_requests(self._router, Request, what, MAX_REQUESTS, timeout_s):
            self._handle(identity, request)
        self._turns.forget_silent(time.monotonic())
        self._send_due()

    def _handle(self, identity: bytes, request: Request) -> None:
        now_s = time.monotonic()
        if isinstance(request, Ready):
            served = self._turns.handle_ready(identity, request, self.spool, now_s)
            self._say(identity, encode(ConsumerStatus(served, self.network.limits.total_bytes)))
            return
        self._turns.record_keep_alive(identity, now_s)
        if not self._turns.is_active(identity):
            self.ignored += 1
            return
        key = Key(request.session, request.sequence)
        if key not in self.spool:
            return
        if isinstance(request, Refuse):
            self._quarantine_frame(key, f"refused by recon: {request.reason}")
            return
        self.spool.remove(key)
        self.acknowledged += 1
        self._turns.mark_answered(key)

    def _quarantine_frame(self, key: Key, reason: str, parts: list[Part] | None = None) -> None:
        """Takes the frame out of the queue for good; says once which one it is, and why."""
        try:
            parts = parts or self.spool.get(key)
            name = name_in(parts)
        except (OSError, ValueError):  # for whatever reason: without its name it is set aside all the same
            name = "?"
        log.warning("set aside %s: %s", name, reason)
        self.spool.move_to_quarantine(key, name, reason)
        self.set_aside += 1
        self._turns.mark_answered(key)

    def _send_due(self) -> None:
        client = self._turns.active
        if client is None:
            return
        for key in self.spool:
            if len(client.outstanding) >= client.capacity:
                break
            if key not in client.outstanding and not self._send(client, key):
                break

    def _send(self, client: Connection, key: Key) -> bool:
        """False where this client cannot take more now."""
        try:
            parts = self.spool.get(key)
        except (OSError, ValueError, MemoryError) as error:
            if is_shortage(error):  # no fault of the keyframe, which waits
                return False
            self._quarantine_frame(key, f"lost on the disk: {error}")
            return True
        size = size_bytes(parts)
        if size > client.message_bytes:
            allowed = f"{client.message_bytes / 1e6:.1f} MB; raise network.max_message_mb there"
            self._quarantine_frame(key, f"it has {size / 1e6:.1f} MB, and recon takes at most {allowed}", parts)
            return True
        if not self._say(client.identity, add_delivery(key, parts)):
            return False
        client.outstanding.add(key)
        return True

    def _say(self, identity: bytes, parts: list[Part]) -> bool:
        """Sends a message; returns whether it could be sent."""
        try:
            self._router.send_multipart([identity, *parts], zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return False
        except zmq.ZMQError:  # that connection has ended
            self._turns.remove_connection(identity)
            return False
        return True


class KeyframeClient(Endpoint):
    """Recon's end: receives each keyframe once, and acknowledges or refuses it."""

    def __init__(
        self,
        network: Network,
        seen: Iterable[tuple[str, int]] = (),
        capacity: int = 4,
        recon: str | None = None,
        camera_id: str = "",
    ) -> None:
        """`seen`: what the checkpoint holds, whose id is `recon`. `capacity`: frames that may be here unanswered.

        `camera_id`: of the capture beside others that it is connected to.
        """
        super().__init__(network)
        self.capacity = capacity
        self.duplicates = 0
        self.served: bool | None = None  # whether capture sends its keyframes here; None before it says so
        self._recon, self._process = recon or uuid.uuid4().hex, uuid.uuid4().hex
        self._held: dict[Key, None] = {}  # delivered, not answered
        self._seen: dict[Key, None] = dict.fromkeys(Key(*pair) for pair in seen)
        self._refused: dict[Key, str] = {}  # and why
        self._received: deque[ReceivedFrame] = deque()
        self._ready_said = -math.inf
        self._dealer = self._connect(CAPTURE_KEYFRAMES.select_capture(camera_id), zmq.DEALER, queue=QUEUE)

    def receive(self, timeout_s: float) -> ReceivedFrame | None:
        """The next frame, oldest first, each once; None where none comes in `timeout_s`. Raises NotAllowed."""
        deadline = time.monotonic() + timeout_s
        while True:
            self._check_links()
            self.say_ready()
            self._receive_all()
            if self._received:
                return self._received.popleft()
            remaining = deadline - time.monotonic()
            if remaining <= 0:
                return None
            self._dealer.poll(math.ceil(1000 * min(remaining, READY_EVERY_S)))

    def register(self, poller: zmq.Poller) -> None:
        """Lets the poller wake up when something comes."""
        poller.register(self._dealer, zmq.POLLIN)

    def acknowledge(self, frame: ReceivedFrame) -> None:
        """To be called once the frame is on the disk, so that it survives this process."""
        self._held.pop(frame.key, None)
        _remember(self._seen, frame.key, None, REMEMBERED)
        self._say(Acknowledge(*frame.key))

    def refuse(self, key: Key, reason: str) -> None:
        """To be called where the frame cannot be taken, now or later: capture sets it aside."""
        self._held.pop(key, None)
        _remember(self._refused, key, sanitize_text(reason, LONGEST_TEXT), REMEMBERED_REFUSED)
        self._refuse("a keyframe", reason)
        self._say(Refuse(*key, self._refused[key]))

    def say_ready(self) -> None:
        """Says that this recon lives, when that is due. To be called where handling a frame takes seconds."""
        if time.monotonic() - self._ready_said < READY_EVERY_S:
            return
        self._ready_said = time.monotonic()
        held = [(key.session, key.sequence) for key in self._held]
        self._say(Ready(self._recon, self._process, self.capacity, held, self.network.limits.total_bytes))

    def _receive_all(self) -> None:
        for _ in range(self.capacity + 2):
            try:
                parts = self._dealer.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            try:
                first = decode(parts[:DELIVERY_PARTS], Delivery | ConsumerStatus, REQUEST_LIMITS).header
            except WireError as error:  # it does not say which frame it is, if it is one
                self._refuse("a keyframe without a number", error)
                continue
            if isinstance(first, Delivery):
                self._take(Key(first.session, first.sequence), parts[DELIVERY_PARTS:])
            else:
                self._update_status(first)

    def _take(self, key: Key, parts: list[zmq.Frame]) -> None:
        if key in self._seen:
            self.duplicates += 1
            self._say(Acknowledge(*key))
        elif key in self._refused:
            self._say(Refuse(*key, self._refused[key]))
        elif key not in self._held:
            try:
                frame = decode_frame(key, parts, self.network.limits)
            except WireError as error:
                if may_be_shortage(error):  # the connection is made anew, and the frame comes again
                    raise
                self.refuse(key, str(error))
            else:
                self._held[key] = None
                self._received.append(frame)

    def _update_status(self, answer: ConsumerStatus) -> None:
        """Updates the consumer status: where another recon is active, the keyframes that wait here are its."""
        self.served = answer.served
        if not answer.served:
            self._received.clear()
            self._held.clear()

    def _say(self, request: Request) -> None:
        """Sends a request. Where an answer to a frame cannot be sent, the frame comes again and is recognised."""
        try:
            self._dealer.send_multipart(encode(request), zmq.NOBLOCK)
        except zmq.Again:
            log.debug("capture is not there")


def _remember(known: dict, key: Key, value: str | None, most: int) -> None:
    known[key] = value
    while len(known) > most:
        del known[next(iter(known))]
