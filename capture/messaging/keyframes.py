"""Keyframes from capture to recon, none of which is lost once it is offered.

    capture                                      recon
      offer: to the spool on disk     <------    Ready(capacity, holding): at start and every half second
      send while there is capacity    ------>    receive: each frame once
                                                 checkpoint
      remove from the spool           <------    Acknowledge(session, sequence)

Either process may die at any moment. A frame that is not acknowledged stays in the spool and is sent to the next
connection that is ready and does not hold it. An acknowledged one is in recon's checkpoint; if it comes again, because
capture died before it removed it, it is acknowledged again and not delivered.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

import zmq

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.messaging.keyframe_messages import (
    Acknowledge,
    DroppedHeader,
    FrameHeader,
    Ready,
    ReceivedFrame,
    received,
    to_message,
)
from splatnode.capture.messaging.network import REQUEST_LIMITS, Endpoint, Network
from splatnode.capture.messaging.services import CAPTURE_KEYFRAMES
from splatnode.capture.messaging.spool import Key, Spool
from splatnode.capture.messaging.wire import Numbering, WireError, decode, encode

log = logging.getLogger(__name__)

READY_EVERY_S = 0.5
FORGET_CLIENT_S = 20.0  # without a request, a client counts as gone
REMEMBERED = 10_000  # acknowledged frames that recon recognises if they come again
QUEUE = 64  # messages in a socket; as many as a client may hold (Ready.capacity)
MAX_REQUESTS = 1000  # that one call of `serve` reads


@dataclass
class _Client:
    """One connection. What was sent over it arrives, or the connection ends."""

    capacity: int = 0
    outstanding: set[Key] = field(default_factory=set)  # sent or held, not acknowledged
    heard: float = 0.0


class KeyframeServer(Endpoint):
    """Capture's end: sends what lies in the spool until it is acknowledged."""

    def __init__(self, network: Network, spool: Spool) -> None:
        """Takes the spool over and closes it. Raises AlreadyRunning where another process offers keyframes."""
        with contextlib.ExitStack() as taken:
            taken.callback(spool.close)
            super().__init__(network, offers=CAPTURE_KEYFRAMES)
            self._resources.push(taken.pop_all())
        self.spool = spool
        self.numbering = Numbering()
        self.refused = 0  # malformed requests
        self.acknowledged = 0
        self._clients: dict[bytes, _Client] = {}
        self._router = self._bind(CAPTURE_KEYFRAMES, zmq.ROUTER, queue=QUEUE)
        self._router.router_mandatory = True  # a connection that is gone says so

    @property
    def queued(self) -> int:
        """Frames that nobody has acknowledged."""
        return len(self.spool)

    @property
    def connected(self) -> bool:
        return bool(self._clients)

    def offer(self, frame: Frame | DroppedFrame) -> Key:
        """Takes the frame over: on the disk when this returns. Raises SpoolFull, OSError, WireError (too large)."""
        message = to_message(frame, self.numbering)
        size = sum(memoryview(part).nbytes for part in message)
        if size > self.network.limits.total_bytes:
            raise WireError(f"{frame.name}: {size >> 20} MB; network.max_message_mb allows less")
        key = Key(self.numbering.session, self.numbering.sequence - 1)
        self.spool.put(key, message)
        self._send_due()
        return key

    def serve(self, timeout_s: float) -> None:
        """Handles the requests that came, waiting at most `timeout_s` for the first."""
        if self._router.poll(max(0, math.ceil(timeout_s * 1000))):
            for _ in range(MAX_REQUESTS):
                try:
                    identity, *parts = self._router.recv_multipart(zmq.NOBLOCK)
                except zmq.Again:
                    break
                self._answer(identity, parts)
        now = time.monotonic()
        self._clients = {name: client for name, client in self._clients.items() if now - client.heard < FORGET_CLIENT_S}
        self._send_due()

    def _answer(self, identity: bytes, parts: list[bytes]) -> None:
        try:
            request = decode(parts, Ready | Acknowledge, REQUEST_LIMITS).header
        except WireError:
            self.refused += 1
            return
        client = self._clients.setdefault(identity, _Client())
        client.heard = time.monotonic()
        if isinstance(request, Ready):
            client.capacity = request.capacity
            client.outstanding |= {key for pair in request.holding if (key := Key(*pair)) in self.spool}
            return
        key = Key(request.session, request.sequence)
        if key in self.spool:
            self.spool.remove(key)
            self.acknowledged += 1
        for each in self._clients.values():
            each.outstanding.discard(key)

    def _send_due(self) -> None:
        for identity, client in tuple(self._clients.items()):
            for key in self.spool:
                if len(client.outstanding) >= client.capacity:
                    break
                if key not in client.outstanding and not self._send(identity, client, key):
                    break

    def _send(self, identity: bytes, client: _Client, key: Key) -> bool:
        """False where this client cannot take more now."""
        try:
            parts = self.spool.get(key)
        except (OSError, ValueError) as error:
            log.error("a keyframe is lost on the disk: %s", error)
            self.spool.set_aside(key)
            return True
        try:
            self._router.send_multipart([identity, *parts], zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return False
        except zmq.ZMQError:  # host unreachable: the connection is gone
            del self._clients[identity]
            return False
        client.outstanding.add(key)
        return True


class KeyframeClient(Endpoint):
    """Recon's end: receives each keyframe once and acknowledges it."""

    def __init__(self, network: Network, seen: Iterable[tuple[str, int]] = (), capacity: int = 4) -> None:
        """`seen`: what the checkpoint holds. `capacity`: frames that may be here without being acknowledged."""
        super().__init__(network)
        self.capacity = capacity
        self.refused = 0  # malformed messages
        self.duplicates = 0
        self._held: dict[Key, None] = {}  # delivered, not acknowledged
        self._seen: dict[Key, None] = dict.fromkeys(Key(*pair) for pair in seen)
        self._received: deque[ReceivedFrame] = deque()
        self._ready_said = -math.inf
        self._dealer = self._connect(CAPTURE_KEYFRAMES, zmq.DEALER, queue=QUEUE)

    def receive(self, timeout_s: float) -> ReceivedFrame | None:
        """The next frame, oldest first, each once; None where none comes in `timeout_s`. Raises NotAllowed."""
        deadline = time.monotonic() + timeout_s
        while True:
            self._check_links()
            self._say_ready()
            self._take_in()
            if self._received:
                return self._received.popleft()
            remaining = deadline - time.monotonic()
            if remaining <= 0:
                return None
            self._dealer.poll(math.ceil(1000 * min(remaining, READY_EVERY_S)))

    def acknowledge(self, frame: ReceivedFrame) -> None:
        """To be called once the frame is on the disk, so that it survives this process."""
        self._held.pop(frame.key, None)
        self._seen[frame.key] = None
        while len(self._seen) > REMEMBERED:
            del self._seen[next(iter(self._seen))]
        self._say_acknowledged(frame.key)

    def _take_in(self) -> None:
        for _ in range(self.capacity + 1):
            try:
                parts = self._dealer.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            try:
                frame = received(decode(parts, FrameHeader | DroppedHeader, self.network.limits))
            except WireError as error:
                self.refused += 1
                if (
                    self.refused.bit_count() == 1
                ):  # the 1st, 2nd, 4th, 8th, ...: a faulty sender does not fill the journal
                    log.warning("refused a keyframe (%d so far): %s", self.refused, error)
                continue
            if frame.key in self._seen:
                self.duplicates += 1
                self._say_acknowledged(frame.key)
            elif frame.key not in self._held:
                self._held[frame.key] = None
                self._received.append(frame)

    def _say_ready(self) -> None:
        if time.monotonic() - self._ready_said < READY_EVERY_S:
            return
        self._ready_said = time.monotonic()
        self._say(Ready(self.capacity, [(key.session, key.sequence) for key in self._held]))

    def _say_acknowledged(self, key: Key) -> None:
        self._say(Acknowledge(*key))

    def _say(self, request: Ready | Acknowledge) -> None:
        """Sends a request. Where an acknowledgement cannot be sent, the frame comes again and is recognised."""
        try:
            self._dealer.send_multipart(encode(request), zmq.NOBLOCK)
        except zmq.Again:
            log.debug("capture is not there")
