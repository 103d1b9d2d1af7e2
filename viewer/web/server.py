"""Answers what the page asks for. It takes no orders: requests have no body, and no question changes anything.

One thread a request; a visitor who is slow, silent or gone costs no more than that thread for a while. Those who have
not shown yet that they may look have places of their own, and where these are full, the oldest of the machine that has
the most must go: they take no place from who has the key.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import json
import logging
import socket
import socketserver
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, NamedTuple
from urllib.parse import parse_qs

from splatnode.capture.process.crowd import network_of, next_to_go
from splatnode.viewer.web.access import Access
from splatnode.viewer.web.board import Board, BoardState

log = logging.getLogger(__name__)

_MOST_REQUESTS = 64  # at a time, of those who may look
_MOST_VISITORS = 32  # at a time, who have not shown yet that they may look
_HEAD_S = 5.0  # in which a visitor must have shown that
_STUCK_S = 20.0  # without a byte sent or taken
_WAIT_S = 10.0  # for something new
_CHUNK = 1 << 16  # bytes
_MOST_DIGITS = 9
_TYPES = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; worker-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class _Visitor(NamedTuple):
    """A connection that has not shown yet that it may look."""

    network: str
    until_s: float  # monotonic


class Server(ThreadingHTTPServer):
    """Listens from the start, and answers once `start` was called. Raises OSError where it cannot listen."""

    daemon_threads = True
    request_queue_size = 128  # connections that the kernel holds until they are taken in; with 5, a crowd fills it

    def __init__(self, board: Board, address: str, port: int, key: str | None) -> None:
        self.board = board
        self._free = threading.BoundedSemaphore(_MOST_REQUESTS)
        self._running = threading.BoundedSemaphore(
            _MOST_REQUESTS + 2 * _MOST_VISITORS
        )  # visitors who go still have one
        self._visitors: dict[socket.socket, _Visitor] = {}  # the oldest first
        self._lock = threading.Lock()  # of the visitors
        if ipaddress.ip_address(address).version == 6:
            self.address_family = socket.AF_INET6
        self.pages = _pages()
        Access(address, port, key)  # raises before anything is bound
        try:
            super().__init__((address, port), _Request)
        except OSError as error:
            taken = "another program listens there" if error.errno == errno.EADDRINUSE else error.strerror
            text = f"cannot listen on {address}, port {port}: {taken}. --port takes another port"
            raise OSError(error.errno, text) from error
        self.access = Access(address, self.server_address[1], key)

    def server_bind(self) -> None:
        socketserver.TCPServer.server_bind(self)  # HTTPServer asks name servers for the machine's name, and waits

    def start(self) -> None:
        threading.Thread(target=partial(self.serve_forever, 0.1), name="web", daemon=True).start()

    def process_request(self, request, client_address) -> None:
        if not self._running.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            self._take_in(request, network_of(client_address[0]))
            super().process_request(request, client_address)
        except BaseException:  # no thread could be started, which would have given it back
            self._forget(request)
            self._running.release()
            raise

    def process_request_thread(self, request, client_address) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._running.release()

    def service_actions(self) -> None:
        """Hangs up on visitors who have had their time."""
        now = time.monotonic()
        with self._lock:
            for request in [each for each, visitor in self._visitors.items() if visitor.until_s <= now]:
                self._hang_up(request)

    def shutdown_request(self, request) -> None:
        self._forget(request)  # before it is closed: its descriptor is another's then
        super().shutdown_request(request)

    @contextlib.contextmanager
    def place_of(self, request: socket.socket) -> Iterator[bool]:
        """A place among those who may look; False where there is none."""
        self._forget(request)
        is_free = self._free.acquire(blocking=False)
        try:
            yield is_free
        finally:
            if is_free:
                self._free.release()

    def _take_in(self, request: Any, network: str) -> None:
        with self._lock:
            self._visitors[request] = _Visitor(network, time.monotonic() + _HEAD_S)
            while len(self._visitors) > _MOST_VISITORS:
                self._hang_up(next_to_go({each: visitor.network for each, visitor in self._visitors.items()}))

    def _forget(self, request: Any) -> None:
        with self._lock:
            self._visitors.pop(request, None)

    def _hang_up(self, request: socket.socket) -> None:
        """Its thread ends then."""
        del self._visitors[request]
        try:
            request.shutdown(socket.SHUT_RDWR)
        except OSError:
            log.debug("a visitor was gone already")

    def handle_error(self, request, client_address) -> None:
        """A visitor who goes in the middle of an answer is no error."""
        error = sys.exception() if sys.version_info >= (3, 11) else sys.exc_info()[1]
        level = logging.DEBUG if isinstance(error, OSError) else logging.WARNING
        log.log(level, "a request was not answered: %s", error, exc_info=level > logging.DEBUG)


class _Request(BaseHTTPRequestHandler):
    server: Server
    server_version, sys_version = "splatnode", ""
    error_message_format, error_content_type = "%(code)d %(message)s\n", "text/plain; charset=utf-8"
    timeout = _STUCK_S

    def do_GET(self) -> None:
        access, (path, _, query) = self.server.access, self.path.partition("?")
        try:
            asked = {name: values[0] for name, values in parse_qs(query, max_num_fields=4).items()}
        except ValueError:
            return self._refuse(HTTPStatus.BAD_REQUEST, "this question is not understood")
        if not access.is_allowed_host(self.headers.get("Host")):
            return self._refuse(
                HTTPStatus.FORBIDDEN, "without a key the address must be 127.0.0.1 or localhost (over ssh -L)"
            )
        if path == "/" and access.is_key(asked.get("key")):
            return self._remember_key()
        if not access.is_authorized(self.headers.get("Authorization"), self.headers.get("Cookie")):
            return self._refuse(
                HTTPStatus.UNAUTHORIZED,
                "the key is missing or wrong: open the address that splatnode view --web prints",
            )
        with self.server.place_of(self.connection) as is_free:
            if not is_free:
                return self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, "too many look at this scene just now: try again")
            self._answer(path, asked)

    def _answer(self, path: str, asked: dict[str, str]) -> None:
        board = self.server.board
        if path == "/told":
            (number,) = _numbers([asked.get("number", "")]) or (-1,)
            shown = board.wait(asked.get("run", ""), number, _WAIT_S)
            return self._send("application/json", _encode_state(board, shown))
        kind, data = self.server.pages.get(path) or _find_part(board.current, path) or ("", None)
        if data is None:
            return self._refuse(HTTPStatus.NOT_FOUND, "there is no such thing, or no longer")
        self._send(kind, data)

    def _send(self, kind: str, data: bytes) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        for start in range(0, len(data), _CHUNK):  # each of them has its own time
            self.wfile.write(data[start : start + _CHUNK])

    def _remember_key(self) -> None:
        """The key goes from the address, which others may see, into a cookie, and the browser asks again."""
        access = self.server.access
        self.send_response(HTTPStatus.SEE_OTHER)
        self.send_header("Location", "/")
        self.send_header("Set-Cookie", f"{access.cookie}={access.key}; HttpOnly; SameSite=Lax; Path=/")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self.send_error(status, why)

    def end_headers(self) -> None:
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not logged: the page asks all the time, and an address may hold a key."""


def _encode_state(board: Board, shown: BoardState) -> bytes:
    content = shown.content
    return json.dumps(
        {
            "run": board.run,
            "number": shown.number,
            "gaussians": shown.gaussians,
            "shapes": shown.shapes,
            "age_s": round(time.monotonic() - content.moment.received_s, 3) if content and shown.live else None,
            "said": shown.said,
        }
    ).encode()


def _find_part(shown: BoardState, path: str) -> tuple[str, bytes | None] | None:
    """Gaussians, shapes or a photograph of what is shown; None for anything else, and for an earlier version."""
    content, (kind, *numbers) = shown.content, path.removeprefix("/").split("/")
    versions = _numbers(numbers)
    if content is None or not versions:
        return None
    if kind == "gaussians" and versions == [shown.gaussians]:
        return "application/octet-stream", content.gaussians
    if kind == "shapes" and versions == [shown.shapes]:
        return "application/octet-stream", content.shapes
    if kind in ("thumbnail", "photograph") and len(versions) == 2 and versions[0] == shown.shapes:
        return "image/jpeg", content.encode_image(versions[1], small=kind == "thumbnail")
    return None


def _numbers(texts: list[str]) -> list[int]:
    """Whole numbers; none where one of them is something else or very long."""
    fine = all(text.isdecimal() and len(text) <= _MOST_DIGITS for text in texts)
    return [int(text) for text in texts] if fine else []


def _pages() -> dict[str, tuple[str, bytes]]:
    """Returns the static files by their request path."""
    files = resources.files("splatnode.viewer.web").joinpath("page").iterdir()
    found = {f"/{file.name}": (_TYPES[file.name.rpartition(".")[2]], file.read_bytes()) for file in files}
    return found | {"/": found["/index.html"]}
