"""A question and its answer: small commands to a running process."""

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
from splatnode.capture.messaging.wire import WireError, decode, encode


class NoAnswer(RuntimeError):
    """Nobody answered in time."""

    exit_code = 75


class CommandServer(Endpoint):
    """Offers `service`, whose questions are a `schema`. Raises AlreadyRunning where somebody does."""

    def __init__(self, service: Service, network: Network, schema: Any) -> None:
        super().__init__(network, offers=service)
        self.schema = schema
        self.refused = 0  # malformed
        self._router = self._bind(service, zmq.ROUTER, queue=16)

    def serve(self, timeout_s: float, answer: Callable[[Any], msgspec.Struct]) -> None:
        """Answers what came, waiting at most `timeout_s` for the first question."""
        if not self._router.poll(max(0, math.ceil(timeout_s * 1000))):
            return
        for _ in range(16):
            try:
                identity, *parts = self._router.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            try:
                question = decode(parts, self.schema, REQUEST_LIMITS).header
            except WireError:
                self.refused += 1
                continue
            with contextlib.suppress(zmq.Again):
                self._router.send_multipart([identity, *encode(answer(question))], zmq.NOBLOCK)


class _Asker(Endpoint):
    def __init__(self, service: Service, network: Network) -> None:
        super().__init__(network)
        self.dealer = self._connect(service, zmq.DEALER, queue=16)
        self.check = self._check_links


def ask(service: Service, network: Network, question: msgspec.Struct, schema: Any, timeout_s: float = 5.0) -> Any:
    """The answer, a `schema`. Raises NoAnswer; NotAllowed; WireError where what came is none."""
    deadline = time.monotonic() + timeout_s
    silence = NoAnswer(f"{service.name} did not answer within {timeout_s:g} s; is it running? See: splatnode status")
    with _Asker(service, network) as asker:
        while not asker.dealer.poll(20, zmq.POLLOUT):  # until it is connected
            asker.check()
            if time.monotonic() > deadline:
                raise silence
        asker.dealer.send_multipart(encode(question), zmq.NOBLOCK)
        if not asker.dealer.poll(max(0, math.ceil(1000 * (deadline - time.monotonic())))):
            raise silence
        return decode(asker.dealer.recv_multipart(copy=False), schema, REQUEST_LIMITS).header
