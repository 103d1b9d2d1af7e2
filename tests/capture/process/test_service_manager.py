"""What the service manager is told is one assignment a line, and only ours."""

from __future__ import annotations

import contextlib
import errno
import socket

import pytest

from splatnode.capture.process.system import ServiceManager
from tests.support.hostile import TEXTS, unprintable


@pytest.fixture
def manager(tmp_path, monkeypatch):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield listening


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_a_status_is_one_assignment(manager, text):
    ServiceManager().alive(f"idle, {text}")
    alive, status = manager.recv(4096).decode().split("\n")
    assert alive == "WATCHDOG=1" and status.startswith("STATUS=idle, ") and not unprintable(status)


@pytest.mark.parametrize("usec", ["", "soon", "-1", "1e3", "9" * 400, "\u0663"])
def test_a_time_that_is_none_is_as_good_as_none(manager, monkeypatch, usec):
    monkeypatch.setenv("WATCHDOG_USEC", usec)
    ServiceManager().ready()
    assert manager.recv(4096) == b"READY=1"


def told(manager) -> list[bytes]:
    """All that has come, in order."""
    found = []
    with contextlib.suppress(BlockingIOError):
        while True:
            found.append(manager.recv(4096, socket.MSG_DONTWAIT))
    return found


def test_what_a_busy_manager_does_not_take_is_sent_again(manager, tmp_path):
    service = ServiceManager()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other, contextlib.suppress(BlockingIOError):
        other.setblocking(False)
        while True:
            other.sendto(b"X=1", str(tmp_path / "notify"))
    service.ready()
    service.alive("idle")
    assert set(told(manager)) == {b"X=1"}
    service.alive("busy")
    assert told(manager) == [b"READY=1", b"WATCHDOG=1\nSTATUS=busy"]
    service.alive("busy")
    assert told(manager) == []  # it has a second for that


def test_without_a_descriptor_to_spare_nothing_ends(manager, monkeypatch):
    service = ServiceManager()

    def none(*_: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    with monkeypatch.context() as short:
        short.setattr("splatnode.capture.process.system.socket.socket", none)
        service.ready()
        service.alive("idle")
    service.alive("idle")
    assert told(manager) == [b"READY=1", b"WATCHDOG=1\nSTATUS=idle"]


def test_a_manager_that_does_not_listen_is_not_asked_again(manager, tmp_path):
    manager.close()
    service = ServiceManager()
    service.ready()
    (tmp_path / "notify").unlink()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as another:
        another.bind(str(tmp_path / "notify"))
        service.alive("idle")
        assert told(another) == []
