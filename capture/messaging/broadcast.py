"""PUB/SUB for previews and heartbeats: the newest counts. Nobody waits for a slow reader; lost messages are counted."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy.typing as npt
import zmq

from splatnode.capture.messaging.network import Endpoint, Network
from splatnode.capture.messaging.services import Service
from splatnode.capture.messaging.wire import Message, WireError, decode, encode

SEND_QUEUE = 16  # messages to one slow reader; a PUB socket drops further ones


class Publisher(Endpoint):
    """Offers `service`. Raises AlreadyRunning where another process does."""

    def __init__(self, service: Service, network: Network) -> None:
        super().__init__(network, offers=service)
        self._socket_out = self._bind(service, zmq.PUB, queue=SEND_QUEUE)

    def send(self, header: msgspec.Struct, arrays: Sequence[npt.NDArray] = ()) -> None:
        """Never waits. The arrays must not be written to afterwards: they are sent from where they are."""
        with contextlib.suppress(zmq.Again):  # slow readers do not cause it, connections that are being closed do
            self._socket_out.send_multipart(encode(header, arrays), zmq.NOBLOCK, copy=False)


class Subscriber(Endpoint):
    """Receives what `service` sends, whether its sender is there already or comes later."""

    def __init__(self, service: Service, network: Network, schema: Any, queue: int = 64) -> None:
        """`queue`: messages kept while the reader is away, which should hold the time between two reads."""
        super().__init__(network)
        self.schema = schema
        self.lost = 0  # messages of the present session that were sent and never came
        self._session, self._sequence = "", -1
        self._heard = -math.inf
        self._socket_in = self._connect(service, zmq.SUB, queue=queue)

    @property
    def age_s(self) -> float:
        """Seconds since a message came; infinite before the first."""
        return time.monotonic() - self._heard

    def latest(self, timeout_s: float) -> Message[Any] | None:
        """The newest message, older ones skipped; None where none comes within `timeout_s`. Raises NotAllowed."""
        deadline = time.monotonic() + timeout_s
        while True:
            newest = self._drain()
            self._check_links()
            remaining = deadline - time.monotonic()
            if newest is not None or remaining <= 0 or not self._socket_in.poll(math.ceil(remaining * 1000)):
                return newest

    def _drain(self) -> Message[Any] | None:
        newest = None
        for _ in range(self._socket_in.rcvhwm + 1):  # an end, however fast the sender is
            try:
                parts = self._socket_in.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                break
            try:
                newest = decode(parts, self.schema, self.network.limits)
            except WireError as error:
                self._refuse("a message", error)
            else:
                self._count(newest.header)
        return newest

    def _count(self, header: Any) -> None:
        if header.session == self._session and header.sequence > self._sequence:
            self.lost += header.sequence - self._sequence - 1
        self._session, self._sequence = header.session, header.sequence
        self._heard = time.monotonic()
