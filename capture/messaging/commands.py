"""Request and reply: small commands to a running process."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from typing import Any

import msgspec
import zmq

from splatnode.capture.messaging.network import REQUEST_LIMITS, Endpoint, Network
from splatnode.capture.messaging.services import Service
from splatnode.capture.messaging.values import Text
from splatnode.capture.messaging.wire import WireError, decode, encode

QUEUE = 16  # requests that wait, and that one call of `serve` replies to
CONNECT_POLL_MS = 20  # between looks at whether the service refuses this machine


class MarkProblemsSeen(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="seen"):
    """Somebody has seen the problems that the status tells; they need not be told again."""


class Answer(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="answer"):
    done: bool
    message: Text


class NoAnswer(RuntimeError):
    """Nobody answered in time."""

    exit_code = 75


class CommandServer(Endpoint):
    """Offers `service`, whose requests are a `schema`. Raises AlreadyRunning where another process does."""

    def __init__(self, service: Service, network: Network, schema: Any) -> None:
        super().__init__(network, offers=service)
        self.schema = schema
        self._router = self._bind(service, zmq.ROUTER, queue=QUEUE)

    def serve(self, timeout_s: float, reply: Callable[[Any], msgspec.Struct]) -> None:
        """Replies to the requests that came, waiting at most `timeout_s` for the first."""
        if not self._router.poll(max(0, math.ceil(timeout_s * 1000))):
            return
        for _ in range(QUEUE):
            try:
                identity, *parts = self._router.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            try:
                request = decode(parts, self.schema, REQUEST_LIMITS).header
            except WireError as error:
                self._refuse("a command", error)
                continue
            with contextlib.suppress(zmq.Again):
                self._router.send_multipart([identity, *encode(reply(request))], zmq.NOBLOCK)


class _Asker(Endpoint):
    def __init__(self, service: Service, network: Network) -> None:
        super().__init__(network)
        self.dealer = self._connect(service, zmq.DEALER, queue=QUEUE)
        self.check = self._check_links


def ask(service: Service, network: Network, request: msgspec.Struct, schema: Any, timeout_s: float = 5.0) -> Any:
    """The reply, a `schema`. Raises NoAnswer; NotAllowed; WireError where the reply is malformed."""
    deadline = time.monotonic() + timeout_s
    silence = NoAnswer(f"{service.name} did not answer within {timeout_s:g} s; is it running? See: splatnode status")
    with _Asker(service, network) as asker:
        while not asker.dealer.poll(CONNECT_POLL_MS, zmq.POLLOUT):  # until it is connected
            asker.check()
            if time.monotonic() > deadline:
                raise silence
        asker.dealer.send_multipart(encode(request), zmq.NOBLOCK)
        if not asker.dealer.poll(max(0, math.ceil(1000 * (deadline - time.monotonic())))):
            raise silence
        return decode(asker.dealer.recv_multipart(copy=False), schema, REQUEST_LIMITS).header
