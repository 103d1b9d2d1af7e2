"""A decoder's process: what it says is heard, as far as it goes, and a crash is told with its last words."""

from __future__ import annotations

import itertools
import logging
import os
import subprocess

import pytest

from splatnode.capture.process import library_lines, python
from splatnode.capture.process.python import start_process

pytestmark = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="heard where there are files in memory")


@pytest.fixture(autouse=True)
def nobody_said_anything(monkeypatch, caplog):
    for name in ("_times", "_crashes"):
        monkeypatch.setattr(library_lines, name, itertools.count(1))
    caplog.set_level(logging.DEBUG, "splatnode")


def run(code: str) -> int:
    with start_process(python.make_isolated_command("-c", code), subprocess.DEVNULL) as child:
        return child.wait()


def told(caplog) -> list[tuple[int, str]]:
    return [(each.levelno, each.getMessage()) for each in caplog.records]


def test_what_a_decoder_says_goes_to_the_log_and_not_to_the_terminal(caplog, capfd):
    assert run("import os; os.write(2, b'Invalid NAL unit\\n\\x1b[2J\\n')") == 0
    ((level, line),) = told(caplog)
    assert level == logging.DEBUG and "Invalid NAL unit" in line and line.isprintable() and "ended" not in line
    assert capfd.readouterr().err == ""


def test_the_last_words_before_a_crash_are_told_with_its_signal(caplog):
    assert run("import os; os.write(2, b'free(): invalid pointer\\n'); os.abort()") == -6
    ((level, line),) = told(caplog)
    assert level == logging.INFO and "ended=-6" in line and "free(): invalid pointer" in line


def test_a_decoder_that_is_not_needed_any_more_did_not_crash(caplog):
    with start_process(
        python.make_isolated_command("-c", "import os; os.write(2, b'a'); os.write(1, b'b'); input()"), subprocess.PIPE
    ) as child:
        assert child.stdout.read(1) == b"b"
    ((level, line),) = told(caplog)
    assert level == logging.DEBUG and "said=a" in line and child.returncode == -9


def test_one_that_says_much_takes_no_memory_for_it_and_goes_on(caplog):
    code = "import os\nfor _ in range(100):\n try: os.write(2, bytes(100_000))\n except OSError: pass\n"
    assert run(code) == 0
    ((_, line),) = told(caplog)
    assert "cut=True" in line and len(line) < 2000


def test_without_files_in_memory_nothing_is_heard_and_it_runs(caplog, monkeypatch):
    monkeypatch.delattr(os, "memfd_create")
    assert run("import os; os.write(2, b'a')") == 0 and not told(caplog)


def test_nothing_stays_open():
    before = len(os.listdir("/proc/self/fd"))
    run("pass")
    assert len(os.listdir("/proc/self/fd")) == before
    with pytest.raises(OSError), start_process(["/no/such/decoder"], subprocess.DEVNULL):
        pass
    assert len(os.listdir("/proc/self/fd")) == before
    assert python.answer("json.tool", b"[1]", 100)[0].split() == [b"[", b"1", b"]"]
