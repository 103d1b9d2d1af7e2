"""A batch that is killed while it writes into a log: that is as it was or whole, and the next run succeeds."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from splatnode.capture.process.files import exclusive
from splatnode.extras.batch.command import EXIT_GOOD, EXIT_SOME_FAILED
from splatnode.recon.result.export.stored import encode_cameras
from tests.conftest import ROOT
from tests.extras.batch.killed_writer import NEVER, run
from tests.extras.batch.test_write_back import camera, everything, own
from tests.support import mcap_files
from tests.support.recordings import REPORT

SHARES = (0.0, 0.2, 0.4, 0.6, 0.8, 0.95)  # of the calls that a whole run makes


@pytest.fixture
def log(tmp_path: Path) -> Path:
    picture = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    return mcap_files.write(tmp_path / "drive.mcap", [mcap_files.compressed("/a", picture) for _ in range(60)])


@pytest.fixture
def result(tmp_path: Path) -> Path:
    folder = tmp_path / "made"
    folder.mkdir()
    (folder / "report.json").write_text(json.dumps(REPORT))
    (folder / "cameras.json").write_bytes(encode_cameras([camera("a", 0), camera("a", 2)]))
    return folder


def hidden(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


def test_a_log_is_as_it_was_or_whole_whenever_its_writer_is_killed(tmp_path, log, result, capsys):
    before, arguments = log.read_bytes(), [tmp_path / "out", log, result, *SHARES]
    command = [sys.executable, "-m", "tests.extras.batch.killed_writer", *map(str, arguments)]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    codes = [int(code) for code in ended.stdout.splitlines()[-1].split()]
    assert codes == [EXIT_GOOD, *[-signal.SIGKILL] * (len(SHARES) + 2)], ended.stderr
    whole, *others = (Path(f"{log}.{number}").read_bytes() for number in range(len(codes)))
    assert len(own(everything(Path(f"{log}.0")))) == 5 and whole != before
    assert set(others) == {before, whole} and others[-2:] == [whole, before]
    assert log.read_bytes() == before and hidden(tmp_path) == [".drive.mcap.partial", ".drive.mcap.splatnode.lock"]
    assert run(tmp_path / "out", log, str(result), NEVER)[0] == EXIT_GOOD
    assert "1 topics of" in capsys.readouterr().out
    assert log.read_bytes() == whole and hidden(tmp_path) == []


def test_two_batches_do_not_write_into_one_log_at_a_time(tmp_path, log, result, capsys):
    before = log.read_bytes()
    with exclusive(tmp_path / ".drive.mcap.splatnode.lock"):
        assert run(tmp_path / "out", log, str(result), NEVER)[0] == EXIT_SOME_FAILED
    assert "which writes there; run this again with --resume" in capsys.readouterr().out
    assert log.read_bytes() == before
