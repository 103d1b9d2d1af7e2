"""Where moments come from: a result on disk, or a running node."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from splatnode.capture.messaging.broadcast import Subscriber
from splatnode.capture.messaging.network import Network
from splatnode.capture.messaging.services import RECON_DEPTH, RECON_SCENE, RECON_STATUS
from splatnode.capture.messaging.state import StateClient
from splatnode.capture.process.problems import Problems, is_logged
from splatnode.recon.daemon.status import ReconStatus
from splatnode.recon.result.depth_message import DepthHeader, add_depth_shares
from splatnode.recon.result.export import sanitize_gaussians
from splatnode.recon.result.message import CameraRecord, SceneHeader, decode_snapshot, parse_camera
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.stored_snapshot import load_images, read_result
from splatnode.viewer.moment import Moment

log = logging.getLogger(__name__)

_POLL_S = 0.25
_DEPTH_S = 0.3  # that a scene waits for the message about its depth; an older node sends none


class Source(Protocol):
    def take(self) -> Moment | None:
        """The newest moment, once; None where nothing has come since. Never waits."""

    @property
    def age_s(self) -> float | None:
        """Seconds since something came; None where nothing more will."""

    @property
    def live_camera(self) -> CameraEstimate | None:
        """Returns the live camera in the newest scene; None where it is not known."""

    def close(self) -> None: ...


@runtime_checkable
class PagedSource(Protocol):
    """A source that has more than fits into memory, and gives what is near."""

    def look_from(self, eye: npt.NDArray[np.float64], which: int) -> None:
        """Sets the viewpoint's position (3,) and the map that it looks at. Never waits."""


class FixedSource:
    """One moment that is there from the start."""

    age_s = None
    live_camera = None

    def __init__(self, moment: Moment) -> None:
        self._moment: Moment | None = moment

    def take(self) -> Moment | None:
        moment, self._moment = self._moment, None
        return moment

    def close(self) -> None:
        self._moment = None


class LiveSource:
    """The scene of a running node. A thread listens; it keeps one moment, the newest."""

    def __init__(self, network: Network) -> None:
        """Raises what opening the network raises: NetworkError, KeyFileError."""
        self._client = StateClient(RECON_SCENE, network, SceneHeader)
        self._depths = StateClient(RECON_DEPTH, network, DepthHeader)
        self._depth: DepthHeader | None = None  # the newest
        self._heartbeats = Subscriber(RECON_STATUS, network, ReconStatus)
        self._refusals = Problems()
        self._newest: Moment | None = None
        self._tracked: CameraEstimate | None = None
        self.scene: tuple[str, int] | None = None  # session and sequence of the newest message with a scene
        self._lock = threading.Condition()
        self._error: BaseException | None = None
        self.closed = threading.Event()  # by `close`
        self._thread = threading.Thread(target=self._listen, name="live scene", daemon=True)
        self._thread.start()

    @property
    def age_s(self) -> float:
        """A scene that is being refined is silent for long: the node's heartbeats tell that it lives."""
        return min(self._client.age_s, self._heartbeats.age_s)

    @property
    def live_camera(self) -> CameraEstimate | None:
        return self._tracked

    def take(self) -> Moment | None:
        """Raises what the connection failed with, for example NotAllowed."""
        if self._error is not None:
            raise self._error
        with self._lock:
            moment, self._newest = self._newest, None
        return moment

    def wait(self, timeout_s: float | None = None) -> Moment | None:
        """As `take`, but waits until one comes; None where none comes in time, or when it is closed."""
        with self._lock:
            self._lock.wait_for(lambda: self._newest or self._error or self.closed.is_set(), timeout_s)
        return self.take()

    def close(self) -> None:
        self.closed.set()
        with self._lock:
            self._lock.notify_all()
        self._thread.join()
        self._client.close()
        self._depths.close()
        self._heartbeats.close()

    def _listen(self) -> None:
        last: CameraRecord | None = None  # of the last heartbeat: what has not changed is not drawn again
        try:
            while not self.closed.is_set():
                message = self._client.poll(_POLL_S)
                heartbeat = self._heartbeats.latest(0)
                if heartbeat is not None and heartbeat.header.tracked != last:
                    last = heartbeat.header.tracked
                    self._tracked = last and parse_camera(last)
                if message is None:
                    continue
                self.scene = message.header.session, message.header.sequence
                try:
                    live = decode_snapshot(message)
                    snapshot = self._attach_depth(_sanitize_snapshot(live.snapshot), self.scene)
                    moment = Moment(snapshot, time.monotonic(), live.scene_id)
                except Exception as error:  # of one scene; the next one may do
                    if is_logged(self._refusals.add("scenes that were refused", error)):
                        log.warning("a scene of the node was refused: %s", error)
                    continue
                with self._lock:
                    self._newest = moment
                    self._lock.notify_all()
        except Exception as error:
            with self._lock:
                self._error = error
                self._lock.notify_all()

    def _attach_depth(self, snapshot: Snapshot, scene: tuple[str, int]) -> Snapshot:
        """The snapshot of message `scene` with its shares of multi-view consistent depth, if these come in time."""
        deadline = time.monotonic() + _DEPTH_S
        while (depth := self._depth) is None or (depth.session, depth.scene_sequence) != scene:
            if depth is not None and depth.session == scene[0] and depth.scene_sequence > scene[1]:
                return snapshot  # a newer scene is on its way already
            message = self._depths.poll(max(0.0, deadline - time.monotonic()))
            if message is None:
                return snapshot
            self._depth = message.header
        return add_depth_shares(snapshot, depth)


def load_result(place: Path, photographs: Path | None = None) -> Moment:
    """The moment in a result's folder or a scene file, with the photographs that are found.

    They are looked for in `photographs`, or else where `read_result` tells. Raises what that raises.
    """
    snapshot, folders = read_result(place)
    images = load_images(snapshot.cameras, [photographs] if photographs else folders)
    return Moment(replace(snapshot, images=images), time.monotonic())


def _sanitize_snapshot(snapshot: Snapshot) -> Snapshot:
    """Removes Gaussians that cannot be drawn: what comes over the network is untrusted input."""
    return replace(snapshot, gaussians=sanitize_gaussians(snapshot.gaussians))
