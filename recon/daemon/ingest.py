"""The thread that receives keyframes: stores, acknowledges, extracts features; it does not wait for the worker.

They come from one capture or several, and as the frame sets of what these send. What cannot be stored because of what
it is, is refused; what the disk does not take is tried again.
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import zmq

from splatnode.capture.frame import Frame, Stamp
from splatnode.capture.messaging.keyframe_queue import READY_EVERY_S, KeyframeClient
from splatnode.capture.messaging.messages import ReceivedFrame
from splatnode.capture.messaging.network import Network, NotAllowed, find_captures
from splatnode.capture.process.system import SHORT_OF_MEMORY, is_shortage
from splatnode.capture.process.terminal import Problems, event, is_logged
from splatnode.capture.rig import TOLERANCE_S, are_taken_together
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon.checkpoint import Store, UnstorableFrame
from splatnode.recon.daemon.ledger import StoredFrame
from splatnode.recon.estimation import prepare
from splatnode.recon.keyframes import Keyframe

log = logging.getLogger(__name__)

LOOK_S = 0.5  # between looks at whether another capture has come
MOST_CAPTURES = 32
CONNECT_S = 1.0  # in which a capture that has been found sends what waits with it
ACTIVE_S = 3.0  # a camera that has sent a keyframe within so many seconds is waited for


class FrameSetConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which keyframes of several cameras belong together."""

    # Between images that were taken together, seconds; None: reconstruction.frame_set_tolerance_s. Higher: cameras that
    # are not triggered together form sets, too
    tolerance_s: Annotated[float, msgspec.Meta(ge=0, le=10)] | None = None
    # A keyframe waits so long for those that other cameras took with it, seconds; where there is one camera, not at all
    wait_s: Annotated[float, msgspec.Meta(ge=0, le=10)] = 0.3


@dataclass(frozen=True, eq=False)
class WaitingFrame:
    """A frame that has come, and who is to get the answer."""

    client: KeyframeClient
    received: ReceivedFrame
    arrived_s: float  # monotonic

    @property
    def camera_id(self) -> str:
        """The id of its camera; empty where it has none, and of what a camera could not give."""
        return self.received.frame.camera_id if isinstance(self.received.frame, Frame) else ""

    @property
    def captured_at(self) -> Stamp | None:
        """When it was taken; None where nobody knows."""
        return self.received.frame.captured_at if isinstance(self.received.frame, Frame) else None

    @property
    def capture_ns(self) -> int:
        """When it was taken, by its clock; 0 where nobody knows."""
        return 0 if self.captured_at is None else self.captured_at.ns


class FrameSetQueue:
    """Frames of all captures in the order of their times, those that were taken together as one."""

    def __init__(self, config: FrameSetConfig) -> None:
        self._wait_s = config.wait_s
        self._tolerance_s = TOLERANCE_S if config.tolerance_s is None else config.tolerance_s
        self._waiting: list[WaitingFrame] = []
        self._heard_s: dict[str, float] = {}  # of each camera, when its last keyframe came
        self._missed: set[str] = set()  # cameras that are not waited for, which was told

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, frame: WaitingFrame) -> None:
        self._waiting.append(frame)
        if frame.camera_id:
            self._heard_s[frame.camera_id] = frame.arrived_s
        if frame.camera_id in self._missed:
            self._missed.discard(frame.camera_id)
            event(log, logging.INFO, "camera_is_back", camera_id=frame.camera_id)

    def take(self, now_s: float, complete: bool = True) -> list[WaitingFrame]:
        """The frames that are next, taken together; none where there are none, or others may still belong to them.

        `complete`: all captures have had time to send what waits with them.
        """
        self._waiting = [each for each in self._waiting if each.client.served is not False]  # now another recon's
        if not self._waiting:
            return []
        alone = next((each for each in self._waiting if not each.camera_id or each.captured_at is None), None)
        first = alone or min(self._waiting, key=lambda each: each.capture_ns)
        is_whole = alone is not None or self._is_whole(now_s)
        if alone is None and not complete:
            return []
        if not is_whole and now_s - first.arrived_s < self._wait_s:
            return []
        found = [first] if alone else self._find_set(first)
        self._tell_missed(now_s)
        self._waiting = [each for each in self._waiting if each not in found]
        return found

    def _is_whole(self, now_s: float) -> bool:
        """Whether a frame of each camera that sends is there: what comes later belongs to none that is before those."""
        active = {camera for camera, heard_s in self._heard_s.items() if now_s - heard_s < ACTIVE_S}
        return active <= {each.camera_id for each in self._waiting}

    def _tell_missed(self, now_s: float) -> None:
        """Tells, once, that frame sets are complete without a camera from which nothing comes any more."""
        silent = {camera for camera, heard_s in self._heard_s.items() if now_s - heard_s >= ACTIVE_S}
        if len(silent) == len(self._heard_s):  # nothing comes from any: the robot stands still
            return
        for camera in sorted(silent - self._missed):
            self._missed.add(camera)
            event(
                log, logging.WARNING, "camera_is_missed", camera_id=camera,
                why=f"no keyframe has come from it for {ACTIVE_S:g} s, and keyframes come from others: frame sets are "
                "complete without it until one comes",
            )  # fmt: skip

    def _find_set(self, first: WaitingFrame) -> list[WaitingFrame]:
        """The first frame, and the earliest of each other camera that was taken with it, in order of time."""
        begun, found = first.captured_at, {first.camera_id: first}
        for each in sorted(self._waiting, key=lambda each: each.capture_ns):
            stamp = each.captured_at
            if begun and stamp and are_taken_together(begun, stamp, self._tolerance_s):
                found.setdefault(each.camera_id, each)
        return sorted(found.values(), key=lambda each: each.capture_ns)


class Captures:
    """The connections to all captures: the one without an id, and each whose sockets lie in the node's folder.

    As a context manager it closes them.
    """

    def __init__(
        self,
        network: Network,
        recon: str,
        seen: Callable[[], Iterable[tuple[str, int]]],
        config: FrameSetConfig,
        further_ports: Iterable[int] = (),
    ) -> None:
        """`further_ports`: over tcp, network.first_port of each further capture. Raises what connecting raises."""
        self._network, self._recon, self._seen = network, recon, seen
        self._clients: dict[tuple[int, str], KeyframeClient] = {}
        self._sets = FrameSetQueue(config)
        self._silent: set[tuple[int, str]] = set()  # captures beside others that have sent nothing yet
        self._resources = contextlib.ExitStack()
        self._poller = zmq.Poller()
        self._next_look_s = -math.inf
        self._opened_s = -math.inf  # when the last capture beside others was found (monotonic)
        try:
            for port in (network.first_port, *further_ports):
                self._open(port, "")
            self._look()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._resources.close()

    def __enter__(self) -> Captures:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def num_refused(self) -> int:
        return sum(client.refused for client in self._clients.values())

    @property
    def why_refused(self) -> str:
        return next((each.why_refused for each in self._clients.values() if each.why_refused), "")

    @property
    def duplicates(self) -> int:
        return sum(client.duplicates for client in self._clients.values())

    @property
    def is_served(self) -> bool | None:
        """Whether all captures that are there send their keyframes here; None before one says so."""
        said = [client.served for client in self._clients.values() if client.served is not None]
        return all(said) if said else None

    def say_ready(self) -> None:
        """Says to all that this recon lives, when that is due."""
        for client in self._clients.values():
            client.say_ready()

    def receive(self, timeout_s: float) -> list[WaitingFrame]:
        """The next frames, taken together; none where none come in `timeout_s`. Raises NotAllowed."""
        deadline = time.monotonic() + timeout_s
        while True:
            if time.monotonic() >= self._next_look_s:
                self._look()
            for key, client in self._clients.items():
                while (received := client.receive(0)) is not None:
                    self._silent.discard(key)
                    self._sets.add(WaitingFrame(client, received, time.monotonic()))
            now_s = time.monotonic()
            if found := self._sets.take(now_s, complete=not self._silent or now_s - self._opened_s > CONNECT_S):
                return found
            remaining = deadline - time.monotonic()
            if remaining <= 0:
                return []
            pause_s = min(remaining, READY_EVERY_S, 0.02 if len(self._sets) else math.inf)
            self._poller.poll(math.ceil(1000 * pause_s))

    def _look(self) -> None:
        """Connects to captures that have come since."""
        self._next_look_s = time.monotonic() + LOOK_S
        for camera_id in find_captures(self._network):
            if len(self._clients) < MOST_CAPTURES:
                self._open(self._network.first_port, camera_id)

    def _open(self, port: int, camera_id: str) -> None:
        if (port, camera_id) in self._clients:
            return
        network = msgspec.structs.replace(self._network, first_port=port)
        client = self._resources.enter_context(
            KeyframeClient(network, self._seen(), recon=self._recon, camera_id=camera_id)
        )
        client.register(self._poller)
        self._clients[port, camera_id] = client
        if camera_id:
            self._opened_s = time.monotonic()
            self._silent.add((port, camera_id))


# The worker's queue: keyframes with their features, and names of frames that were left out, oldest first.

CAPACITY = 32  # events in memory; further keyframes wait with their sender
BATCH = 4  # keyframes that are worked in before the scene is shown again
WAIT_S = 0.1  # between looks at whether the daemon stops


@dataclass(frozen=True, eq=False)
class ArrivedKeyframe:
    """A keyframe that the checkpoint holds."""

    keyframe: Keyframe
    at_s: float  # monotonic
    frame_set: int | None = None  # of keyframes that were taken together, the same number; None: it is alone


@dataclass(frozen=True)
class RemovedFrame:
    """A frame that the checkpoint names as left out, or no longer holds."""

    name: str


Event = ArrivedKeyframe | RemovedFrame


def _do_nothing() -> None:
    """Nobody waits for the one that puts."""


def are_one_set(one: Event, other: Event) -> bool:
    """Whether both are keyframes that were taken together."""
    if not (isinstance(one, ArrivedKeyframe) and isinstance(other, ArrivedKeyframe)):
        return False
    return one.frame_set is not None and one.frame_set == other.frame_set


class Inbox:
    def __init__(self) -> None:
        self._events: deque[Event] = deque()
        self._changed = threading.Condition()

    def __len__(self) -> int:
        return len(self._events)

    @property
    def oldest_s(self) -> float | None:
        """When the keyframe came that waits longest (monotonic); None: none waits."""
        with self._changed:
            return next((each.at_s for each in self._events if isinstance(each, ArrivedKeyframe)), None)

    def enqueue(
        self, events: Sequence[Event], stopping: threading.Event, meanwhile: Callable[[], None] = _do_nothing
    ) -> None:
        """Waits where the inbox is full, until there is room or the daemon stops; calls `meanwhile` again and again.

        None of the events is seen without the others: all go in where one has room.
        """
        with self._changed:
            while len(self._events) >= CAPACITY and not stopping.is_set():
                self._changed.wait(WAIT_S)
                meanwhile()
            self._events.extend(events)
            self._changed.notify_all()

    def enqueue_now(self, *events: RemovedFrame) -> None:
        """Also where the inbox is full: who gives commands does not wait for the work."""
        with self._changed:
            self._events.extend(events)
            self._changed.notify_all()

    def dequeue(self, timeout_s: float) -> list[Event]:
        """The next event, after a keyframe with keyframes that follow it, BATCH at most; none if none comes in time.

        Keyframes of one frame set are never apart: with them there may be more. After a removal with all that follow.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._events, timeout_s)
            events = [self._events.popleft()] if self._events else []
            while self._events and events and type(events[0]) is type(self._events[0]):
                is_full = isinstance(events[0], ArrivedKeyframe) and len(events) >= BATCH
                if is_full and not are_one_set(events[-1], self._events[0]):
                    break
                events.append(self._events.popleft())
            self._changed.notify_all()
            return events


RECEIVE_S = 0.2  # between looks at whether the daemon stops
RETRY_S = 1.0  # after a frame could not be written, or the connection failed
ANOTHER_IS_SERVED = "capture gives its keyframes to another splatnode recon; stop one of the two"


def _refuse_unstorable(waiting: Sequence[WaitingFrame], error: Exception) -> list[WaitingFrame]:
    """Refuses the frame that cannot be stored because of what it is, all where nobody knows which; returns the rest."""
    one = error.received if isinstance(error, UnstorableFrame) else None
    why = str(error) if one else f"it cannot be stored: {type(error).__name__}: {error}"
    for each in waiting:
        if one is None or each.received is one:
            each.client.refuse(each.received.key, why)
    return [each for each in waiting if one is not None and each.received is not one]


class Intake:
    def __init__(
        self,
        network: Network,
        config: ReconstructionConfig,
        store: Store,
        inbox: Inbox,
        problems: Problems,
        stopping: threading.Event,
        frame_sets: FrameSetConfig | None = None,
        further_captures: Sequence[int] = (),
    ) -> None:
        self._frame_sets, self._further_captures = frame_sets or FrameSetConfig(), further_captures
        self._network, self._config, self._store, self._inbox = network, config, store, inbox
        self._problems, self._stopping = problems, stopping
        self.full = ""  # why keyframes cannot be stored
        self.unconnected = ""  # why none come
        self.refused = self.duplicates = 0
        self.newest = -1  # number of the last frame that was taken

    def run(self) -> None:
        """Until the daemon stops. A connection that fails is made anew: the other end may have been put right."""
        while not self._stopping.is_set():
            try:
                with Captures(
                    self._network,
                    self._store.identity,
                    lambda: self._store.frame_keys,
                    self._frame_sets,
                    self._further_captures,
                ) as captures:
                    self._receive(captures)
            except Exception as error:
                expected = isinstance(error, NotAllowed)
                self._report_unconnected(str(error) if expected else f"{type(error).__name__}: {error}")
                if not expected and is_logged(self._problems.add("failures of the keyframes' connection", error)):
                    log.exception("the connection that keyframes come by failed")
                self._stopping.wait(RETRY_S)

    def _receive(self, captures: Captures) -> None:
        before = self.refused
        while not self._stopping.is_set():
            together = captures.receive(timeout_s=RECEIVE_S)
            self.refused, self.duplicates = before + captures.num_refused, captures.duplicates
            self._problems.count("keyframes that were refused", self.refused, captures.why_refused)
            if captures.is_served is not None:
                self._report_unconnected("" if captures.is_served else ANOTHER_IS_SERVED)
            arrived_s = time.monotonic()
            stored = self._store_together(captures, together)
            if stored:  # what the camera could not give is told with the next scene, and disturbs none
                self._enqueue_keyframes(captures, stored, arrived_s)

    def _store_together(self, captures: Captures, together: Sequence[WaitingFrame]) -> list[StoredFrame]:
        """Frames that were taken together, as they are stored, all of them before one is acknowledged.

        Without those that are refused, or no image: none where the daemon stops before.
        """
        waiting = list(together)
        while waiting and not self._stopping.is_set():
            try:
                stored = self._store.add_frames([each.received for each in waiting])
            except Exception as error:
                name = waiting[0].received.frame.name
                if is_shortage(error):
                    self._wait_for_memory(captures, name)
                elif isinstance(error, OSError):
                    self._report_full(f"{name} cannot be stored ({error.strerror}): make room on the disk")
                    self._stopping.wait(RETRY_S)
                    captures.say_ready()
                else:
                    waiting = _refuse_unstorable(waiting, error)
                continue
            self.full = ""
            for each in waiting:
                each.client.acknowledge(each.received)
            return stored
        return []

    def _enqueue_keyframes(self, captures: Captures, together: Sequence[StoredFrame], arrived_s: float) -> None:
        """Hands keyframes that were taken together to the worker, as one."""
        frame_set = together[0].number if len(together) > 1 else None
        events: list[Event] = []
        for stored in together:
            self.newest = stored.number
            name = stored.frame.name
            try:
                keyframe = self._prepare_keyframe(captures, stored)
            except Exception as error:  # a frame that cannot be used must not stop those that can
                if is_shortage(error):  # the daemon stops: the next start prepares it
                    break
                if is_logged(self._problems.add("keyframes that cannot be used", f"{name}: {error}")):
                    log.exception("%s cannot be used", name)
                self._forget(name, f"cannot be used: {error}")
                events.insert(0, RemovedFrame(name))  # first: nothing is between the others
            else:
                events.append(ArrivedKeyframe(keyframe, arrived_s, frame_set))
        if events:
            self._inbox.enqueue(events, self._stopping, captures.say_ready)

    def _prepare_keyframe(self, captures: Captures, stored: StoredFrame) -> Keyframe:
        """Waits where the memory does not suffice; while the daemon stops, that is raised."""
        while True:
            try:
                keyframe = prepare(stored.frame, self._config)
            except Exception as error:
                if not is_shortage(error) or self._stopping.is_set():
                    raise
                self._wait_for_memory(captures, stored.frame.name)
            else:
                self.full = ""
                return keyframe

    def _wait_for_memory(self, captures: Captures, name: str) -> None:
        self._report_full(f"{name} has to wait: {SHORT_OF_MEMORY}")
        self._stopping.wait(RETRY_S)
        captures.say_ready()

    def _forget(self, name: str, reason: str) -> None:
        try:
            self._store.forget(name, reason)
        except OSError as error:  # it stays stored, and is found to be unusable again after a restart
            log.error("%s cannot be removed from the checkpoint: %s", name, error)

    def _report_full(self, problem: str) -> None:
        if problem != self.full:
            log.error("%s", problem)
        self.full = problem

    def _report_unconnected(self, problem: str) -> None:
        if problem and problem != self.unconnected:
            log.error("%s", problem)
        self.unconnected = problem
