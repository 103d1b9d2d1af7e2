"""The viewer in a browser: a page that draws, and a small server that only answers what it is asked for.

The server answers what the page asks for. It takes no orders: requests have no body, and no question changes anything.
One thread a request; a visitor who is slow, silent or gone costs no more than that thread for a while. Those who have
not shown yet that they may look have places of their own, and where these are full, the oldest of the machine that has
the most must go: they take no place from who has the key.
"""

from __future__ import annotations

import contextlib
import errno
import hmac
import ipaddress
import json
import logging
import re
import secrets
import socket
import socketserver
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple, NoReturn
from urllib.parse import parse_qs

import cv2
import numpy as np

from splatnode.capture.process.files import NotOwnerOnly, read_own, write_atomically
from splatnode.capture.process.system import network_of, next_to_go
from splatnode.capture.process.text import sanitize_text
from splatnode.recon.result.export.formats.splat import encode_splat
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.verdict import Code
from splatnode.viewer import session as viewer_text
from splatnode.viewer.analysis import Advice, camera_colours
from splatnode.viewer.session import Session
from splatnode.viewer.shapes import Lines, frustum_depth, ground, ground_lines, image_corners, shapes
from splatnode.viewer.sources import Source
from splatnode.viewer.state import Moment, ViewerState, Viewpoint, overview, scene_pivot

# Who may look: on this machine's own address anybody on it, over a network who has the key.

LOOPBACK = "127.0.0.1"
_KEY = re.compile(r"[A-Za-z0-9_-]{32,128}")
_KEY_BYTES = 32  # random ones, of a key
_LARGEST = 1000  # bytes of a file with a key
_OTHERS = 0o077


@dataclass(frozen=True)
class Access:
    """The rules of one server."""

    address: str  # numeric, that it listens on
    port: int
    key: str | None  # None: none is needed, which is so on a loopback address alone

    def __post_init__(self) -> None:
        if self.key is None and not ipaddress.ip_address(self.address).is_loopback:
            raise ValueError(f"a key is needed to listen on {self.address}, which other machines can reach")

    @property
    def cookie(self) -> str:
        """The name of the cookie that keeps the key: browsers send cookies to all ports of a machine alike."""
        return f"splatnode_{self.port}"

    def url(self, machine: str | None = None, key: str | None = None) -> str:
        """Returns the URL for a browser: with the address or the `machine`'s name, and the key or its substitute."""
        host = machine or (f"[{self.address}]" if ":" in self.address else self.address)
        return f"http://{host}:{self.port}/" + (f"?key={key or self.key}" if self.key else "")

    def is_allowed_host(self, host: str | None) -> bool:
        """Whether a request was meant for this server.

        Without a key only a name of the loopback address is, with any port, which ssh may have changed: a foreign page
        whose name was made to lead here (DNS rebinding) has another name.
        """
        return self.key is not None or _is_loopback(host or "")

    def is_key(self, text: str | None) -> bool:
        """Compared in a time that tells nothing of where they differ."""
        return self.key is not None and hmac.compare_digest((text or "").encode(errors="replace"), self.key.encode())

    def is_authorized(self, authorization: str | None, cookies: str | None) -> bool:
        """Whether a request has the key, in its cookie or as `Authorization: Bearer KEY`; any, where none is needed.

        The arguments are the headers of those names.
        """
        scheme, _, bearer = (authorization or "").partition(" ")
        has_bearer_key = scheme.lower() == "bearer" and self.is_key(bearer.strip())
        return self.key is None or has_bearer_key or self.is_key(_cookie(cookies, self.cookie))


def new_key() -> str:
    return secrets.token_urlsafe(_KEY_BYTES)


def load_or_create_key(path: Path) -> str:
    """The key in the file; a new one, which the file gets, where there is none, or where it was cut to nothing.

    Raises NotOwnerOnly where others may read the file, ValueError for one that holds something else, OSError.
    """
    text = _read_key_file(path)
    if not text:
        write_atomically(path, [f"{new_key()}\n".encode()])
        text = _read_key_file(path)
    key = text.decode(errors="replace").strip()
    if not _KEY.fullmatch(key):
        raise ValueError(f"{path} must hold 32 to 128 letters, digits, - or _; remove it to get a new key")
    return key


def _read_key_file(path: Path) -> bytes:
    """Returns the content of this user's file; nothing where it is not there."""
    try:
        text = read_own(path, _LARGEST, only_ours=True)
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return b""
    if mode & _OTHERS:
        raise NotOwnerOnly(f"others may read {path}. Run: chmod 600 {path}")
    return text


def _cookie(header: str | None, name: str) -> str | None:
    """Finds one cookie: browsers send those of all programs on a machine, some of which no standard allows."""
    parts = (part.partition("=") for part in (header or "").split(";"))
    return next((value.strip() for found, _, value in parts if found.strip() == name), None)


def _is_loopback(host: str) -> bool:
    """Whether a Host header names the loopback address."""
    found = re.fullmatch(r"(\[[0-9a-fA-F:]+\]|[^:\[\]]+)(:[0-9]{1,5})?", host)
    name = found[1].strip("[]").lower() if found else ""
    try:
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


# What the page draws, as bytes: Gaussians, cameras and lines, photographs.

THUMBNAIL_SIDE = 256  # pixels, at least where the photograph has as many
_QUALITY = 85  # of JPEG
_NOTHING = ViewerState(
    cameras=False,
    photographs=False,
    path=False,
    tracked=False,
    advice=False,
    uncertainty=False,
    graph=False,
    given=False,
)
# Groups of lines that the page shows or hides; the names are fields of State. "ground" is one more.
_GROUPS = ("cameras", "path", "advice", "uncertainty", "graph", "given")


@dataclass(frozen=True, eq=False)
class Content:
    """A moment with what is known beside it. Bytes are made when somebody first asks for them."""

    moment: Moment
    advice: Advice | None

    @cached_property
    def gaussians(self) -> bytes:
        """The Gaussians as a .splat file: 32 bytes each."""
        return encode_splat(self.moment.snapshot.gaussians)

    @cached_property
    def shapes(self) -> bytes:
        """Four bytes with the length of a JSON text, the text, and the lines' ends as float32, little-endian.

        The text has the cameras, the viewpoints to start from, and where in the numbers each group of lines is.
        """
        named = [(name, _lines_of_group(self, name)) for name in _GROUPS] + [
            ("ground", ground_lines(ground(self.moment)))
        ]
        parts, entries, at = [], [], 0
        for name, group in named:
            for lines in group:
                ends = lines.ends.astype("<f4")
                parts.append(ends.tobytes())
                entries.append(
                    {"group": name, "at": at, "count": len(ends), "colour": lines.colour, "width": lines.width}
                )
                at += ends.size
        text = json.dumps(_describe_scene(self) | {"lines": entries}, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        return b"".join([len(text).to_bytes(4, "little"), text, *parts])

    def encode_image(self, index: int, *, small: bool) -> bytes | None:
        """The JPEG of the camera at `index`, at its size or as a thumbnail; None where there is none."""
        cameras = self.moment.snapshot.cameras
        image = self.moment.snapshot.images.get(cameras[index].name) if 0 <= index < len(cameras) else None
        if image is None:
            return None
        scale = min(1.0, THUMBNAIL_SIDE / max(image.shape[:2])) if small else 1.0
        size = max(1, round(scale * image.shape[1])), max(1, round(scale * image.shape[0]))
        resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        done, data = cv2.imencode(
            ".jpg", cv2.cvtColor(resized, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
        )
        return data.tobytes() if done else None


def _lines_of_group(content: Content, name: str) -> tuple[Lines, ...]:
    """The lines of one group; those of the cameras are one for each, in their order."""
    state = replace(_NOTHING, **{name: True})
    return shapes(content.moment, state, content.advice).lines


def live_camera_ends(moment: Moment, tracked: CameraEstimate | None) -> list[float]:
    """The ends of the live camera's lines, six numbers each; none where it is not known."""
    lines = shapes(moment, replace(_NOTHING, tracked=True), None, tracked).lines
    return [round(number, 6) for each in lines for number in each.ends.ravel().tolist()]


def _describe_scene(content: Content) -> dict[str, Any]:
    moment = content.moment
    snapshot = moment.snapshot
    start = overview(moment, (content.advice.arrow if content.advice else None) or ())
    depth = frustum_depth(moment)
    return {
        "scene": moment.scene_id,
        "num_gaussians": len(snapshot.gaussians),
        "up": start.up.tolist(),
        "pivot": scene_pivot(moment).tolist(),
        "overview": _viewpoint(start),
        "frustum_depth": depth,
        "cameras": [
            {
                "name": sanitize_text(camera.name),
                "colour": colour,
                "T_world_camera": camera.T_world_camera.ravel().tolist(),
                "K": camera.K.ravel().tolist(),
                "size": [camera.width, camera.height],
                "corners": image_corners(camera, camera.T_world_camera, depth).tolist(),
                "photograph": camera.name in snapshot.images,
            }
            for camera, colour in zip(snapshot.cameras, camera_colours(snapshot.cameras), strict=True)
        ],
    }


def _viewpoint(view: Viewpoint) -> dict[str, Any]:
    K, width, height = view.lens
    return {
        "T_world_camera": np.ravel(view.T_world_camera).tolist(),
        "K": np.ravel(K).tolist(),
        "size": [width, height],
        "distance": view.distance,
    }


# The newest there is to see, for any number of visitors who wait for it.


@dataclass(frozen=True, eq=False)
class BoardState:
    """One state of what is shown; `number` counts them. Versions tell what of it is new."""

    number: int
    said: dict[str, Any]
    live: bool = False  # more may come
    content: Content | None = None  # None: nothing has come yet
    gaussians: int = 0  # version
    shapes: int = 0  # version


class Board:
    """One writer replaces what is shown, whole; readers take it or wait for another."""

    def __init__(self) -> None:
        self.run = secrets.token_hex(8)  # of this server: after another start, numbers begin anew
        self._shown = BoardState(0, {})
        self._changed = threading.Condition()

    @property
    def current(self) -> BoardState:
        return self._shown

    def publish(self, said: dict[str, Any], content: Content | None, *, live: bool) -> None:
        """Shows this from now on, if it is not what is shown already."""
        before = self._shown
        if said == before.said and content is before.content:
            return
        gaussians, shapes = before.gaussians, before.shapes
        if content is not None and content is not before.content:
            known = before.content.moment.snapshot.gaussians if before.content else None
            gaussians += content.moment.snapshot.gaussians is not known
            shapes += 1
        with self._changed:
            self._shown = BoardState(before.number + 1, said, live, content, gaussians, shapes)
            self._changed.notify_all()

    def wait(self, run: str, number: int, timeout_s: float) -> BoardState:
        """Returns the current state once it differs from `number` of `run`, or after `timeout_s`."""
        with self._changed:
            self._changed.wait_for(lambda: (run, number) != (self.run, self._shown.number), timeout_s)
            return self._shown


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
        self.wait_s = _WAIT_S
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
            shown = board.wait(asked.get("run", ""), number, self.server.wait_s)
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


# What the page says beside the picture, in the words of the window's panel.

_MOST_DROPPED = 200  # photographs that are listed
_MOST_VIEWS = 100  # whose share of confirmed depth is listed
_LONGEST = 2000  # characters of a line


def describe_session(session: Session) -> dict[str, Any]:
    """Headings and their lines, every one printable; `good`: whether the verdict is."""
    moment, age = session.moment, session.source.age_s
    if moment is None:
        return {"good": None, "state": viewer_text.waiting_line(age), "verdict": [], "sections": []}
    snapshot, analysis = moment.snapshot, session.analysis()
    sections = [
        ("Next view", [viewer_text.advice_line(analysis.advice if analysis else None, moment)]),
        ("How well it is known", [*viewer_text.bounds_lines(moment), *viewer_text.depth_lines(moment)]),
        ("Depth that other views confirm", viewer_text.view_depth_lines(moment, _MOST_VIEWS)),
        ("Places", viewer_text.place_lines(moment)),
        ("What there is", viewer_text.count_lines(moment)),
        (f"Photographs left out: {len(snapshot.dropped)}", viewer_text.rejection_lines(moment, _MOST_DROPPED)),
    ]
    kind = "final" if snapshot.final else "provisional: the scene is still being made"
    return {
        "good": snapshot.verdict.code is Code.OK,
        "state": f"{viewer_text.feed_line(age, snapshot.final)}; {kind}"
        if age is not None
        else viewer_text.feed_line(age, True),
        "verdict": [_line(line) for line in viewer_text.verdict_lines(moment)],
        "sections": [[heading, [_line(line) for line in lines]] for heading, lines in sections if lines],
    }


def _line(text: str) -> str:
    return sanitize_text(text, _LONGEST)


PORT = 8347
_TICK_S = 0.05
_EVERYWHERE = ("0.0.0.0", "::")


@dataclass(frozen=True)
class ListenAddress:
    """The address and the key of the server."""

    address: str = LOOPBACK  # numeric
    port: int = PORT  # 0: any that is free
    key: str | None = None
    key_file: Path | None = None  # that has the key


def resolve_address(listen: str | None, port: int, key_file: Path | None) -> ListenAddress:
    """On the loopback address, or with a key at the address to `listen` on. Raises what `load_or_create_key` raises."""
    key = load_or_create_key(key_file) if key_file is not None else new_key() if listen is not None else None
    return ListenAddress(listen or LOOPBACK, port, key, key_file)


def show(source: Source, where: ListenAddress, opened: Callable[[], None], say: Callable[[str], None]) -> NoReturn:
    """Serves until the process is told to end. Raises OSError where it cannot listen, and what the source raises."""
    with open_server(source, where) as (server, session):
        say(invitation(server.access, where.key_file))
        opened()
        content = None
        while True:
            session.receive()
            content = make_content(session, content)
            server.board.publish(_describe_page(session), content, live=source.age_s is not None)
            time.sleep(_TICK_S)


@contextlib.contextmanager
def open_server(source: Source, where: ListenAddress) -> Iterator[tuple[Server, Session]]:
    """A server that answers, and the session of the source; both are closed at the end."""
    session = Session(source, ViewerState(), memory_bytes=0)
    try:
        server = Server(Board(), where.address, where.port, where.key)
        try:
            server.start()
            yield server, session
        finally:
            server.shutdown()
            server.server_close()
    finally:
        session.close()


def make_content(session: Session, before: Content | None) -> Content | None:
    """Returns the content to draw now: `before`, where nothing of it has changed."""
    moment, analysis = session.moment, session.analysis()
    if moment is None:
        return None
    advice = analysis.advice if analysis else None
    same = before is not None and before.moment is moment and before.advice is advice
    return before if same else Content(moment, advice)


def _describe_page(session: Session) -> dict[str, Any]:
    moment = session.moment
    return describe_session(session) | {"tracked": live_camera_ends(moment, session.live_camera) if moment else []}


def invitation(access: Access, key_file: Path | None) -> str:
    """One line: what to open, and what to know of it."""
    if access.key is None:
        port, machine = access.port, socket.gethostname()
        return (
            f"splatnode: open {access.url()} in a browser on this machine; on another one first run "
            f"ssh -L {port}:{access.address}:{port} {machine}, then open the same address there. Ctrl-C ends the viewer"
        )
    machine = socket.gethostname() if access.address in _EVERYWHERE else None
    url = access.url(machine, None if key_file is None else "KEY")
    where = "" if key_file is None else f", with what {key_file} holds in place of KEY"
    return (
        f"splatnode: open {url} in a browser{where}. Who has this address can look. It is not encrypted: where others "
        "can read the network, leave --listen away and use ssh -L. Ctrl-C ends the viewer"
    )
