"""The worker's queue: keyframes with their features, and names of frames that were left out, oldest first."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from splatnode.recon.frames.keyframe import Keyframe

CAPACITY = 32  # events in memory; further keyframes wait with their sender
BATCH = 4  # keyframes that are worked in before the scene is shown again
WAIT_S = 0.1  # between looks at whether the daemon stops


@dataclass(frozen=True, eq=False)
class ArrivedKeyframe:
    """A keyframe that the checkpoint holds."""

    keyframe: Keyframe
    at_s: float  # monotonic


@dataclass(frozen=True)
class RemovedFrame:
    """A frame that the checkpoint names as left out, or no longer holds."""

    name: str


Event = ArrivedKeyframe | RemovedFrame


def _do_nothing() -> None:
    """Nobody waits for the one that puts."""


def _are_both_keyframes(one: Event, other: Event) -> bool:
    return isinstance(one, ArrivedKeyframe) and isinstance(other, ArrivedKeyframe)


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

    def enqueue_now(self, event: RemovedFrame) -> None:
        """Also where the inbox is full: who gives commands does not wait for the work."""
        with self._changed:
            self._events.append(event)
            self._changed.notify_all()

    def dequeue(self, timeout_s: float) -> list[Event]:
        """The next event, after a keyframe with keyframes that follow it, BATCH at most; none if none comes in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._events, timeout_s)
            events = [self._events.popleft()] if self._events else []
            while self._events and 0 < len(events) < BATCH and _are_both_keyframes(events[0], self._events[0]):
                events.append(self._events.popleft())
            self._changed.notify_all()
            return events
