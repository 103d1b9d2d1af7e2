"""A result or a running node in viser, a page in a browser: its server.

The only file that imports viser, which is an extra. By itself viser lets in whoever reaches its port, takes the next
port where one is taken, waits for ever where it cannot listen, and opens a tunnel to the internet for any visitor who
asks. Here it listens on the loopback address unless told, answers its own page alone, and opens no tunnel.
"""

from __future__ import annotations

import contextlib
import errno
import http
import importlib
import ipaddress
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any, NoReturn
from urllib.parse import urlsplit

from splatnode.extras.viewers.viser_stage import ViserStage
from splatnode.viewer.sources import Source
from splatnode.viewer.web.server import LOOPBACK, Access

viser: Any = importlib.import_module("viser")  # by its name: where it is not installed, pyright takes this file for it
websockets: Any = importlib.import_module("websockets.asyncio.server")  # brought by viser

PORT = 8080
_POLL_S = 0.1
_TITLE = "splatnode"
_EVERYWHERE = ("0.0.0.0", "::")


def show(source: Source, listen: str | None, port: int, say: Callable[[str], None]) -> NoReturn:
    """Serves until the process is told to end. Raises OSError where it cannot listen, and what the source raises."""
    with contextlib.closing(source), open_server(listen or LOOPBACK, port) as server:
        stage = ViserStage(server)
        say(_invitation(listen, server.get_port()))
        while True:
            moment = source.take()
            if moment is not None:
                stage.draw(moment)
            stage.track(source.live_camera)
            stage.apply_client_changes()
            time.sleep(_POLL_S)


@contextlib.contextmanager
def open_server(address: str, port: int) -> Iterator[Any]:
    """A server of viser's that listens there, port 0: any that is free. Raises OSError where it cannot listen."""
    port = _free_port(address, port)  # viser would wait for ever, or go elsewhere
    importlib.import_module("rich").get_console().quiet = True  # to which viser prints; the address is told by us
    with _refuse_foreign_origins(address) as guarded:
        server = _Server(host=address, port=port, label=_TITLE, verbose=False)
    try:
        if server.get_port() != port:
            raise _port_in_use_error(address, port)
        if not guarded:
            raise RuntimeError(
                "this release of viser starts in another way than 1.1.1, and would answer any site's page"
            )
        server.gui.configure_theme(show_share_button=False)
        yield server
    finally:
        server.stop()


def _free_port(address: str, port: int) -> int:
    """The port, or any that is free for 0. Raises OSError where that address has none."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        with socket.create_server((address, port), family=family) as tried:
            return tried.getsockname()[1]
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise _port_in_use_error(address, port) from None
        raise OSError(f"cannot listen on {address}, port {port}: {error.strerror}") from None


def _port_in_use_error(address: str, port: int) -> OSError:
    return OSError(f"cannot listen on {address}, port {port}: another program listens there. --port takes another port")


def _invitation(listen: str | None, port: int) -> str:
    """One line: what to open, and what to know of it."""
    if listen is None:
        return (
            f"splatnode: open http://{LOOPBACK}:{port}/ in a browser on this machine; on another one first run "
            f"ssh -L {port}:{LOOPBACK}:{port} {socket.gethostname()}, then open the same address there. Ctrl-C ends it"
        )
    host = socket.gethostname() if listen in _EVERYWHERE else f"[{listen}]" if ":" in listen else listen
    return (
        f"splatnode: open http://{host}:{port}/ in a browser. Everybody who reaches it can look: viser has no key, and "
        "nothing is encrypted. splatnode view --web --listen has a key. Ctrl-C ends it"
    )


class _Server(viser.ViserServer):
    """Opens no tunnel, whoever asks."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Does not."""


@contextlib.contextmanager
def _refuse_foreign_origins(address: str) -> Iterator[list[int]]:
    """While a server starts: it is made to refuse what pages of other sites ask of it, which viser does not.

    Gives the ports for which that was done.

    A page of any site may open a web socket to this machine; the browser tells of which site it is. And a name of the
    site's own may lead here, so that on the loopback address only its own names are answered.
    """
    original = websockets.serve
    loopback = Access(address, 0, None) if ipaddress.ip_address(address).is_loopback else None
    ports: list[int] = []

    def serve_same_origin(
        handler: object, host: str, port: int, *, process_request: Callable[..., Any], **options: Any
    ) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            asked, origin = request.headers.get("Host"), request.headers.get("Origin")
            by_its_name = loopback is None or loopback.is_allowed_host(asked)
            if not by_its_name or (origin is not None and urlsplit(origin).netloc != asked):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "This server answers its own page.\n")
            return process_request(connection, request)

        ports.append(port)
        return original(handler, host, port, process_request=answer, **options)

    websockets.serve = serve_same_origin
    try:
        yield ports
    finally:
        websockets.serve = original
