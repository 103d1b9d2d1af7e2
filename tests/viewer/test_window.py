"""A real window on a display of its own: every key is pressed, scenes grow and shrink, it closes when it is told."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from splatnode.viewer.probe import probe_window, splash
from tests.conftest import ROOT
from tests.support.walk import write_walk

DRIVE = """
import os, signal, sys
from dataclasses import replace
from pathlib import Path
from tests.viewer.test_session import Feed
from tests.viewer.test_cli import snapshot
from tests.viewer.test_scene import wall
from splatnode.viewer.state import Moment
from splatnode.viewer.session import Session
from splatnode.viewer.state import BINDINGS, ViewerState
from splatnode.viewer.window import show

class Driver(Session):
    ticks = 0
    def receive(self):
        self.ticks += 1
        if self.ticks % 2:
            binding = BINDINGS[self.ticks // 2 % len(BINDINGS)]
            self.press(binding.key)
        size = 40 if self.ticks % 4 < 2 else 10
        moment = replace(snapshot(), gaussians=wall(size), sequence=self.ticks)
        self.source.waiting.append(Moment(moment, float(self.ticks)))
        if self.ticks == 2 * len(BINDINGS):
            os.kill(os.getpid(), signal.SIGTERM)
        return super().receive()

try:
    show(Driver(Feed(), ViewerState()), software=True, screenshots=Path(sys.argv[1]), size=(400, 300))
except SystemExit as stopped:
    print("closed with", stopped.code, flush=True)
"""


@pytest.fixture(scope="module")
def display() -> Iterator[str]:
    """A virtual display on which a window can be opened."""
    if importlib.util.find_spec("open3d") is None:
        pytest.skip("needs Open3D (pip install 'splatnode[viewer]')")
    if shutil.which("Xvfb") is None:
        pytest.skip("needs Xvfb, a display without a screen")
    reader, writer = os.pipe()
    command = ["Xvfb", "-displayfd", str(writer), "-screen", "0", "640x480x24"]
    server = subprocess.Popen(command, pass_fds=[writer], stderr=subprocess.DEVNULL)
    os.close(writer)
    with os.fdopen(reader) as numbers:
        name = f":{numbers.readline().strip()}"
    yield name
    server.terminate()
    server.wait()


def test_a_window_survives_every_key_and_every_size_and_closes_when_told(display, tmp_path, monkeypatch):
    monkeypatch.setenv("DISPLAY", display)
    probe = probe_window()
    if not probe.window:
        pytest.skip(f"needs a window: {probe.detail}")
    command = [sys.executable, "-c", DRIVE, str(tmp_path)]
    driven = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert driven.returncode == 0 and "closed with 0" in driven.stdout, driven.stderr[-2000:]


WALK = """
import os, signal, sys, time
from dataclasses import replace
from pathlib import Path
from splatnode.viewer.sources import Maps, MapSource
from splatnode.viewer.session import Session
from splatnode.viewer.state import ViewerState
from splatnode.viewer.window import show

class Driver(Session):
    ticks = 0
    def receive(self):
        self.ticks += 1
        if self.moment is not None and self.ticks % 3 == 0:
            self.press("8" if self.ticks % 2 else "n")
        if self.moment is not None and all(node.level == 0 for node in self.moment.graph.nodes) and self.ticks > 20:
            os.kill(os.getpid(), signal.SIGTERM)
        return super().receive()

source = MapSource(Maps(Path(sys.argv[1]), lambda cameras: {}))
try:
    show(Driver(source, ViewerState()), software=True, screenshots=Path(sys.argv[1]), size=(400, 300))
except SystemExit as stopped:
    print("closed with", stopped.code, flush=True)
"""


def test_a_map_of_several_scenes_is_walked_through_in_a_window(display, tmp_path, monkeypatch):
    monkeypatch.setenv("DISPLAY", display)
    probe = probe_window()
    if not probe.window:
        pytest.skip(f"needs a window: {probe.detail}")
    command = [sys.executable, "-c", WALK, str(write_walk(tmp_path / "out"))]
    driven = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert driven.returncode == 0 and "closed with 0" in driven.stdout, driven.stderr[-2000:]


SPLASH = """
import time
from splatnode.viewer.probe import splash
from tests.support.screen import Screen

def wait(shown):
    deadline = time.monotonic() + 60
    while (screen.picture(640, 480).std() > 1) != shown and time.monotonic() < deadline:
        time.sleep(0.05)
    return screen.picture(640, 480).std() > 1

screen = Screen()
with splash() as close:
    print("shown", wait(True), flush=True)
    close()
    print("closed", wait(False), flush=True)
"""

ORPHAN = """
import os
from splatnode.viewer.probe import splash
with splash() as close:
    print(close.__closure__[0].cell_contents.pid, flush=True)
    input()
    os._exit(0)
"""


def test_the_splash_is_there_until_it_is_closed(display, monkeypatch):
    pytest.importorskip("tkinter", reason="needs tkinter, which the splash is made of")
    monkeypatch.setenv("DISPLAY", display)
    done = subprocess.run([sys.executable, "-c", SPLASH], cwd=ROOT, capture_output=True, text=True, timeout=200)
    assert done.stdout.split() == ["shown", "True", "closed", "False"], done.stderr[-2000:]


def test_the_splash_goes_with_the_viewer_that_asked_for_it(display, monkeypatch):
    pytest.importorskip("tkinter", reason="needs tkinter, which the splash is made of")
    monkeypatch.setenv("DISPLAY", display)
    command = [sys.executable, "-c", ORPHAN]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as viewer:
        assert viewer.stdout is not None and viewer.stdin is not None
        child = Path("/proc", viewer.stdout.readline().strip())
        time.sleep(2.0)  # it looks for its parent from the moment it is there
        viewer.stdin.write("\n")
    deadline = time.monotonic() + 60
    while alive(child) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not alive(child)


def alive(process: Path) -> bool:
    """Whether the process of this folder of /proc runs: one that nobody waits for is dead, too."""
    try:
        return (process / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_without_a_display_there_is_no_splash_and_no_error(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":987")
    with splash() as close:
        close()
