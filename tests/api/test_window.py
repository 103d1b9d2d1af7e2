"""`Result.show`: the viewer in a process of its own, and what is said where it cannot be shown."""

from __future__ import annotations

import http.client
import os
import re
import signal
import sys
import threading
from importlib.util import find_spec

import pytest

import splatnode
from splatnode.api import result as window
from splatnode.viewer.probe import Probe

SHOWS = """
import sys
from pathlib import Path
import splatnode
assert splatnode.load(sys.argv[-1]).verdict.publishable
Path(sys.argv[-1], "images").is_dir() or sys.exit(3)
print(*sys.argv[1:-1])
"""
READS = "import pathlib, sys; sys.exit(pathlib.Path(sys.argv[1]).read_bytes()[:4] != b'RRF2')"


def python(code: str) -> tuple[str, ...]:
    return sys.executable, "-c", code


@pytest.fixture
def with_a_window(monkeypatch):
    monkeypatch.setattr(window, "open3d_installed", lambda: True)
    monkeypatch.setattr(window, "probe_window", lambda: Probe(True, True, "pretended"))


def test_the_window_gets_the_result_with_its_photographs(result, with_a_window, capfd):
    window.show(result, command=python(SHOWS))
    assert capfd.readouterr() == ("", "")


def test_a_browsers_viewer_gets_what_was_asked_for_and_what_it_says_is_told(result, monkeypatch):
    told: list[str] = []
    monkeypatch.setattr(window, "find_spec", lambda name: name)
    window.show(result, "browser", command=python(SHOWS), opened=told.append)
    window.show(result, "viser", listen="0.0.0.0", port=0, command=python(SHOWS), opened=told.append)
    assert told == ["--web", "--viser --listen 0.0.0.0 --port 0"]


def test_rerun_gets_a_recording(result, monkeypatch):
    pytest.importorskip("rerun", reason="needs rerun")
    monkeypatch.setenv("DISPLAY", ":0")
    window.show(result, "rerun", command=python(READS))


def test_what_the_viewer_ends_with_is_told(result, with_a_window, capfd):
    failing = python("import sys; print('no colours', file=sys.stderr); sys.exit(70)")
    with pytest.raises(RuntimeError, match="the viewer ended with exit code 70: no colours"):
        window.show(result, command=failing)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("viewer", ["browser", "viser"])
def test_a_browser_is_answered_until_ctrl_c(result, interruptible, viewer):
    if viewer == "viser" and find_spec("viser") is None:
        pytest.skip("needs viser")
    answers: list[int] = []

    def opened(line: str) -> None:
        found = re.search(r"open http://127\.0\.0\.1:(\d+)/ ", line)
        assert found
        connection = http.client.HTTPConnection("127.0.0.1", int(found[1]), timeout=30)
        connection.request("GET", "/")
        answers.append(connection.getresponse().status)
        threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()

    result.show(viewer, port=0, opened=opened)
    assert answers == [200]


def test_what_cannot_be_shown_is_told_before_anything_starts(result, arrays, monkeypatch):
    with pytest.raises(ValueError, match="viewer must be one of open3d, rerun, browser, viser; got 'meshlab'"):
        result.show("meshlab")
    with pytest.raises(ValueError, match="listen and port are of browser and viser; open3d opens a window"):
        result.show(port=8080)
    with pytest.raises(ValueError, match="there is no scene to show: STATIC_CAMERA"):
        splatnode.reconstruct([arrays[0], arrays[0]]).show("browser")
    monkeypatch.setattr(window, "find_spec", lambda name: None)
    for viewer in ("rerun", "viser"):
        with pytest.raises(
            ModuleNotFoundError, match=rf"{viewer} is not installed. Run: pip install 'splatnode\[{viewer}"
        ):
            result.show(viewer)


def test_without_a_window_or_open3d_it_says_what_to_do(result, monkeypatch):
    monkeypatch.setattr(window, "open3d_installed", lambda: True)
    monkeypatch.setattr(window, "probe_window", lambda: Probe(False, False, "there is no display"))
    with pytest.raises(RuntimeError, match="no window can be opened: there is no display. In a browser: result.show"):
        result.show()
    monkeypatch.setattr(window, "open3d_installed", lambda: False)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'splatnode\[viewer\]'"):
        result.show()
    monkeypatch.setattr(window, "find_spec", lambda name: name)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if sys.platform == "linux":
        with pytest.raises(RuntimeError, match="rerun's window cannot be opened: there is no display"):
            result.show("rerun")
