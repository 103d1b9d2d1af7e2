"""The captures that recon receives from, one or several, and the frame sets of what they send."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated

import msgspec
import zmq

from splatnode.capture.frame import Frame, Stamp
from splatnode.capture.messaging.keyframe_queue import READY_EVERY_S, KeyframeClient
from splatnode.capture.messaging.messages import ReceivedFrame
from splatnode.capture.messaging.network import Network, find_captures
from splatnode.capture.rig import TOLERANCE_S, are_taken_together

LOOK_S = 0.5  # between looks at whether another capture has come
MOST_CAPTURES = 32
CONNECT_S = 1.0  # in which a capture that has been found sends what waits with it
ACTIVE_S = 3.0  # a camera that has sent a keyframe within so many seconds is waited for


class FrameSetConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which keyframes of several cameras belong together."""

    # Between images that were taken together, seconds. Higher: cameras that are not triggered together form sets, too
    tolerance_s: Annotated[float, msgspec.Meta(ge=0, le=10)] = TOLERANCE_S
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
        self._config = config
        self._waiting: list[WaitingFrame] = []
        self._heard_s: dict[str, float] = {}  # of each camera, when its last keyframe came

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, frame: WaitingFrame) -> None:
        self._waiting.append(frame)
        if frame.camera_id:
            self._heard_s[frame.camera_id] = frame.arrived_s

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
        if not is_whole and now_s - first.arrived_s < self._config.wait_s:
            return []
        found = [first] if alone else self._find_set(first)
        self._waiting = [each for each in self._waiting if each not in found]
        return found

    def _is_whole(self, now_s: float) -> bool:
        """Whether a frame of each camera that sends is there: what comes later belongs to none that is before those."""
        active = {camera for camera, heard_s in self._heard_s.items() if now_s - heard_s < ACTIVE_S}
        return active <= {each.camera_id for each in self._waiting}

    def _find_set(self, first: WaitingFrame) -> list[WaitingFrame]:
        """The first frame, and the earliest of each other camera that was taken with it, in order of time."""
        begun, found = first.captured_at, {first.camera_id: first}
        for each in sorted(self._waiting, key=lambda each: each.capture_ns):
            stamp = each.captured_at
            if begun and stamp and are_taken_together(begun, stamp, self._config.tolerance_s):
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
