"""A viewer beside a run: it sees the newest snapshot, and nobody waits for it while the run goes on."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

import splatnode.recon.cli
from splatnode.capture.messaging.network import Network
from splatnode.capture.process.config import parse_config, read_yaml
from splatnode.recon.cli import LOOK_EVERY, viewer
from splatnode.recon.config import preset
from splatnode.recon.pipeline import set_preview_interval
from tests.viewer.test_cli import snapshot

SLEEPER = (sys.executable, "-c", "import time; time.sleep(60)", "--")


def test_the_viewer_gets_the_last_snapshot(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(Path(splatnode.recon.cli.__file__).parent.parent)
    command = (sys.executable, "-m", "splatnode", "view", "--headless", "--size", "64x48")
    with viewer(tmp_path, command) as show:
        for sequence in range(20):
            show(replace(snapshot(), sequence=sequence, final=sequence == 19))
    assert (tmp_path / "live.png").is_file()
    assert "live.png: OK: All is well." in capfd.readouterr().out


def test_the_viewer_finds_the_run_wherever_temporary_files_lie(tmp_path, monkeypatch):
    copy = (sys.executable, "-c", f"import shutil, sys; shutil.copy(sys.argv[1], {str(tmp_path / 'seen.yaml')!r})")
    with tempfile.TemporaryDirectory(prefix="a: #") as folder:
        monkeypatch.setattr(tempfile, "tempdir", folder)
        with viewer(tmp_path, copy):
            pass
        network = parse_config(read_yaml(tmp_path / "seen.yaml")["network"], Network)
        assert network.directory is not None and network.directory.parent == Path(folder)


def test_showing_waits_for_nobody_and_a_failed_run_ends_the_viewer(tmp_path, monkeypatch):
    started = []

    def remember(*args, **options):
        started.append(popen(*args, **options))
        return started[-1]

    popen = subprocess.Popen
    monkeypatch.setattr(splatnode.recon.cli.subprocess, "Popen", remember)
    shown = snapshot()
    with pytest.raises(RuntimeError, match="the run failed"), viewer(tmp_path, SLEEPER) as show:
        begin = time.perf_counter()
        for _ in range(10_000):
            show(shown)
        assert time.perf_counter() - begin < 30  # the viewer sleeps for twice that
        raise RuntimeError("the run failed")
    assert started[0].returncode is not None


def test_looks_change_nothing_but_the_looks():
    config = preset("balanced")
    looked = set_preview_interval(config, LOOK_EVERY)
    assert set(looked.optimize.looks) >= {LOOK_EVERY, 2 * LOOK_EVERY}
    assert all(0 < look < config.optimize.iterations for look in looked.optimize.looks)
    same = msgspec.structs.replace(looked.optimize, looks=())
    assert msgspec.structs.replace(looked, optimize=same) == config
