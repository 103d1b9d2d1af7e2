"""PUB/SUB for previews and heartbeats, commands, queries, states, and the word among captures of one machine.

Of broadcasts the newest counts. Nobody waits for a slow reader; lost messages are counted.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy.typing as npt
import zmq

from splatnode.capture.frame import LARGEST_NS, Clock, Stamp
from splatnode.capture.messaging.messages import (
    Limits,
    Message,
    Part,
    Sequential,
    SessionId,
    Text,
    WireError,
    decode,
    encode,
    size_bytes,
)
from splatnode.capture.messaging.network import REQUEST_LIMITS, Endpoint, Network, Service, runtime_directory

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


# Request and reply: small commands to a running process.

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
        for identity, request in self._receive_requests(self._router, self.schema, "a command", QUEUE, timeout_s):
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


# Requests that bring arrays, such as an image, and take a while: a client has one under way, the newest.

ASKED_AT_ONCE = 2  # requests of a client that wait


class QueryServer(Endpoint):
    """Offers `service`, whose requests are a `schema` with arrays. Raises AlreadyRunning where another process does."""

    def __init__(self, service: Service, network: Network, schema: Any, limits: Limits) -> None:
        super().__init__(network, offers=service)
        self.schema, self._limits = schema, limits
        self._router = self._bind(service, zmq.ROUTER, queue=ASKED_AT_ONCE, largest=limits.total_bytes)

    def receive(self, timeout_s: float) -> list[tuple[bytes, Message[Any]]]:
        """Who asks, and the newest request of each, waiting at most `timeout_s` for the first."""
        found = self._receive_messages(self._router, self.schema, "a query", QUEUE, timeout_s, self._limits)
        return list(dict(found).items())

    def reply(self, identity: bytes, answer: msgspec.Struct) -> None:
        """Never waits: who has gone gets no answer."""
        with contextlib.suppress(zmq.ZMQError):
            self._router.send_multipart([identity, *encode(answer)], zmq.NOBLOCK)


class QueryClient(Endpoint):
    """Asks a QueryServer, whether it is there already or comes later. Requests and answers have a `number`."""

    def __init__(self, service: Service, network: Network, schema: Any) -> None:
        super().__init__(network)
        self._name, self.schema = service.name, schema
        self._dealer = self._connect(service, zmq.DEALER, queue=ASKED_AT_ONCE)

    def ask(self, request: Any, arrays: Sequence[npt.NDArray], timeout_s: float) -> Any:
        """The answer, a `schema`, with the request's number. Raises NoAnswer; NotAllowed; WireError."""
        until_s = time.monotonic() + timeout_s
        sent = False
        while (left_s := until_s - time.monotonic()) > 0:
            self._check_links()
            if not sent and self._dealer.poll(min(CONNECT_POLL_MS, math.ceil(1000 * left_s)), zmq.POLLOUT):
                self._dealer.send_multipart(encode(request, arrays), zmq.NOBLOCK)
                sent = True
            elif sent and self._dealer.poll(min(250, math.ceil(1000 * left_s))):
                answer = decode(self._dealer.recv_multipart(copy=False), self.schema, REQUEST_LIMITS).header
                if answer.number == request.number:  # else of one that nobody waits for any more
                    return answer
        raise NoAnswer(f"{self._name} did not answer within {timeout_s:g} s; is it on? See: splatnode status")


# A state of which the newest counts, such as the scene for viewers: published, and sent to whoever asks.
#
# It is published whenever it changes. A client that has just subscribed, or has received nothing for a while, asks for
# it and says which one it has; the reply is the newest state, or nothing where the client has it, or it is on its way
# there.

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
        """Sends a state (its header is a messages.Header) and keeps it. The arrays must not be written to afterwards.

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
        requests = self._receive_requests(self._router, Want, "a request", MAX_REQUESTS, timeout_s)
        for identity, want in dict(requests).items():  # one reply to each client, however often it asks
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


# Between the captures of one machine: at which times each took a keyframe, so that the others take theirs; and that one
# has no room: the others keep no part of a frame set then.
#
# Datagrams in the private folder of the sockets, also where keyframes go over tcp. Nobody waits for one, and one that
# is lost costs a frame set an image.

_LINK = "capture.together@"  # begins the names of the sockets
_DATAGRAM = struct.Struct("<4sBq")  # mark, clock by its place in Clock, nanoseconds
_TAKEN, _FULL = b"SET1", b"FUL1"
FULL_S = 2.0  # for which the word of one that has no room counts; it says so again and again
_CLOCKS = tuple(Clock)
_MOST_RECEIVED = 100  # datagrams at a time


class FrameSetLink:
    """One capture's end, for a capture with a camera id. Close it, or use it as a context manager."""

    def __init__(self, network: Network, camera_id: str) -> None:
        """To be made by the one process that offers this camera's keyframes. Raises NetworkError, OSError."""
        self._path = runtime_directory(network) / f"{_LINK}{camera_id}"
        self._full_s = -math.inf  # when another said last that it has no room (monotonic)
        self._path.unlink(missing_ok=True)  # of a process that was killed
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.bind(str(self._path))
        except BaseException:
            self._socket.close()
            raise

    def __enter__(self) -> FrameSetLink:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._socket.close()
        self._path.unlink(missing_ok=True)

    def announce(self, stamp: Stamp) -> None:
        """Tells the others that a keyframe was taken then. One that does not listen, or not now, is left out."""
        self._send(_TAKEN, _CLOCKS.index(stamp.clock), stamp.ns)

    def announce_full(self) -> None:
        """Tells the others that there is no room for this camera's keyframes."""
        self._send(_FULL, 0, 0)

    def _send(self, mark: bytes, clock: int, ns: int) -> None:
        message = _DATAGRAM.pack(mark, clock, ns)
        for path in self._list_others():
            with contextlib.suppress(OSError):
                self._socket.sendto(message, str(path))

    def receive(self) -> list[Stamp]:
        """The times at which others took keyframes since the last call."""
        found = []
        for _ in range(_MOST_RECEIVED):
            try:
                data = self._socket.recv(_DATAGRAM.size + 1)
            except OSError:
                break
            if data == _DATAGRAM.pack(_FULL, 0, 0):
                self._full_s = time.monotonic()
            elif (stamp := _parse_datagram(data)) is not None:
                found.append(stamp)
        return found

    @property
    def is_another_full(self) -> bool:
        """Whether another has no room, by what was received."""
        return time.monotonic() - self._full_s < FULL_S

    def _list_others(self) -> list[Path]:
        return [path for path in self._path.parent.glob(f"{_LINK}*") if path != self._path and path.is_socket()]


def _parse_datagram(data: bytes) -> Stamp | None:
    """None for what no capture of this version sends."""
    if len(data) != _DATAGRAM.size:
        return None
    mark, clock, ns = _DATAGRAM.unpack(data)
    is_known = mark == _TAKEN and clock < len(_CLOCKS) and 0 <= ns <= LARGEST_NS
    return Stamp(ns, _CLOCKS[clock]) if is_known else None
