"""The browser as a stage: what the source has is put where visitors see it, until somebody ends it."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from splatnode.viewer.session import Session
from splatnode.viewer.sources import Source
from splatnode.viewer.state import ViewerState
from splatnode.viewer.web.server import (
    LOOPBACK,
    Access,
    Board,
    Content,
    Server,
    describe_session,
    live_camera_ends,
    load_or_create_key,
    new_key,
)

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
