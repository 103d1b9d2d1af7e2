"""What is printed only shows, whoever wrote it."""

from __future__ import annotations

import ast
import io
import json
import subprocess
import sys

import pytest

from splatnode import command_line
from splatnode.capture.process.terminal import beneath, progress, sanitize_output, say
from tests.conftest import ROOT
from tests.support.hostile import TEXTS, unprintable


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_what_is_printed_only_shows(monkeypatch, text):
    out, err = io.StringIO(), io.StringIO()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", err)
    with sanitize_output():
        print("left out:", text)
        print(text, file=sys.stderr)
    assert not unprintable(out.getvalue() + err.getvalue())
    assert not any(line.startswith("<") and line[1:2].isdigit() for line in err.getvalue().split("\n"))
    assert sys.stdout is out and sys.stderr is err


def test_plain_text_and_json_stay_as_they_are(monkeypatch):
    out = io.StringIO()
    monkeypatch.setattr(sys, "stdout", out)
    said = json.dumps({"name": "Küche\n\x1b", "a": [1, "<0>"]}, indent=1)
    with sanitize_output():
        print(said)
        print("Küche ±0.5 °, 日本", "<a>", "x <0>")
    assert out.getvalue() == f"{said}\nKüche ±0.5 °, 日本 <a> x <0>\n"


def test_progress_is_for_a_terminal_and_goes_back_to_the_begin_of_its_line(monkeypatch):
    for stream, expected in ((Terminal(), "\ra\\x1b: 1 MB\n"), (io.StringIO(), "")):
        monkeypatch.setattr(sys, "stderr", stream)
        with sanitize_output():
            progress("a\x1b: 1 MB")
            progress("")
            assert not sys.stderr.isatty() and beneath(sys.stderr) is stream
        assert stream.getvalue() == expected


def test_what_is_printed_after_progress_begins_a_line_of_its_own(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stdout", screen)
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("COLUMNS", "12")
    with sanitize_output():
        progress("a: 1 of 10 photographs")
        progress("a: 2 of 10")
        progress("b")
        say("found")
        progress("c")
    assert screen.getvalue() == "\ra: 1 of 10 \ra: 2 of 10 \rb         \nfound\n\rc\n"


def test_a_process_without_standard_output_prints_nothing(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    with sanitize_output():
        print("nobody hears")
        progress("")


@pytest.mark.parametrize(
    "arguments",
    [
        ["\x1b[2J"],
        ["view", "a", "b\n<0>forged", "\x1b]0;t\x07"],
        ["replay", "no\x1b[31m folder\n<0>", "--out", "x"],
        ["export", "\u202escene\x07.ply", "--to", "spz"],
        ["replay", "x", "--size", "\x1b[2J"],
        ["weights", "fetch", "\x1b[2J\n<0>x"],
    ],
)
def test_a_complaint_about_an_argument_only_shows(arguments, capsys):
    try:
        code = command_line.main(arguments)
    except SystemExit as error:  # of argparse
        code = error.code
    said = capsys.readouterr()
    assert code == 2 and said.err and not unprintable(said.out + said.err)
    assert not any(line.startswith("<0>") for line in said.err.splitlines())


def test_a_complaint_of_the_process_only_shows():
    arguments = ["view", "a", "b\n<0>forged", "\x1b]0;t\x07"]
    done = subprocess.run([sys.executable, "-m", "splatnode", *arguments], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and not unprintable(done.stdout + done.stderr)
    assert not any(line.startswith("<0>") for line in done.stderr.splitlines())


def test_verbs_print_by_this_module_alone():
    """What is no line of text is JSON, which has no character that is not ASCII."""
    programs = {
        "terminal.py",
        "compile.py",
        "release.py",
        "probe.py",
    }  # all but the first run by themselves
    files = [path for room in ("capture", "recon", "viewer", "extras") for path in (ROOT / room).rglob("*.py")]
    printed = [
        f"{path}: {ast.unparse(node)}"
        for path in files
        if path.name not in programs
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    ]
    assert printed and all(": print(json.dumps(" in each for each in printed)
