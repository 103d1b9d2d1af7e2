"""A data set that holds splatnode.py, torch.py or sitecustomize.py beside its photographs: none of them is run."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from splatnode.extras.batch import BatchRecording
from splatnode.extras.batch.command import replay
from splatnode.extras.jobs import Child, Limits, Task, engine, own_version, pack_call, run_here, wait_for_end
from splatnode.viewer.probe import probe_window, splash
from tests.conftest import ROOT
from tests.support.hostile_folder import make_hostile, program, variables


@pytest.fixture
def trace(tmp_path, monkeypatch) -> Path:
    """The current folder is the data set."""
    trace = make_hostile(tmp_path / "photos")
    monkeypatch.chdir(tmp_path / "photos")
    return trace


def test_batch_runs_none_nor_do_its_children_and_their_decoders(tmp_path, trace):
    Path("film.mp4").write_bytes(b"no film")
    command = [*program(tmp_path / "bin"), "batch", "film.mp4", "--out", str(tmp_path / "out"), "--cores", "1"]
    done = subprocess.run(command, env=variables(), capture_output=True, text=True)
    assert done.returncode == 65, done.stderr
    log = (tmp_path / "out" / "film.log").read_text()
    assert "no video" in log and not trace.exists()


def test_a_call_runs_none(tmp_path, trace):
    """As bench and stability make them."""
    tasks = iter([Task("cwd", pack_call(os.getcwd))])
    with engine(1, None) as on:
        ((_, answer),) = on.answers(lambda: next(tasks, None), Limits(), tmp_path / "calls")
    assert answer.value() == str(trace.parent) and not trace.exists()


def test_a_call_of_a_cluster_runs_none(trace):
    answer = run_here(pack_call(partial(divmod, 7, 2)), Limits(), own_version())
    assert answer.value() == (3, 1) and not trace.exists()


def test_the_command_of_a_recording_runs_none(tmp_path, trace):
    command = replay(["--help"], BatchRecording("a", "nothing"), tmp_path / "a")
    end = wait_for_end(Child.start(command, tmp_path / "log", (min(os.sched_getaffinity(0)),)), Limits())
    assert end.exit_code == 0 and "--preset" in (tmp_path / "log").read_text() and not trace.exists()


def test_looking_for_a_window_runs_none(trace):
    with splash():
        assert probe_window().detail
    assert not trace.exists()


@pytest.mark.parametrize("entries", [":", "ROOT:", ":ROOT", "ROOT:.:"])
def test_the_current_folder_on_the_path_of_modules_runs_none(tmp_path, entries):
    """As `export PYTHONPATH=/my/packages:$PYTHONPATH` leaves it; sitecustomize is Python's own, before any program."""
    for name in ("yaml", "numpy", "msgspec", "evil"):
        (tmp_path / f"{name}.py").write_text("import sys; print('EXECUTED', file=sys.stderr)\n")
    (tmp_path / "x.dist-info").mkdir()
    (tmp_path / "x.dist-info" / "entry_points.txt").write_text("[splatnode.recordings]\nz = evil\n")
    env = {**os.environ, "PYTHONPATH": entries.replace("ROOT", str(ROOT))}
    command = [sys.executable, "-m", "splatnode", "replay", ".", "--out", "out"]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
    assert "no photographs in '.'" in done.stderr and "EXECUTED" not in done.stderr, done.stderr
