"""The addresses of services and the options of their sockets: ipc in a private folder, or tcp with CURVE keys.

ZeroMQ behaves as follows (measured), hence this file. A second bind on an ipc path succeeds and takes it over: a lock
prevents it. A send without a receiver blocks for ever: no send waits. A pending message keeps a process from ending:
LINGER is 0. The answer to a heartbeat cannot overtake a part that is on its way: what takes longer than their time-out
would never arrive, so that there are none, and the kernel notices a dead link. A plain tcp socket gives the
application raw bytes from anybody: there is no tcp without CURVE. It accepts connections without end: a gate bounds
those that have no key. The number of parts of a message is not bounded: a peer that is let in could fill the memory,
which the services' MemoryMax limits.

Keys lie in a folder: `secret.key` (0600) and `public.key` of this machine, `allowed/NAME.key` with the public keys of
other machines that may connect here, and, where this machine connects to another one, that one's public key as
`server.key`. Processes on one machine share the folder; its own key is always let in. A key is 40 characters of Z85
text.

The gate: libzmq tells of each connection that it accepts, and closes it five seconds later where its handshake has not
come to its end. Meanwhile a stranger can open any number, each with one of our descriptors. So many may be in their
handshake here; for each further one the oldest is shut, of the address that has the most. Who has a key is let in
within a few round trips, is no more among those, and shares the places with nobody of another address. Which of them
are let in, libzmq does not tell; the kernel does, by the bytes that it has sent over a connection: READY, which a
server says to a key that it knows, is beyond what it says to anybody (ZeroMQ RFC 23 and 26).
"""

from __future__ import annotations

import contextlib
import errno
import logging
import math
import os
import re
import socket
import struct
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import zmq
from zmq.utils.monitor import recv_monitor_message

from splatnode.capture.messaging import messages
from splatnode.capture.process.files import (
    LockHeld,
    NotOwnerOnly,
    StrayFile,
    check_owner_only,
    default_runtime_directory,
    exclusive,
    make_owner_only_folder,
    read_own,
    remove_leftovers,
    write_atomically,
)
from splatnode.capture.process.system import make_sure_of_room, network_of, next_to_go, outlast, raise_file_limit
from splatnode.capture.process.terminal import is_logged
from splatnode.capture.process.text import guard_untrusted, sanitize_text

log = logging.getLogger(__name__)

PLACES = 32  # of a socket, for connections in their handshake
OVERSHOOT = 128  # of a process: connections that libzmq may accept before the gate has seen the first of them
_EVENTS = zmq.EVENT_ACCEPTED | zmq.EVENT_ACCEPT_FAILED | zmq.EVENT_DISCONNECTED | zmq.EVENT_MONITOR_STOPPED
_SAID_TO_ANYBODY = 64 + 170 + 14  # bytes: greeting, WELCOME, ERROR 400
_INFO_BYTES, _ACKED = 256, struct.Struct("120xQ")  # tcp_info of linux/tcp.h, with tcpi_bytes_acked, since Linux 4.1
_CLOSE_S = 5.0


class _Peer(NamedTuple):
    network: str
    port: int


class Gate:
    """Watches a bound TCP socket in a thread of its own, which needs no descriptor and no memory to speak of."""

    def __init__(self, bound: zmq.Socket, places: int = PLACES) -> None:
        self.shut = 0  # connections
        self._socket, self._places = bound, places
        self._monitor = bound.get_monitor_socket(_EVENTS)
        self._young: dict[int, _Peer] = {}  # by descriptor, the oldest first; some of them are let in already
        self._thread = threading.Thread(target=self._watch, name="gate", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """To be called while the socket is open."""
        self._socket.disable_monitor()
        self._thread.join(_CLOSE_S)

    def _watch(self) -> None:
        with self._monitor:
            while (event := recv_monitor_message(self._monitor))["event"] != zmq.EVENT_MONITOR_STOPPED:
                self._note(event["event"], event["value"])

    def _note(self, event: int, descriptor: int) -> None:
        if event == zmq.EVENT_ACCEPT_FAILED:  # no descriptor is free
            self._keep(self._places // 2)
            return
        self._young.pop(descriptor, None)
        if event == zmq.EVENT_ACCEPTED:
            peer = _peer(descriptor)
            if peer is not None:
                self._young[descriptor] = peer
            self._keep(self._places)

    def _keep(self, most: int) -> None:
        """Lets at most so many be in their handshake."""
        if len(self._young) <= most:
            return
        for descriptor in [each for each in self._young if _is_let_in(each)]:
            del self._young[descriptor]
        while len(self._young) > most:
            self._shut(next_to_go({each: peer.network for each, peer in self._young.items()}))

    def _shut(self, descriptor: int) -> None:
        """Leaves alone what is no connection of this peer any more; libzmq closes the others."""
        peer = self._young.pop(descriptor)
        if _peer(descriptor) != peer:
            return
        with _lent(descriptor) as connection, contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
        self.shut += 1
        if is_logged(self.shut):
            log.warning("too many connections without a key: shut one of %s (%d so far)", peer.network, self.shut)


@contextlib.contextmanager
def _lent(descriptor: int) -> Iterator[socket.socket]:
    """A socket of libzmq's, as one of Python's that does not close it."""
    connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, descriptor)
    try:
        yield connection
    finally:
        connection.detach()


def _peer(descriptor: int) -> _Peer | None:
    """Who is connected; None where the connection has ended meanwhile."""
    try:
        with _lent(descriptor) as connection:
            host, port = connection.getpeername()[:2]
            return _Peer(network_of(host), port)
    except (OSError, ValueError):
        return None


def _is_let_in(descriptor: int) -> bool:
    try:
        with _lent(descriptor) as connection:
            tcp_info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO_BYTES)
    except OSError:
        return False
    return len(tcp_info) >= _ACKED.size and _ACKED.unpack_from(tcp_info)[0] > _SAID_TO_ANYBODY


SECRET, PUBLIC, SERVER, ALLOWED = "secret.key", "public.key", "server.key", "allowed"
_KEY_BYTES = 40
_LARGEST = 1000  # bytes of a key's file
_READ_S = 1.0  # that a handshake waits where a key's file cannot be opened
_MOST_SAID = 100  # refused keys and connections
_Z85 = re.compile(rb"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")


class KeyFileError(PermissionError):
    """The keys cannot be used; the text names the file and what to do."""


@dataclass(frozen=True)
class Keys:
    public: bytes
    secret: bytes
    server: bytes  # of the machine whose services are connected to


def create_keys(folder: Path) -> bytes:
    """A new pair in `folder`, whose public key is returned; a secret key that was cut short is replaced, and said.

    Raises KeyFileError where there is a secret key already, NotOwnerOnly where others could change what is there.
    """
    _make(folder)
    if _is_cut(folder / SECRET):
        log.warning("the secret key in %s was cut short: this is a new pair, whose public key others need", folder)
    elif os.path.lexists(folder / SECRET):
        raise KeyFileError(f"{folder / SECRET} is there already; remove it to replace this machine's keys")
    public, secret = _key_pair()
    _write_key(folder / PUBLIC, public)
    _write_key(folder / SECRET, secret)  # last: where it is, the pair is
    return public


def allow(folder: Path, name: str, public: bytes) -> None:
    """Lets the machine `name` connect, at once: the list is read at each handshake. Raises ValueError, NotOwnerOnly."""
    if not re.fullmatch(r"[\w.-]{1,64}", name) or name.startswith("."):
        raise ValueError(f"a machine's name has letters, digits, - and _, got {name!r}")
    _make(folder)
    _write_key(folder / ALLOWED / f"{name}.key", check_key(public, name))


def expect_server(folder: Path, public: bytes) -> None:
    """Connects to services of the machine with this key, and to no other."""
    check_owner_only(folder)
    _write_key(folder / SERVER, check_key(public, SERVER))


def read_keys(folder: Path) -> Keys:
    """Raises KeyFileError where a key is missing, damaged, or others could read the secret or change any of them."""
    try:
        secret = _read_key(folder / SECRET)
        check_owner_only(folder)
        if (folder / SECRET).lstat().st_mode & 0o077:
            raise KeyFileError(f"{folder / SECRET} can be read by other users. Run: chmod 600 {folder / SECRET}")
        with guard_untrusted(KeyFileError, folder / SECRET):
            public = zmq.curve_public(secret)
        server = _read_key(folder / SERVER) if os.path.lexists(folder / SERVER) else public
    except NotOwnerOnly as error:
        raise KeyFileError(str(error)) from error
    return Keys(public, secret, server)


def check_key(text: bytes, where: object) -> bytes:
    """The key in `text`. Raises KeyFileError, which names `where` it came from."""
    key = text.strip()
    if not _Z85.fullmatch(key):
        raise KeyFileError(f"{where}: expected a key of 40 characters, got {len(key)} bytes. Run: splatnode keygen")
    return key


def _key_pair() -> tuple[bytes, bytes]:
    """Public and secret. A command line takes a word with a leading `-` for an option: no public key has one."""
    while True:
        public, secret = zmq.curve_keypair()
        if not public.startswith(b"-"):
            return public, secret


def _make(folder: Path) -> None:
    """The folder, and that of the allowed keys. Raises NotOwnerOnly, OSError."""
    for each in (folder, folder / ALLOWED):
        each.mkdir(mode=0o700, parents=True, exist_ok=True)
        check_owner_only(each)


def _is_cut(path: Path) -> bool:
    """True if the file has less than a key, as a full disk or a power cut may have left it."""
    try:
        return len(read_own(path, _LARGEST).strip()) < _KEY_BYTES
    except (FileNotFoundError, StrayFile):
        return False


def _write_key(path: Path, key: bytes) -> None:
    remove_leftovers(path.parent)
    write_atomically(path, [key + b"\n"])


def _read_key(path: Path) -> bytes:
    """Raises KeyFileError, and NotOwnerOnly where others could change it."""
    try:
        return check_key(read_own(path, _LARGEST, only_ours=True), path)
    except FileNotFoundError as error:
        raise KeyFileError(f"no key {path}. Run: splatnode keygen {path.parent}") from error
    except StrayFile as error:
        raise KeyFileError(str(error)) from error


class AllowList:
    """Tells at each handshake whether a key may connect; the interface is that of pyzmq's credentials provider."""

    def __init__(self, folder: Path, own: bytes) -> None:
        self.folder = folder
        self.own = own
        self._said: set[str] = set()

    def callback(self, domain: str, key: bytes) -> bool:
        try:
            allowed = key == self.own or key in outlast(self._list_keys, "whom to let in", _READ_S)
        except OSError as error:
            self._say(logging.ERROR, f"cannot read whom to let in, so nobody is: {error}")
            return False
        if not allowed:
            self._say(logging.WARNING, f"refused a connection: key {key.decode('ascii', 'replace')} is not allowed")
        return allowed

    def _list_keys(self) -> set[bytes]:
        """The keys that only this user can have put there; the others are said. Raises NotOwnerOnly, OSError."""
        for each in (self.folder.parent, self.folder):
            check_owner_only(each)
        found = set()
        for path in sorted(self.folder / name for name in os.listdir(self.folder) if name.endswith(".key")):
            try:
                found.add(_read_key(path))
            except (KeyFileError, NotOwnerOnly) as error:
                self._say(logging.ERROR, f"a key is not accepted: {error}")
        return found

    def _say(self, level: int, text: str) -> None:
        """Once: a stranger who tries again and again does not fill the journal."""
        if text not in self._said and len(self._said) < _MOST_SAID:
            self._said.add(text)
            more = "; nothing further is said of connections" if len(self._said) == _MOST_SAID else ""
            log.log(level, "%s%s (allowed are those in %s)", text, more, self.folder)


# The table of services: every message between the processes belongs to one of them.


class Pattern(Enum):
    QUEUE = "ROUTER binds, DEALER connects: acknowledged, nothing is lost"
    BROADCAST = "PUB binds, SUB connects: newest wins, losses are counted"
    STATE = "PUB and ROUTER bind, SUB and DEALER connect: newest wins, late subscribers ask for it"
    COMMANDS = "ROUTER binds, DEALER connects: request and reply"


@dataclass(frozen=True)
class Service:
    name: str
    pattern: Pattern
    tcp_port: int  # counted from the first port of the network

    @property
    def requests(self) -> Service:
        """Returns the service on which late subscribers ask for the state; it has a socket of its own."""
        return Service(f"{self.name}.requests", self.pattern, self.tcp_port + 1)

    def select_capture(self, camera_id: str) -> Service:
        """Returns capture's service where several captures run, each with a camera id; itself for the empty one."""
        return Service(f"{self.name}@{camera_id}", self.pattern, self.tcp_port) if camera_id else self


CAPTURE_KEYFRAMES = Service("capture.keyframes", Pattern.QUEUE, 0)
CAPTURE_PREVIEW = Service("capture.preview", Pattern.BROADCAST, 1)
CAPTURE_STATUS = Service("capture.status", Pattern.BROADCAST, 2)
RECON_SCENE = Service("recon.scene", Pattern.STATE, 3)  # and 4, for requests
RECON_STATUS = Service("recon.status", Pattern.BROADCAST, 5)
RECON_CONTROL = Service("recon.control", Pattern.COMMANDS, 6)
CAPTURE_CONTROL = Service("capture.control", Pattern.COMMANDS, 7)
RECON_MAP = Service("recon.map", Pattern.STATE, 8)  # and 9, for requests; where it is configured
RECON_DEPTH = Service("recon.depth", Pattern.STATE, 10)  # and 11, for requests
RECON_LOCATE = Service("recon.locate", Pattern.COMMANDS, 12)  # requests have an image; where it is configured


# Of a capture beside others: a part of the names of its sockets, its spool and its frames.
CAMERA_ID = "[A-Za-z0-9_-]{1,32}"  # a regular expression
CaptureId = Annotated[str, msgspec.Meta(pattern=rf"^(?:{CAMERA_ID})?\Z", max_length=32)]
_CAPTURE = re.compile(rf"capture\.keyframes(?:@({CAMERA_ID}))?")


REQUEST_BYTES = 64 << 10  # no request, acknowledgement or subscription is larger
REQUEST_LIMITS = messages.Limits(header_bytes=REQUEST_BYTES, arrays=0, total_bytes=2 * REQUEST_BYTES)
_ZAP_DOMAIN = "splatnode"
_MAX_FAILED_HANDSHAKES = 5  # in a row; one may fail because the other process was just ending
_RECONNECT_MS, _MAX_RECONNECT_MS = 100, 1000  # pause before connecting again, doubled up to the second
_HANDSHAKE_MS = 5000  # a connection whose handshake takes longer is closed
_DEAD_LINK_S = 10  # without a sign of the other machine, after which a tcp connection is given up, on both ends
_PROBES = 4  # of an idle connection in that time, after a first while of the same length
_FILES, _THREADS = 32, 4  # of which an endpoint has need: libzmq's two threads, one that lets in, one that keeps out
_LONGEST_IPC_PATH = 107  # sun_path, see unix(7)


class Network(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    # Of ipc sockets and locks. None: $RUNTIME_DIRECTORY, else $XDG_RUNTIME_DIR/splatnode, else a folder under /tmp.
    directory: Path | None = None
    tcp: str | None = None  # the address to bind (robot) or to connect to (other machine), in place of ipc; needs keys
    keys: Path | None = None  # the folder that `splatnode keygen` made; None: no keys, and so no tcp
    first_port: Annotated[int, msgspec.Meta(ge=1, le=65500)] = 47310  # of the tcp ports, which follow one another
    max_message_mb: Annotated[int, msgspec.Meta(ge=1, le=4096)] = 256  # a larger message is not taken, in 2^20 bytes

    @property
    def limits(self) -> messages.Limits:
        return messages.Limits(total_bytes=self.max_message_mb << 20)


def files_for_strangers(network: Network, sockets: int) -> int:
    """Descriptors that those without a key can take of a process that binds so many sockets."""
    return 0 if network.tcp is None else sockets * PLACES + OVERSHOOT


class NetworkError(PermissionError):
    """The network cannot be used as configured; the text says what to do."""


class AlreadyRunning(LockHeld):
    """Another process offers this service."""

    def __init__(self, service: Service, pid: int | None) -> None:
        who = f"process {pid}" if pid else "another process"
        super().__init__(
            f"{service.name} is offered by {who} already; stop it, or give another network.directory. Captures "
            "of several cameras each need a camera_id of their own (over tcp also a network.first_port)",
            pid,
        )


class NotAllowed(PermissionError):
    """The other machine does not let this one in, or is not the one that was expected."""


class Endpoint:
    """Sockets and what they need; `close` closes all that was opened. Subclasses define what is sent over them.

    One that offers a service holds its lock until its last socket is closed, so that it removes no other's ipc path.
    """

    def __init__(self, network: Network, offers: Service | None = None) -> None:
        """Raises AlreadyRunning, NetworkError, KeyFileError, LimitTooLow."""
        self.network = network
        self.refused = 0  # messages that could not be taken
        self.why_refused = ""  # the last of them
        self._resources = contextlib.ExitStack()
        with self._close_on_error():
            self._keys = _curve_keys(network)
            self._links: list[_Link] = []
            if offers is not None:
                raise_file_limit()
                self._lock(offers)
            make_sure_of_room(_FILES, _THREADS)
            self._context = zmq.Context()
            self._resources.callback(self._context.term)
            if offers is not None and self._keys is not None:
                self._resources.enter_context(_authenticator(self._context, network, self._keys))

    def close(self) -> None:
        self._resources.close()

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _refuse(self, what: str, why: object) -> None:
        """Counts a message that cannot be taken. The 1st, 2nd, 4th, 8th, ... is logged: nobody can fill the journal."""
        self.refused += 1
        self.why_refused = sanitize_text(why)
        if is_logged(self.refused):
            log.warning("refused %s (%d so far): %s", what, self.refused, self.why_refused)

    def _receive_requests(
        self, router: zmq.Socket, schema: Any, what: str, most: int, timeout_s: float
    ) -> Iterator[tuple[bytes, Any]]:
        """Yields who asks, and the requests (of `schema`) that came, waiting at most `timeout_s` for the first.

        At most `most` are read; a malformed one counts as refused, `what` is its name in the log.
        """
        for identity, message in self._receive_messages(router, schema, what, most, timeout_s, REQUEST_LIMITS):
            yield identity, message.header

    def _receive_messages(
        self, router: zmq.Socket, schema: Any, what: str, most: int, timeout_s: float, limits: messages.Limits
    ) -> Iterator[tuple[bytes, messages.Message[Any]]]:
        """As `_receive_requests`, with the arrays of the requests."""
        if not router.poll(max(0, math.ceil(timeout_s * 1000))):
            return
        for _ in range(most):
            try:
                identity, *parts = router.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            try:
                message = messages.decode(parts, schema, limits)
            except messages.WireError as error:
                self._refuse(what, error)
                continue
            yield identity, message

    def _lock(self, service: Service) -> None:
        try:
            self._resources.enter_context(exclusive(runtime_directory(self.network) / f"{service.name}.lock"))
        except LockHeld as error:
            raise AlreadyRunning(service, error.pid) from error

    def _bind(self, service: Service, kind: int, *, queue: int, largest: int = REQUEST_BYTES) -> zmq.Socket:
        """Raises AlreadyRunning, NetworkError, OSError. `largest`: bytes of a part of a request."""
        with self._close_on_error():
            socket = self._socket(kind, queue, largest)
            if self._keys is not None:
                socket.curve_server, socket.curve_secretkey = True, self._keys.secret
                socket.zap_domain = _ZAP_DOMAIN.encode()
            address = _address(self.network, service)
            if address.startswith("ipc://"):  # this process has the lock: a socket that lies there is a dead process's
                path = Path(address.removeprefix("ipc://"))
                path.unlink(missing_ok=True)
                self._resources.callback(path.unlink, missing_ok=True)
            try:
                socket.bind(address)
            except zmq.ZMQError as error:
                if error.errno == errno.EADDRINUSE:
                    raise AlreadyRunning(service, None) from error
                raise OSError(error.errno, f"cannot offer {service.name} at {address}: {error.strerror}") from error
            if self._keys is not None:
                self._resources.callback(Gate(socket).close)
            return socket

    def _connect(self, service: Service, kind: int, *, queue: int) -> zmq.Socket:
        """Succeeds whether or not the service is there: it may start later, end, and start again."""
        with self._close_on_error():
            socket = self._socket(kind, queue, largest=self.network.max_message_mb << 20)
            if self._keys is not None:
                socket.curve_publickey, socket.curve_secretkey = self._keys.public, self._keys.secret
                socket.curve_serverkey = self._keys.server
            if kind == zmq.SUB:
                socket.subscribe(b"")
            if kind == zmq.DEALER:
                socket.immediate = True  # a message to a process that is not there is not kept for a later one
            if self._keys is not None:
                self._links.append(_Link(self._resources, socket, _address(self.network, service)))
            socket.connect(_address(self.network, service))
            return socket

    def _check_links(self) -> None:
        """Raises NotAllowed."""
        for link in self._links:
            link.check()

    @contextlib.contextmanager
    def _close_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self.close()
            raise

    def _socket(self, kind: int, queue: int, largest: int) -> zmq.Socket:
        socket = self._resources.enter_context(self._context.socket(kind))
        socket.linger = 0
        socket.sndhwm = socket.rcvhwm = queue
        socket.maxmsgsize = largest
        socket.reconnect_ivl, socket.reconnect_ivl_max = _RECONNECT_MS, _MAX_RECONNECT_MS
        socket.handshake_ivl = _HANDSHAKE_MS
        if self.network.tcp is not None:
            _notice_dead_links(socket)
        return socket


class _Link:
    """The handshakes of a connecting socket, as libzmq's monitor reports them."""

    def __init__(self, resources: contextlib.ExitStack, socket: zmq.Socket, address: str) -> None:
        self._address = address
        self._failures = 0  # in a row
        self._monitor = socket.get_monitor_socket(
            zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
        )
        resources.callback(self._monitor.close, linger=0)
        resources.callback(socket.disable_monitor)

    def check(self) -> None:
        """Raises NotAllowed where the other end refused this machine, or does not have the expected key."""
        while self._monitor.poll(0):
            event = recv_monitor_message(self._monitor)["event"]
            if event == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
                raise NotAllowed(f"{self._address} does not let this machine in. Run there: splatnode keygen --allow")
            self._failures = 0 if event == zmq.EVENT_HANDSHAKE_SUCCEEDED else self._failures + 1
        if self._failures >= _MAX_FAILED_HANDSHAKES:
            raise NotAllowed(f"{self._address} does not have the key that server.key in network.keys expects of it")


def _notice_dead_links(socket: zmq.Socket) -> None:
    """Leaves it to the kernel: a message may take as long as a slow link needs, and a peer that hangs stays connected.

    Each pattern minds those itself, as over ipc: by requests that no longer come, by the age of what came.
    """
    socket.tcp_maxrt = 1000 * _DEAD_LINK_S  # TCP_USER_TIMEOUT: for data that nobody confirms
    socket.tcp_keepalive, socket.tcp_keepalive_cnt = 1, _PROBES
    socket.tcp_keepalive_idle = socket.tcp_keepalive_intvl = max(1, _DEAD_LINK_S // (_PROBES + 1))


def runtime_directory(network: Network) -> Path:
    """The private folder of sockets and locks, made where it is absent. Raises NetworkError where it is not private."""
    directory = network.directory or default_runtime_directory()
    try:
        make_owner_only_folder(directory, "network.directory (or $XDG_RUNTIME_DIR), for each process,", ours=False)
    except NotOwnerOnly as error:
        raise NetworkError(str(error)) from error
    return directory


def find_captures(network: Network) -> list[str]:
    """The camera ids of the captures whose sockets lie in the folder, also of one that was killed; empty: has no id.

    Over tcp there is one for each first port.
    """
    if network.tcp is not None:
        return [""]
    sockets = (path for path in runtime_directory(network).glob("capture.keyframes*") if path.is_socket())
    found = (_CAPTURE.fullmatch(path.name) for path in sockets)
    return sorted(each[1] or "" for each in found if each)


def _address(network: Network, service: Service) -> str:
    if network.tcp is not None:
        host = f"[{network.tcp}]" if ":" in network.tcp else network.tcp
        return f"tcp://{host}:{network.first_port + service.tcp_port}"
    path = runtime_directory(network) / service.name
    if len(os.fsencode(path)) > _LONGEST_IPC_PATH:
        raise NetworkError(f"{path} is too long for a socket (at most {_LONGEST_IPC_PATH} bytes); shorten the folder")
    return f"ipc://{path}"


def _curve_keys(network: Network) -> Keys | None:
    if network.tcp is None:
        return None
    if network.keys is None:
        raise NetworkError("network.tcp needs network.keys, or anybody could connect. Run: splatnode keygen FOLDER")
    return read_keys(network.keys)


@contextlib.contextmanager
def _authenticator(context: zmq.Context, network: Network, keys: Keys) -> Iterator[None]:
    """Decides at each handshake, in its own thread, whether a key may connect (ZAP, ZeroMQ RFC 27)."""
    from zmq.auth.thread import ThreadAuthenticator  # brings asyncio, which ipc does not need

    if network.keys is None:
        raise AssertionError("keys were read from network.keys")
    authenticator = ThreadAuthenticator(context)
    authenticator.start()
    try:
        authenticator.configure_curve_callback(_ZAP_DOMAIN, AllowList(network.keys / ALLOWED, keys.public))
        yield
    finally:
        authenticator.stop()
