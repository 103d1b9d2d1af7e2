"""The capture process: camera -> keyframes, previews, heartbeats. Read `capture` for what happens to a frame."""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Protocol

import cv2

from splatnode.capture.config import CaptureConfig, camera_opener, encode_preview, is_live, mount_camera, name_camera
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.keyframe_selection import TOGETHER, Decision, FrameSetSelection, Selector
from splatnode.capture.messaging.keyframe_queue import KeyframeServer, Spool, SpoolFull
from splatnode.capture.messaging.messages import Numbering, WireError
from splatnode.capture.messaging.network import (
    CAPTURE_CONTROL,
    CAPTURE_PREVIEW,
    CAPTURE_STATUS,
    files_for_strangers,
)
from splatnode.capture.messaging.pubsub import (
    FULL_S,
    Answer,
    CommandServer,
    FrameSetLink,
    MarkProblemsSeen,
    Publisher,
)
from splatnode.capture.process.system import (
    SHORT_OF_MEMORY,
    ServiceManager,
    is_shortage,
    keep_freed,
    make_sure_of_room,
    raise_file_limit,
    raise_shortage,
    resident_mb,
    wrap_late_errors,
)
from splatnode.capture.process.terminal import Problems, Unfailing, event, is_logged
from splatnode.capture.process.text import sanitize_text
from splatnode.capture.reader import Reader, ReaderState
from splatnode.capture.status import HEARTBEAT_S, NAMED, POLL_S, CaptureStatus, begin_run, end_run

log = logging.getLogger(__name__)

SOUND_S = 1.0  # a recording that has not failed by then can be read
_SOCKETS = 4  # that it binds
_FILES, _THREADS = 96, 16  # of which the process has need: three endpoints, the camera's thread, those of libraries
PREVIEW_JITTER = 0.1  # share of the time between previews by which a frame may come too early


def capture(config: CaptureConfig) -> None:
    """Runs until a recording has ended and its keyframes are answered; with a live camera, until a signal comes.

    Raises what opening the camera, the network and the spool raises; once it is ready, CameraUnavailable or Failed.
    SystemExit and KeyboardInterrupt end it cleanly.
    """
    keep_freed()
    cv2.setNumThreads(1)  # small images: threads would cost more than they give, and the processor is recon's
    raise_file_limit()
    make_sure_of_room(_FILES + files_for_strangers(config.network, _SOCKETS), _THREADS)
    with ExitStack() as resources:
        manager = ServiceManager()
        server = resources.enter_context(
            KeyframeServer(config.network, Spool(config.spool, config.camera_id), config.camera_id)
        )
        session = CaptureSession(config, server, resources)
        camera = config.camera
        opened = mount_camera(camera_opener(camera, config.body_mask), config.T_base_camera)
        opened = name_camera(opened, config.camera_id)
        reader = resources.enter_context(Reader(opened, is_live(camera), config.reader))
        resources.callback(manager.stopping)
        begin_run(config.network, config.camera_id)
        if why := server.spool.shortage():
            event(log, logging.WARNING, "disk_space", problem=why)
        sound_s = math.inf if is_live(camera) else time.monotonic() + SOUND_S  # a live camera proves it by a frame
        while session.is_waiting or not (reader.state is ReaderState.FINISHED and server.num_queued == 0):
            with wrap_late_errors(manager):
                item = None if session.waits(POLL_S) else reader.next(POLL_S)
                if item is not None or time.monotonic() > sound_s:
                    manager.ready()
                    session.say_started()
                session.handle(item, reader.state)
                session.serve()
                session.send_heartbeat(reader)
                manager.alive(f"{reader.state.value}: {session.frames} frames, {session.keyframes} keyframes")
        event(log, logging.INFO, "finished", frames=session.frames, keyframes=session.keyframes)
        try:
            end_run(config.network, session.frames, session.keyframes, config.camera_id)
        except OSError as error:
            log.warning("splatnode status will not know that this capture finished: %s", error)


class FrameSource(Protocol):
    """Describes where frames come from, for the heartbeat: a Reader, or a program."""

    skipped: int

    @property
    def state(self) -> ReaderState: ...

    @property
    def why(self) -> str: ...


class CaptureSession:
    """The counters of one run, and the sockets that it sends to."""

    def __init__(self, config: CaptureConfig, server: KeyframeServer, resources: ExitStack) -> None:
        self.config = config
        self.frames = self.keyframes = self.unusable = self.dropped = self.not_taken = 0
        self.last_decision = ""
        self._spool_full = ""
        self._started = False
        self._server = server
        self._selectors: dict[str, Selector] = {}  # by camera id: each camera has views of its own
        self._together = FrameSetSelection(
            0.0 if config.selection.every_frame else config.selection.frame_set_tolerance_s
        )
        self._link = _open_link(config, resources)
        self._full_from = math.inf  # with so many keyframes or more in the spool there is no room for another
        self._next_word_s = -math.inf  # when the others are told that there is none (monotonic)
        self._problems = Problems()
        self._commands = resources.enter_context(
            CommandServer(CAPTURE_CONTROL.select_capture(config.camera_id), config.network, MarkProblemsSeen)
        )
        self._previews = resources.enter_context(
            Publisher(CAPTURE_PREVIEW.select_capture(config.camera_id), config.network)
        )
        self._heartbeats = resources.enter_context(
            Publisher(CAPTURE_STATUS.select_capture(config.camera_id), config.network)
        )
        self._preview_numbers = Numbering(server.numbering.session)
        self._heartbeat_numbers = Numbering(server.numbering.session)
        self._next_preview_ns = 0
        self._began = self._next_beat = time.monotonic()
        self._rate = _Rate()
        self._heart, self._preview = Unfailing("the heartbeat"), Unfailing("the preview")
        self._postponed: list[tuple[str, Callable[[], object]]] = []  # frames, and what is to be done with each

    @property
    def is_waiting(self) -> bool:
        """Whether a frame waits for memory or a file that this process may open: no further one is read meanwhile."""
        return bool(self._postponed)

    def waits(self, pause_s: float) -> bool:
        """Whether a frame still waits, after another try and a pause."""
        if not self._postponed:
            return False
        postponed, self._postponed = self._postponed, []
        for name, step in postponed:
            self._attempt(name, step)
        if not self._postponed:
            event(log, logging.INFO, "goes_on", frame=postponed[-1][0])
            return False
        time.sleep(pause_s)
        return True

    def say_started(self) -> None:
        """Logs, once, that the camera is open and gives frames."""
        if not self._started:
            self._started = True
            event(log, logging.INFO, "started", camera=self.config.camera.kind, waiting=self._server.num_queued)

    def handle(self, item: Frame | DroppedFrame | None, state: ReaderState) -> None:
        """Takes or drops what came, if something did. Whatever a frame's content makes fail costs that frame alone."""
        if isinstance(item, Frame):
            self._attempt(item.name, lambda: self.take(item, state))
        elif item is not None:
            self._attempt(item.name, lambda: self.drop(item))

    def _attempt(self, name: str, step: Callable[[], object]) -> None:
        """Does a step with the frame `name`; where the process is short of something, it is done again later."""
        try:
            step()
        except Exception as error:
            why = f"{name}: {type(error).__name__}: {error}"
            if is_shortage(error):
                self._postponed.append((name, step))
                if is_logged(self._problems.add(f"times that a frame had to wait ({SHORT_OF_MEMORY})", why)):
                    event(log, logging.WARNING, "waits", frame=name, why=why)
            elif is_logged(self._problems.add("frames that could not be handled", why)):
                log.exception("%s could not be handled", name)

    def serve(self) -> None:
        """Answers recon's requests, and whoever has seen the problems."""
        self._server.serve(0)
        self._commands.serve(0, self._answer)
        if self._link is None or self.is_waiting:
            return
        if self._server.num_queued < self._full_from:
            self._full_from = math.inf
        elif time.monotonic() >= self._next_word_s:
            self._next_word_s = time.monotonic() + FULL_S / 4
            self._link.announce_full()
        for stamp in self._link.receive():
            self._take_wanted(self._together.want(stamp))

    def _take_wanted(self, frames: Sequence[Frame]) -> None:
        """Frames that became no keyframes, until another camera took one with them."""
        for frame in frames:
            decision = self._decide_again(frame)
            if decision.take:
                self._together.mark_taken(frame)
                self._attempt(frame.name, partial(self._offer, frame, decision))

    def take(self, frame: Frame, state: ReaderState) -> None:
        """Sends a frame: as a keyframe where it adds something to those before, and as a preview in any case."""
        decision = self._decide(frame)
        if decision.take:
            self._attempt(frame.name, lambda: self._offer(frame, decision))
        elif not decision.candidate:
            self._together.hold(frame)
        self._preview.do(lambda: self._send_preview(frame, decision, state))

    def push(self, frame: Frame) -> Decision:
        """As `take`, for a program that waits for the outcome. Raises SpoolFull, OSError, WireError (too large)."""
        decision = self._decide(frame)
        if decision.take:
            try:
                self._server.offer(frame)
            except Exception:
                self._find_selector(frame).forget_last()
                self.not_taken += 1
                raise
            self._count_keyframe(frame, decision)
        self._preview.do(lambda: self._send_preview(frame, decision, ReaderState.STREAMING))
        return decision

    def _decide(self, frame: Frame) -> Decision:
        decision = self._find_selector(frame).decide(frame, waiting=self._server.num_queued)
        self.frames += 1
        self._rate.count()
        if decision.take:
            self._tell_others(frame)
        elif not decision.candidate and self._together.is_wanted(frame):
            decision = self._decide_again(frame)
        if decision.take:
            self._together.mark_taken(frame)
        self.unusable += decision.candidate and not decision.take
        if decision.candidate:
            self.last_decision = f"{frame.name}: {'taken' if decision.take else 'not taken'}: {decision.reason}"
        return decision

    def _decide_again(self, frame: Frame) -> Decision:
        """Decides about a frame that another camera's keyframe wants. An unusable one is not counted as such."""
        decision = self._find_selector(frame).add(frame, TOGETHER)
        return decision if decision.take else replace(decision, candidate=False)

    def _tell_others(self, frame: Frame) -> None:
        """Wants of the other cameras what they took with this keyframe, unless there is no room for it."""
        if frame.captured_at is None or not frame.camera_id or self._spool_full:
            return
        if self._link is not None:
            self._link.announce(frame.captured_at)
        self._take_wanted(self._together.want(frame.captured_at, frame.camera_id))

    def _find_selector(self, frame: Frame) -> Selector:
        """Returns the selector of the frame's camera, which begins with its first frame."""
        if frame.camera_id not in self._selectors:
            self._selectors[frame.camera_id] = Selector(self.config.selection, self.config.quality)
        return self._selectors[frame.camera_id]

    def drop(self, dropped: DroppedFrame) -> None:
        """Tells recon of a photograph that cannot be used, where half of the spool at least is free for keyframes.

        A live camera's next frame makes up for one that it could not give: these are counted.
        """
        live = is_live(self.config.camera)
        if not live and self._server.num_queued < self.config.spool.max_frames // 2:
            self._deliver(dropped)
        self.dropped += 1
        if not live or is_logged(self.dropped):
            event(log, logging.WARNING, "dropped", name=dropped.name, reason=dropped.reason, number=self.dropped)

    def send_heartbeat(self, reader: FrameSource) -> None:
        """Sends a heartbeat, when one is due; none where what it tells cannot be had."""
        if time.monotonic() < self._next_beat:
            return
        self._next_beat = time.monotonic() + HEARTBEAT_S
        self._heart.do(lambda: self._heartbeats.send(self._status(reader)))

    def _status(self, reader: FrameSource) -> CaptureStatus:
        quarantine = self._server.spool.quarantine
        return CaptureStatus(
            **self._heartbeat_numbers.next(),
            state=reader.state.value,
            why=sanitize_text(reader.why or self._spool_full or self._shortage()),
            camera=self.config.camera.kind,
            pid=os.getpid(),
            uptime_s=time.monotonic() - self._began,
            frames=self.frames,
            frames_per_second=self._rate.per_second(),
            keyframes=self.keyframes,
            unusable=self.unusable,
            dropped=self.dropped,
            skipped=reader.skipped,
            not_taken=self.not_taken,
            last_decision=sanitize_text(self.last_decision),
            waiting=self._server.num_queued,
            waiting_mb=self._server.spool.size_bytes / 2**20,
            acknowledged=self._server.acknowledged,
            recon_connected=self._server.is_connected,
            refused_messages=self._server.refused + self._commands.refused,
            set_aside=len(quarantine),
            newest_set_aside=quarantine.newest(NAMED),
            rss_mb=resident_mb(),
            problem=self._problem(),
        )

    def _problem(self) -> str:
        server, quarantine = self._server, self._server.spool.quarantine
        newest = "".join(f"{each.name}: {each.reason}" for each in quarantine.newest(1))
        self._problems.count("requests that were refused", server.refused, server.why_refused)
        self._problems.count("commands that were refused", self._commands.refused, self._commands.why_refused)
        sentences = [f"{quarantine.unseen} keyframes were set aside, the last: {newest}"] if quarantine.unseen else []
        sentences += (
            [f"{server.num_rejected_consumers} further recons ask for keyframes; stop them"]
            if server.num_rejected_consumers
            else []
        )
        return sanitize_text("; ".join((*sentences, *filter(None, [str(self._problems)]))))

    def _answer(self, _: MarkProblemsSeen) -> Answer:
        self._problems.mark_seen()
        self._server.spool.quarantine.mark_seen()
        return Answer(True, "the problems are not told again")

    def _shortage(self) -> str:
        try:
            return self._server.spool.shortage()
        except OSError as error:
            return f"the spool's disk does not tell its size: {error.strerror}"

    def _offer(self, frame: Frame, decision: Decision) -> None:
        if not self._deliver(frame):
            self._find_selector(frame).forget_last()
            return
        self._count_keyframe(frame, decision)

    def _count_keyframe(self, frame: Frame, decision: Decision) -> None:
        self.keyframes += 1
        event(log, logging.INFO, "keyframe", name=frame.name, reason=decision.reason, waiting=self._server.num_queued)

    def _deliver(self, item: Frame | DroppedFrame) -> bool:
        """Puts a frame into the spool; False where there is no room, which is logged once until there is room again.

        Raises what is_shortage tells: then the frame waits, and not the disk is to blame.
        """
        try:
            if self._link is not None and isinstance(item, Frame) and self._link.is_another_full:
                raise SpoolFull("the spool of another camera is full, and no part of a frame set is kept")
            self._store(item)
        except WireError as error:
            self.not_taken += 1
            if is_logged(self._problems.add("keyframes too large to be sent", error)):
                event(log, logging.ERROR, "too_large", why=error)
            return False
        except (SpoolFull, OSError) as error:
            raise_shortage(error)
            self.not_taken += 1
            if not self._spool_full:
                event(log, logging.ERROR, "spool_full", why=error)
            self._spool_full = str(error)
            return False
        if self._spool_full:
            event(log, logging.INFO, "spool_has_room", not_taken=self.not_taken)
            self._spool_full = ""
        return True

    def _store(self, item: Frame | DroppedFrame) -> None:
        """Puts a frame into the spool. Raises as `KeyframeServer.offer`, and remembers that there is no room."""
        try:
            self._server.offer(item)
        except SpoolFull:
            self._full_from = self._server.num_queued
            raise

    def _send_preview(self, frame: Frame, decision: Decision, state: ReaderState) -> None:
        rate = self.config.preview.fps
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


def _open_link(config: CaptureConfig, resources: ExitStack) -> FrameSetLink | None:
    """The link to the captures of other cameras; None where there are none, or each camera selects by itself."""
    selection = config.selection
    if not config.camera_id or selection.every_frame or not selection.frame_set_tolerance_s:
        return None
    try:
        return resources.enter_context(FrameSetLink(config.network, config.camera_id))
    except OSError as error:
        log.warning("this camera selects keyframes by itself, not by frame sets: %s", error)
        return None


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
