"""The capture process: camera -> keyframes, previews, heartbeats. Read `capture` for what happens to a frame."""

from __future__ import annotations

import logging
import os
import time
from contextlib import ExitStack

import cv2

from splatnode.capture.config import CaptureConfig, is_live, open_stream
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.messaging.broadcast import Publisher
from splatnode.capture.messaging.keyframes import KeyframeServer
from splatnode.capture.messaging.services import CAPTURE_PREVIEW, CAPTURE_STATUS
from splatnode.capture.messaging.spool import Spool, SpoolFull
from splatnode.capture.messaging.wire import Numbering, WireError
from splatnode.capture.preview import encode_preview
from splatnode.capture.process.logs import event
from splatnode.capture.process.memory import keep_freed, resident_mb
from splatnode.capture.process.service_manager import ServiceManager
from splatnode.capture.reader import Reader, State
from splatnode.capture.selection import Decision, Selector
from splatnode.capture.status import HEARTBEAT_S, CaptureStatus

log = logging.getLogger(__name__)

POLL_S = 0.05  # longest wait for a frame, and so for the answer to a request that comes meanwhile
PREVIEW_JITTER = 0.1  # share of the time between previews by which a frame may come too early


def capture(config: CaptureConfig) -> None:
    """Runs until a recording has ended and its keyframes are acknowledged; with a live camera, until a signal comes.

    Raises CameraUnavailable, AlreadyRunning, NetworkError, OSError. SystemExit and KeyboardInterrupt end it cleanly.
    """
    keep_freed()
    cv2.setNumThreads(1)  # small images: threads would cost more than they give, and the processor is recon's
    with ExitStack() as resources:
        manager = ServiceManager()
        server = resources.enter_context(KeyframeServer(config.network, Spool(config.spool)))
        session = _Session(config, server, resources)
        camera = config.camera
        reader = resources.enter_context(Reader(lambda: open_stream(camera), is_live(camera), config.reader))
        resources.callback(manager.stopping)
        event(log, logging.INFO, "started", camera=camera.kind, waiting=server.queued)
        if why := server.spool.shortage():
            event(log, logging.WARNING, "disk_space", problem=why)
        if not is_live(camera):
            manager.ready()  # its first frame may be long in coming; a live camera's proves that it is there
        while not (reader.state is State.FINISHED and server.queued == 0):
            item = reader.next(POLL_S)
            if isinstance(item, Frame):
                session.take(item, reader.state)
                manager.ready()
            elif isinstance(item, DroppedFrame):
                session.drop(item)
            server.serve(0)
            session.beat(reader)
            manager.alive(f"{reader.state.value}: {session.frames} frames, {session.keyframes} keyframes")
        event(log, logging.INFO, "finished", frames=session.frames, keyframes=session.keyframes)


class _Session:
    """The counters of one run, and the sockets that it sends to."""

    def __init__(self, config: CaptureConfig, server: KeyframeServer, resources: ExitStack) -> None:
        self.config = config
        self.frames = self.keyframes = self.unusable = self.dropped = self.not_taken = 0
        self.last_decision = ""
        self._spool_full = ""
        self._server = server
        self._selector = Selector(config.selection, config.quality)
        self._previews = resources.enter_context(Publisher(CAPTURE_PREVIEW, config.network))
        self._heartbeats = resources.enter_context(Publisher(CAPTURE_STATUS, config.network))
        self._preview_numbers = Numbering(server.numbering.session)
        self._heartbeat_numbers = Numbering(server.numbering.session)
        self._next_preview_ns = 0
        self._started = self._next_beat = time.monotonic()
        self._rate = _Rate()

    def take(self, frame: Frame, state: State) -> None:
        """Sends a frame: as a keyframe where it adds something to those before, and as a preview in any case."""
        self.frames += 1
        self._rate.count()
        decision = self._selector.decide(frame, waiting=self._server.queued)
        self.unusable += decision.candidate and not decision.take
        if decision.take:
            self._offer(frame, decision)
        if decision.candidate:
            self.last_decision = f"{frame.name}: {'taken' if decision.take else 'not taken'}: {decision.reason}"
        self._send_preview(frame, decision, state)

    def drop(self, dropped: DroppedFrame) -> None:
        """Tells recon of a frame that the camera could not give."""
        self.dropped += 1
        event(log, logging.WARNING, "dropped", name=dropped.name, reason=dropped.reason)
        self._deliver(dropped)

    def beat(self, reader: Reader) -> None:
        """Sends a heartbeat, when one is due."""
        if time.monotonic() < self._next_beat:
            return
        self._next_beat = time.monotonic() + HEARTBEAT_S
        status = CaptureStatus(
            **self._heartbeat_numbers.next(),
            state=reader.state.value,
            why=reader.why or self._spool_full or self._server.spool.shortage(),
            camera=self.config.camera.kind,
            pid=os.getpid(),
            uptime_s=time.monotonic() - self._started,
            frames=self.frames,
            frames_per_second=self._rate.per_second(),
            keyframes=self.keyframes,
            unusable=self.unusable,
            dropped=self.dropped,
            skipped=reader.skipped,
            not_taken=self.not_taken,
            last_decision=self.last_decision,
            waiting=self._server.queued,
            waiting_mb=self._server.spool.size_bytes / 2**20,
            acknowledged=self._server.acknowledged,
            recon_connected=self._server.connected,
            refused_messages=self._server.refused,
            rss_mb=resident_mb(),
        )
        self._heartbeats.send(status)

    def _offer(self, frame: Frame, decision: Decision) -> None:
        if not self._deliver(frame):
            self._selector.forget_last()
            return
        self.keyframes += 1
        event(log, logging.INFO, "keyframe", name=frame.name, reason=decision.reason, waiting=self._server.queued)

    def _deliver(self, item: Frame | DroppedFrame) -> bool:
        """Puts a frame into the spool; False where there is no room, which is logged once until there is room again."""
        try:
            self._server.offer(item)
        except (SpoolFull, WireError) as error:
            self.not_taken += 1
            if not self._spool_full:
                event(log, logging.ERROR, "spool_full", why=error)
            self._spool_full = str(error)
            return False
        if self._spool_full:
            event(log, logging.INFO, "spool_has_room", not_taken=self.not_taken)
            self._spool_full = ""
        return True

    def _send_preview(self, frame: Frame, decision: Decision, state: State) -> None:
        rate = self.config.preview.per_second
        if rate == 0 or frame.stamp_ns < self._next_preview_ns:
            return
        self._next_preview_ns = frame.stamp_ns + round(1e9 * (1 - PREVIEW_JITTER) / rate)
        header, arrays = encode_preview(
            frame,
            self._preview_numbers,
            self.config.preview,
            state=state.value,
            taken=decision.take,
            reason=decision.reason,
        )
        self._previews.send(header, arrays)


class _Rate:
    """Counts events and gives their rate."""

    def __init__(self) -> None:
        self._since = time.monotonic()
        self._count = 0

    def count(self) -> None:
        self._count += 1

    def per_second(self) -> float:
        """Since the last call."""
        seconds, self._since = time.monotonic() - self._since, time.monotonic()
        rate, self._count = self._count / max(seconds, 1e-6), 0
        return rate
