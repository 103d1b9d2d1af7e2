"""A camera in its own thread: it is opened, read, and opened again after a loss, with growing pauses."""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import Annotated

import msgspec

from splatnode.capture.frame import CameraUnavailable, DroppedFrame, Frame, KeepAlive
from splatnode.capture.process.config import Internal

log = logging.getLogger(__name__)

CLOSE_S = 3.0  # that closing waits for the thread; a driver may hang for ever
CAPACITY = 2  # frames between the threads; with more, previews would be late
HAND_OVER_S = 0.1  # between looks at whether to stop, while a recording waits for its reader

Seconds = Annotated[float, msgspec.Meta(gt=0)]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    frame_timeout_s: Seconds = 5.0  # so long without a frame, a live camera counts as lost
    first_pause_s: Internal[Seconds] = 1.0  # before it is opened again; doubled at each failure
    longest_pause_s: Internal[Seconds] = 15.0  # to which that pause grows
    # After so long without a frame the process ends with 69, and the service manager decides
    reconnect_timeout_s: Seconds = 300.0


class ReaderState(Enum):
    STARTING = "starting"
    STREAMING = "streaming"
    DEGRADED = "degraded"  # the camera is lost, or silent
    FINISHED = "finished"  # a recording's end, of which everything has been read


@dataclass(frozen=True)
class Failure:
    """The camera failed for good; opening it again would not help."""

    error: Exception


class Reader:
    """Frames of one session, numbered through all losses. Close it, or use it as a context manager."""

    def __init__(
        self, open_camera: Callable[[], Iterator[Frame | DroppedFrame | KeepAlive]], live: bool, config: Config
    ) -> None:
        self.config = config
        self.why = ""  # of a degraded state
        self.skipped = 0  # frames of a live camera that a newer one replaced before they were read
        self._open_camera = open_camera
        self._live = live
        self._state = ReaderState.STARTING
        self._last = time.monotonic()
        self._stop = threading.Event()
        self._items: queue.Queue[Frame | DroppedFrame | Failure] = queue.Queue(maxsize=CAPACITY)
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def __enter__(self) -> Reader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the camera. Where its driver hangs, the thread is left to end with the process."""
        self._stop.set()
        self._thread.join(timeout=CLOSE_S)

    @property
    def state(self) -> ReaderState:
        if self._state is ReaderState.STREAMING and self._live and self.silent_s > self.config.frame_timeout_s:
            return ReaderState.DEGRADED
        if self._state is ReaderState.FINISHED and not self._items.empty():
            return ReaderState.STREAMING
        return self._state

    @property
    def silent_s(self) -> float:
        """Seconds since the last frame that can be used, or since the start."""
        return time.monotonic() - self._last

    def next(self, timeout_s: float) -> Frame | DroppedFrame | None:
        """The next frame; None where none comes in time. Raises what ended the camera for good."""
        item = None
        with contextlib.suppress(queue.Empty):
            item = self._items.get(timeout=timeout_s)
        if isinstance(item, Failure):
            raise item.error
        if not isinstance(item, Frame) and self._live and self.silent_s > self.config.reconnect_timeout_s:
            useless = "" if item is None else f" that can be used; the last: {item.reason}"
            raise CameraUnavailable(f"no frame for {self.silent_s:.0f} s{useless}")
        return item

    def _run(self) -> None:
        try:
            for item in self._frames():
                self._hand_over(item)
        except Exception as error:  # the thread's end is told to the reader, whatever it was
            self._hand_over(Failure(error))
        else:
            self._state = ReaderState.FINISHED

    def _frames(self) -> Iterator[Frame | DroppedFrame]:
        """The frames; the camera is opened again after a loss.

        Raises CameraUnavailable where it was never there, or is lost for too long.
        """
        count, pause, lost_at, was_there = 0, self.config.first_pause_s, None, False
        while not self._stop.is_set():
            try:
                for item in self._number_frames(count):
                    if not isinstance(item, DroppedFrame):
                        pause, lost_at, was_there, self.why = self.config.first_pause_s, None, True, ""
                    if isinstance(item, Frame):
                        count += 1
                        self._last, self._state = time.monotonic(), ReaderState.STREAMING
                    elif isinstance(item, KeepAlive):
                        self._state = ReaderState.STREAMING if count else ReaderState.STARTING
                        continue
                    yield item
                return
            except CameraUnavailable as error:
                lost_at = lost_at or time.monotonic()
                if not was_there or time.monotonic() - lost_at > self.config.reconnect_timeout_s:
                    raise
                self._state, self.why = ReaderState.DEGRADED, str(error)
                log.warning("camera lost: %s; opening it again in %.0f s", error, pause)
                self._stop.wait(pause)
                pause = min(2 * pause, self.config.longest_pause_s)

    def _number_frames(self, count: int) -> Iterator[Frame | DroppedFrame | KeepAlive]:
        """The camera's frames from one opening to its loss. A frame from before the last one is dropped.

        Several frames of one time are frames of a recording, whose clock is coarse; a live camera has given one twice.
        """
        newest_ns = -1
        stream = self._open_camera()
        try:
            for item in stream:
                if self._stop.is_set():
                    return
                if not isinstance(item, Frame):
                    yield item
                elif item.stamp_ns < newest_ns:
                    yield DroppedFrame(item.name, f"its time stamp is {newest_ns - item.stamp_ns} ns before the last")
                elif item.stamp_ns == newest_ns and self._live:
                    yield DroppedFrame(item.name, "its time stamp is that of the last frame: the camera gave one twice")
                else:
                    newest_ns = item.stamp_ns
                    yield replace(item, frame_id=count)
                    count += 1
        finally:
            close = getattr(stream, "close", None)
            if close is not None:
                close()

    def _hand_over(self, item: Frame | DroppedFrame | Failure) -> None:
        """Queues an item for the reader: of a live camera the newest are kept, of a recording all."""
        while not self._stop.is_set():
            try:
                self._items.put(item, timeout=0 if self._live else HAND_OVER_S)
                return
            except queue.Full:
                if self._live:
                    self._drop_oldest()

    def _drop_oldest(self) -> None:
        try:
            self._items.get_nowait()
            self.skipped += 1
        except queue.Empty:
            return
