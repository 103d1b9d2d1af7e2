"""The thread that receives keyframes: stores, acknowledges, extracts features; it does not wait for the worker.

What cannot be stored because of what it is, is refused; what the disk does not take is tried again.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from splatnode.capture.messaging.network import Network, NotAllowed
from splatnode.capture.process.logs import Problems, is_logged
from splatnode.capture.process.system import SHORT_OF_MEMORY, is_shortage
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon.captures import Captures, FrameSetConfig, WaitingFrame
from splatnode.recon.daemon.checkpoint.records import StoredFrame
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.preparation import prepare

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


def _are_both_keyframes(one: Event, other: Event) -> bool:
    return isinstance(one, ArrivedKeyframe) and isinstance(other, ArrivedKeyframe)


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

    def enqueue(self, event: Event, stopping: threading.Event, meanwhile: Callable[[], None] = _do_nothing) -> None:
        """Waits where the inbox is full, until there is room or the daemon stops; calls `meanwhile` again and again."""
        with self._changed:
            while len(self._events) >= CAPACITY and not stopping.is_set():
                self._changed.wait(WAIT_S)
                meanwhile()
            self._events.append(event)
            self._changed.notify_all()

    def enqueue_together(
        self, events: Sequence[Event], stopping: threading.Event, meanwhile: Callable[[], None] = _do_nothing
    ) -> None:
        """As `enqueue`, of events of which none is to be seen without the others; all go in where one has room."""
        with self._changed:
            while len(self._events) >= CAPACITY and not stopping.is_set():
                self._changed.wait(WAIT_S)
                meanwhile()
            self._events.extend(events)
            self._changed.notify_all()

    def enqueue_now(self, event: RemovedFrame) -> None:
        """Also where the inbox is full: who gives commands does not wait for the work."""
        with self._changed:
            self._events.append(event)
            self._changed.notify_all()

    def dequeue(self, timeout_s: float) -> list[Event]:
        """The next event, after a keyframe with keyframes that follow it, BATCH at most; none if none comes in time.

        Keyframes of one frame set are never apart: with them there may be more.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._events, timeout_s)
            events = [self._events.popleft()] if self._events else []
            while self._events and events and _are_both_keyframes(events[0], self._events[0]):
                if len(events) >= BATCH and not are_one_set(events[-1], self._events[0]):
                    break
                events.append(self._events.popleft())
            self._changed.notify_all()
            return events


log = logging.getLogger(__name__)

RECEIVE_S = 0.2  # between looks at whether the daemon stops
RETRY_S = 1.0  # after a frame could not be written, or the connection failed
ANOTHER_IS_SERVED = "capture gives its keyframes to another splatnode recon; stop one of the two"


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
            stored = [each for frame in together if (each := self._store_received(captures, frame)) is not None]
            if stored:  # what the camera could not give is told with the next scene, and disturbs none
                self._enqueue_keyframes(captures, stored, arrived_s)

    def _store_received(self, captures: Captures, waiting: WaitingFrame) -> StoredFrame | None:
        """The frame as it is stored, and acknowledged; None where it is refused, or no image."""
        client, received = waiting.client, waiting.received
        while not self._stopping.is_set():
            try:
                stored = self._store.add_frame(received)
            except Exception as error:
                if is_shortage(error):
                    self._wait_for_memory(captures, received.frame.name)
                    continue
                if not isinstance(error, OSError):
                    client.refuse(received.key, f"it cannot be stored: {type(error).__name__}: {error}")
                    return None
                self._report_full(f"{received.frame.name} cannot be stored ({error.strerror}): make room on the disk")
                self._stopping.wait(RETRY_S)
                captures.say_ready()
                continue
            self.full = ""
            client.acknowledge(received)
            return stored
        return None

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
            self._inbox.enqueue_together(events, self._stopping, captures.say_ready)

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
