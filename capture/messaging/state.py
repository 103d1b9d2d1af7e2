"""A state of which the newest counts, such as the scene for viewers: published, and sent to whoever asks.

It is published whenever it changes. A client that has just subscribed, or has received nothing for a while, asks for it
and says which one it has; the reply is the newest state, or nothing where the client has it, or it is on its way there.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy.typing as npt
import zmq

from splatnode.capture.messaging.network import REQUEST_LIMITS, Endpoint, Network
from splatnode.capture.messaging.services import Service
from splatnode.capture.messaging.values import Sequential, SessionId
from splatnode.capture.messaging.wire import Message, Part, WireError, decode, encode, size_bytes

ASK_EVERY_S = 1.0  # without a state
MAX_REQUESTS = 1000  # that one call of `serve` reads
MAX_MESSAGES = 8  # that are read at once; more than both queues hold
MOST_CLIENTS = 256  # of which it is known what is on its way to them
ENDED_SESSIONS = 16  # of senders, whose late messages are known to be old


class Want(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="want"):
    """The newest state, unless it is this one."""

    session: SessionId | None
    sequence: Sequential


class StateServer(Endpoint):
    """Offers `service`. Raises AlreadyRunning where another process does."""

    def __init__(self, service: Service, network: Network) -> None:
        super().__init__(network, offers=service)
        self._newest: tuple[tuple[str, int], list[Part]] | None = None
        self._sent: dict[bytes, tuple[str, int]] = {}  # to each connection last; it arrives, or the connection ends
        self._publisher = self._bind(service, zmq.PUB, queue=4)
        self._router = self._bind(service.requests, zmq.ROUTER, queue=2)
        self._router.router_mandatory = True  # what is not sent is said

    def publish(self, header: Any, arrays: Sequence[npt.NDArray] = ()) -> None:
        """Sends a state (its header is a wire.Header) and keeps it. The arrays must not be written to afterwards.

        Raises WireError where it is larger than a client takes: ZeroMQ would end the connection, again and again.
        """
        parts = encode(header, arrays)
        size, most = size_bytes(parts), self.network.limits
        if size > most.total_bytes:
            raise WireError(f"a state of {size / 1e6:.1f} MB; network.max_message_mb allows {most.total_bytes >> 20}")
        if len(parts[1]) > most.header_bytes:
            raise WireError(f"a state with a header of {len(parts[1])} bytes; at most {most.header_bytes} are taken")
        self._newest = (header.session, header.sequence), parts
        with contextlib.suppress(zmq.Again):
            self._publisher.send_multipart(parts, zmq.NOBLOCK, copy=False)

    def serve(self, timeout_s: float) -> None:
        """Replies to requests, waiting at most `timeout_s` for the first. To be called several times a second."""
        if not self._router.poll(max(0, math.ceil(timeout_s * 1000))):
            return
        wanted: dict[bytes, Want] = {}  # one reply to each client, however often it asks
        for _ in range(MAX_REQUESTS):
            try:
                identity, *parts = self._router.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                break
            try:
                wanted[identity] = decode(parts, Want, REQUEST_LIMITS).header
            except WireError as error:
                self._refuse("a request", error)
        for identity, want in wanted.items():
            self._reply(identity, want)

    def _reply(self, identity: bytes, want: Want) -> None:
        """Sends the newest state, once over a connection: over a slow link one asks again while it is arriving."""
        if self._newest is None or self._newest[0] in ((want.session, want.sequence), self._sent.get(identity)):
            return
        try:
            self._router.send_multipart([identity, *self._newest[1]], zmq.NOBLOCK, copy=False)
        except zmq.ZMQError:  # the client has not read the last reply yet, or has gone
            return
        self._sent[identity] = self._newest[0]
        while len(self._sent) > MOST_CLIENTS:
            del self._sent[next(iter(self._sent))]


class StateClient(Endpoint):
    """Receives the states of `service`, whether its sender is there already or comes later."""

    def __init__(self, service: Service, network: Network, schema: Any) -> None:
        super().__init__(network)
        self.schema = schema
        self._session: str | None = None
        self._sequence = 0
        self._ended: deque[str] = deque(maxlen=ENDED_SESSIONS)
        self._heard = self._asked = -math.inf
        self._subscriber = self._connect(service, zmq.SUB, queue=4)
        self._dealer = self._connect(service.requests, zmq.DEALER, queue=2)
        self._poller = zmq.Poller()
        self._poller.register(self._subscriber, zmq.POLLIN)
        self._poller.register(self._dealer, zmq.POLLIN)

    @property
    def age_s(self) -> float:
        """Seconds since a state came; infinite before the first."""
        return time.monotonic() - self._heard

    def poll(self, timeout_s: float) -> Message[Any] | None:
        """A state that is newer than the last one returned; None where none comes within `timeout_s`.

        A header with a new session is that of a restarted sender, which does not continue the session before.
        Raises NotAllowed.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            newest = self._drain(self._subscriber) or self._drain(self._dealer)
            if newest is not None:
                return newest
            self._check_links()
            self._ask()
            remaining = deadline - time.monotonic()
            if remaining <= 0:
                return None
            self._poller.poll(math.ceil(1000 * min(remaining, ASK_EVERY_S / 4)))

    def _ask(self) -> None:
        if min(self.age_s, time.monotonic() - self._asked) < ASK_EVERY_S:
            return
        with contextlib.suppress(zmq.Again):  # no sender is there: it asks again later
            self._dealer.send_multipart(encode(Want(self._session, self._sequence)), zmq.NOBLOCK)
            self._asked = time.monotonic()

    def _drain(self, socket: zmq.Socket) -> Message[Any] | None:
        newest = None
        for _ in range(MAX_MESSAGES):
            try:
                parts = socket.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                break
            try:
                message = decode(parts, self.schema, self.network.limits)
            except WireError as error:
                self._refuse("a state", error)
                continue
            if self._is_newer(message.header):
                newest = message
        return newest

    def _is_newer(self, header: Any) -> bool:
        if header.session in self._ended:
            return False
        if header.session == self._session and header.sequence <= self._sequence:
            return False
        if self._session not in (None, header.session):
            self._ended.append(self._session)
        self._session, self._sequence, self._heard = header.session, header.sequence, time.monotonic()
        return True
