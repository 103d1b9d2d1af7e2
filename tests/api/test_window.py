"""`Result.show`: the viewer in a process of its own, and what is said where there can be no window."""

from __future__ import annotations

import sys

import pytest

from splatnode.api import window
from splatnode.viewer.probe import Probe

SHOWS = """
import sys
from pathlib import Path
import splatnode
assert splatnode.load(sys.argv[1]).verdict.publishable
Path(sys.argv[1], "images").is_dir() or sys.exit(3)
"""


@pytest.fixture
def with_a_window(monkeypatch):
    monkeypatch.setattr(window, "open3d_installed", lambda: True)
    monkeypatch.setattr(window, "probe_window", lambda: Probe(True, True, "pretended"))


def test_the_viewer_gets_the_result_with_its_photographs(result, with_a_window):
    window.show(result, (sys.executable, "-c", SHOWS))


def test_what_the_viewer_ends_with_is_told(result, with_a_window, capfd):
    failing = (sys.executable, "-c", "import sys; print('no colours', file=sys.stderr); sys.exit(70)")
    with pytest.raises(RuntimeError, match="the viewer ended with exit code 70: no colours"):
        window.show(result, failing)
    assert capfd.readouterr() == ("", "")


def test_without_a_window_or_open3d_it_says_what_to_do(result, monkeypatch):
    monkeypatch.setattr(window, "open3d_installed", lambda: True)
    monkeypatch.setattr(window, "probe_window", lambda: Probe(False, False, "there is no display"))
    with pytest.raises(RuntimeError, match="no window can be opened: there is no display. In a browser: result.save"):
        result.show()
    monkeypatch.setattr(window, "open3d_installed", lambda: False)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'splatnode\[viewer\]'"):
        result.show()
