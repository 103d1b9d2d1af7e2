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
from splatnode.viewer.state import State
from splatnode.viewer.web.access import LOOPBACK, Access, kept_key, new_key
from splatnode.viewer.web.board import Board
from splatnode.viewer.web.content import Content, tracked_ends
from splatnode.viewer.web.said import said
from splatnode.viewer.web.server import Server

PORT = 8347
_TICK_S = 0.05
_EVERYWHERE = ("0.0.0.0", "::")


@dataclass(frozen=True)
class Place:
    """Where the server listens."""

    address: str = LOOPBACK  # numeric
    port: int = PORT  # 0: any that is free
    key: str | None = None
    key_file: Path | None = None  # that has the key


def place(listen: str | None, port: int, key_file: Path | None) -> Place:
    """On the loopback address, or with a key at the address to `listen` on. Raises what `kept_key` raises."""
    key = kept_key(key_file) if key_file is not None else new_key() if listen is not None else None
    return Place(listen or LOOPBACK, port, key, key_file)


def show(source: Source, where: Place, opened: Callable[[], None], say: Callable[[str], None]) -> NoReturn:
    """Serves until the process is told to end. Raises OSError where it cannot listen, and what the source raises."""
    with serving(source, where) as (server, session):
        say(invitation(server.access, where.key_file))
        opened()
        content = None
        while True:
            session.receive()
            content = newest(session, content)
            server.board.put(_told(session), content, live=source.age_s is not None)
            time.sleep(_TICK_S)


@contextlib.contextmanager
def serving(source: Source, where: Place) -> Iterator[tuple[Server, Session]]:
    """A server that answers, and the session of the source; both are closed at the end."""
    session = Session(source, State(), memory_bytes=0)
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


def newest(session: Session, before: Content | None) -> Content | None:
    """What is to be drawn now: `before`, where nothing of it has changed."""
    moment, analysis = session.moment, session.analysis()
    if moment is None:
        return None
    advice = analysis.advice if analysis else None
    same = before is not None and before.moment is moment and before.advice is advice
    return before if same else Content(moment, advice)


def _told(session: Session) -> dict[str, Any]:
    moment = session.moment
    return said(session) | {"tracked": tracked_ends(moment, session.tracked) if moment else []}


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
