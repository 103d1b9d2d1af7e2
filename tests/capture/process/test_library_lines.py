"""What decoders in C print: it goes to the log, descriptor 2 stays with its process, and a crash loses none of it."""

from __future__ import annotations

import ast
import ctypes
import itertools
import logging
import os
import signal
import subprocess
import sys
import threading
import time

import cv2
import numpy as np
import pytest

from splatnode.capture.image_file import UnusableImage, decode_image
from splatnode.capture.process import library_lines, python
from splatnode.capture.process.library_lines import catch_library_lines, tell_last_words
from tests.conftest import ROOT

LIBC = ctypes.CDLL(None)
pytestmark = pytest.mark.skipif(not hasattr(LIBC, "gnu_get_libc_version"), reason="C's stderr is set in glibc alone")


@pytest.fixture
def catcher(monkeypatch):
    """One that nobody has used, and to which nobody has said anything."""
    monkeypatch.setattr(library_lines, "_times", itertools.count(1))
    new = library_lines._Catcher()
    monkeypatch.setattr(library_lines, "_catcher", new)
    return new


@pytest.fixture
def debug(caplog):
    caplog.set_level(logging.DEBUG, "splatnode")
    return caplog


def c_stderr() -> ctypes.c_void_p:
    return ctypes.c_void_p.in_dll(LIBC, "stderr")


def print_in_c(text: bytes) -> None:
    LIBC.fputs(text, c_stderr())


def damaged_jpeg() -> bytes:
    noise = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    data = cv2.imencode(".jpg", noise)[1].tobytes()
    return data[:-300] + data[-200:]


def damaged_png() -> bytes:
    data = bytearray(cv2.imencode(".png", np.zeros((48, 64, 3), np.uint8))[1].tobytes())
    data[data.index(b"IDAT") + 20] ^= 0xFF
    return bytes(data)


@pytest.mark.parametrize("damaged", [damaged_jpeg(), damaged_png()], ids=["jpeg", "png"])
def test_what_a_decoder_says_of_a_photograph_is_logged_and_not_printed(damaged, capfd, debug, catcher):
    for _ in range(20):
        try:
            decode_image(damaged)
        except UnusableImage:
            continue
    assert capfd.readouterr().err == ""
    said = [each.getMessage() for each in debug.records if "event=library_said" in each.getMessage()]
    assert 1 <= len(said) <= 5 and "times=1 " in said[0] and ("JPEG" in said[0] or "libpng" in said[0])  # 1, 2, 4, ...
    assert c_stderr().value == catcher._memory._before


def test_what_is_said_is_one_line_that_only_shows(debug, catcher):
    with catch_library_lines():
        print_in_c(b"one\n\x1b[2Jtwo \xff\n<0>three\n")
    (line,) = [each.getMessage() for each in debug.records]
    assert "lines=3" in line and line.isprintable() and "one; \\" in line.replace("\\\\", "\\")


def test_what_is_said_too_much_is_cut_and_the_next_is_whole(debug, catcher):
    with catch_library_lines():
        for _ in range(3000):
            print_in_c(b"libpng warning: of a file with a million bad chunks\n")
    with catch_library_lines():
        print_in_c(b"the next one\n")
    cut, whole = [each.getMessage() for each in debug.records]
    assert "cut=True" in cut and len(cut) < 3000
    assert "cut" not in whole and 'said="the next one"' in whole


def test_other_threads_and_the_process_itself_still_print(capfd, catcher):
    with catch_library_lines():
        writer = threading.Thread(target=lambda: print("of our own", file=sys.stderr, flush=True))
        writer.start()
        writer.join()
        os.write(2, b"of the C library itself\n")
    assert capfd.readouterr().err == "of our own\nof the C library itself\n"


def test_many_threads_leave_the_variable_as_it_was(debug, catcher, capfd):
    before, data = c_stderr().value, damaged_jpeg()
    threads = [threading.Thread(target=lambda: [decode_image(data) for _ in range(50)]) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert c_stderr().value == before and capfd.readouterr().err == ""
    assert any("Corrupt JPEG data" in each.getMessage() for each in debug.records)


def test_a_copy_of_the_process_has_a_memory_of_its_own(tmp_path, catcher, capfd):
    catcher.folder = tmp_path / "run"
    with catch_library_lines():
        print_in_c(b"of the first\n")
        if (child := os.fork()) == 0:
            print_in_c(b"to the descriptor\n")
            with catch_library_lines():
                alone = len(list((tmp_path / "run").iterdir())) == 2 and catcher._inside == 1
            os._exit(0 if alone else 1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert catcher._memory.take() == b"of the first\n"
    assert capfd.readouterr().err == "to the descriptor\n"


def test_an_import_redirects_nothing():
    code = (
        "import ctypes, os\n"
        "stderr = ctypes.c_void_p.in_dll(ctypes.CDLL(None), 'stderr')\n"
        "before = stderr.value, os.fstat(2).st_ino\n"
        "import splatnode, splatnode.capture.image_file\n"
        "from splatnode.capture.process import library_lines\n"
        "assert (stderr.value, os.fstat(2).st_ino) == before and library_lines._catcher._memory is None\n"
    )
    subprocess.run(
        python.make_isolated_command("-c", f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{code}"), check=True
    )


CRASH = """
import ctypes, sys
sys.path.insert(0, {root!r})
from splatnode import command_line
from splatnode.capture.process.library_lines import catch_library_lines
command_line._prepare_for_crash()
with catch_library_lines():
    libc = ctypes.CDLL(None)
    libc.fputs(b"decoder: about to break\\n", ctypes.c_void_p.in_dll(libc, "stderr"))
    {end}
"""


@pytest.mark.parametrize("end, code", [("libc.abort()", -signal.SIGABRT), ("libc.strlen(None)", -signal.SIGSEGV)])
def test_a_crash_leaves_its_last_words_and_where_it_was(tmp_path, monkeypatch, caplog, end, code):
    run = tmp_path / "run"
    run.mkdir(mode=0o700)
    command = python.make_isolated_command("-c", CRASH.format(root=str(ROOT), end=end))
    ended = subprocess.run(command, env={**os.environ, "RUNTIME_DIRECTORY": str(run)}, capture_output=True, text=True)
    assert ended.returncode == code
    assert "Current thread" in ended.stderr and "about to break" not in ended.stderr  # faulthandler's descriptor is 2
    (left,) = run.iterdir()
    assert left.stat().st_mode & 0o777 == 0o600
    tell_last_words(run)
    (told,) = caplog.records
    assert told.levelno == logging.WARNING and told.getMessage().endswith("had said: decoder: about to break")
    assert not list(run.iterdir())


def test_a_process_that_ends_well_leaves_nothing_and_one_that_lives_is_left_alone(tmp_path, caplog):
    run = tmp_path / "run"
    run.mkdir(mode=0o700)
    command = python.make_isolated_command("-c", CRASH.format(root=str(ROOT), end="print('now', flush=True); input()"))
    env = {**os.environ, "RUNTIME_DIRECTORY": str(run)}
    with subprocess.Popen(command, env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as living:
        assert living.stdout.readline() == "now\n"
        tell_last_words(run)
        assert len(list(run.iterdir())) == 1 and not caplog.records
        living.communicate("\n")
    assert living.returncode == 0 and not list(run.iterdir())


def test_what_somebody_else_put_there_is_not_told(tmp_path, caplog):
    (tmp_path / "run").mkdir(mode=0o700)
    (tmp_path / "secret").write_bytes(b"secret")
    (tmp_path / "run" / "a.said").symlink_to(tmp_path / "secret")
    os.mkfifo(tmp_path / "run" / "b.said")
    (tmp_path / "run" / "c.said").write_bytes(b"x" * 1_000_000)
    tell_last_words(tmp_path / "run")
    tell_last_words(tmp_path / "absent")
    assert not caplog.records and (tmp_path / "secret").exists()


def test_without_a_folder_that_can_be_made_it_still_catches(tmp_path, catcher, capfd, debug):
    (tmp_path / "file").touch()
    catcher.folder = tmp_path / "file"
    with catch_library_lines():
        print_in_c(b"said\n")
    assert capfd.readouterr().err == ""
    assert any('said="said"' in each.getMessage() or "said=said" in each.getMessage() for each in debug.records)


def test_it_costs_little(catcher):
    """Measured: 6 microseconds beside other work; decoding the smallest photograph takes hundreds."""
    with catch_library_lines():
        pass
    began = time.process_time()
    for _ in range(2000):
        with catch_library_lines():
            pass
    assert time.process_time() - began < 2000 * 100e-6


DECODERS = {"imdecode", "imread", "imdecodemulti", "imreadmulti"}
ELSEWHERE = {
    "capture/image_header.py",  # in a process of its own
    "extras/evaluate/stability/perturbations.py",  # what it has encoded itself
}


def test_every_decoder_of_a_strangers_picture_is_listened_to():
    found = {}
    for file in (
        path
        for room in ("capture", "recon", "viewer", "extras", "splatnode/api")
        for path in (ROOT / room).rglob("*.py")
    ):
        text = file.read_text()
        if not any(name in text for name in DECODERS):
            continue
        tree = ast.parse(text)
        caught = {call for each in ast.walk(tree) if _catches(each) for call in ast.walk(each)}
        calls = [each for each in ast.walk(tree) if isinstance(each, ast.Attribute) and each.attr in DECODERS]
        if calls:
            found[str(file.relative_to(ROOT))] = all(each in caught for each in calls)
    assert {name for name, is_caught in found.items() if not is_caught} == ELSEWHERE
    assert found["capture/image_file.py"] and found["extras/batch/command.py"]


def _catches(node: ast.AST) -> bool:
    return isinstance(node, ast.With) and any(
        isinstance(each.context_expr, ast.Call) and ast.unparse(each.context_expr.func) == "catch_library_lines"
        for each in node.items
    )
