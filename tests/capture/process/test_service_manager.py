"""What the service manager is told is one assignment a line, and only ours."""

from __future__ import annotations

import socket

import pytest

from splatnode.capture.process.service_manager import ServiceManager
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
