"""A real window on a display of its own: every key is pressed, scenes grow and shrink, it closes when it is told."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator

import pytest

from splatnode.viewer.probe import probe_window
from tests.conftest import ROOT
from tests.support.walk import write_walk

DRIVE = """
import os, signal, sys
from dataclasses import replace
from pathlib import Path
from tests.viewer.test_session import Feed
from tests.viewer.test_cli import snapshot
from tests.viewer.test_scene import wall
from splatnode.viewer.moment import Moment
from splatnode.viewer.session import Session
from splatnode.viewer.state import BINDINGS, State
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
    show(Driver(Feed(), State()), software=True, screenshots=Path(sys.argv[1]), size=(400, 300))
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
from splatnode.viewer.map_source import Maps, MapSource
from splatnode.viewer.session import Session
from splatnode.viewer.state import State
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
    show(Driver(source, State()), software=True, screenshots=Path(sys.argv[1]), size=(400, 300))
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
