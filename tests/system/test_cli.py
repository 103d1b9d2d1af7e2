"""The command line: what it loads, how it ends, what it says."""

from __future__ import annotations

import argparse
import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from splatnode import command_line
from splatnode.capture.process import system
from splatnode.capture.process.arguments import Verb
from splatnode.recon.result.export import ResultWriteError, list_format_names
from splatnode.recon.result.export.formats.ply import encode_ply
from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.recon.verbs import list_export_formats
from tests.conftest import ROOT


def run_verb(monkeypatch, command, *arguments):
    verb = Verb("act", "for the test", lambda parser: None, command)
    monkeypatch.setattr(command_line, "VERBS", (verb,))
    return command_line.main(["act", *arguments])


def raising(error):
    def command(args):
        raise error

    return command


def test_help_loads_nothing_but_the_verbs_and_what_stops_them():
    code = (
        "import sys, splatnode.command_line\n"
        "splatnode.command_line.build_parser().format_help()\n"
        "ours = [name for name, module in sys.modules.items() if name.startswith('splatnode.') and module.__file__]\n"
        "print(*sorted(name for name in ours if not hasattr(sys.modules[name], '__path__')))\n"
        "print(sorted({'cv2', 'msgspec', 'numpy', 'torch', 'zmq'} & set(sys.modules)))"
    )
    loaded, heavy = subprocess.check_output([sys.executable, "-c", code], cwd=ROOT, text=True).splitlines()
    assert loaded.split() == [
        "splatnode.capture.process.arguments",
        "splatnode.capture.process.files",
        "splatnode.capture.process.former_names",
        "splatnode.capture.process.library_lines",
        "splatnode.capture.process.plugins",
        "splatnode.capture.process.python",
        "splatnode.capture.process.start",
        "splatnode.capture.process.system",
        "splatnode.capture.process.terminal",
        "splatnode.capture.process.text",
        "splatnode.capture.verbs",
        "splatnode.command_line",
        "splatnode.extras.verbs",
        "splatnode.recon.metric.arguments",
        "splatnode.recon.verbs",
        "splatnode.viewer.verbs",
    ]
    assert heavy == "[]"


def test_a_verb_of_the_core_loads_no_plug_in():
    """Nor does it read where any is: what runs on a robot starts as if there were none."""
    code = (
        "import sys, splatnode.command_line\n"
        "from splatnode.capture.process import plugins\n"
        "plugins.entry_points = None\n"
        "parser = splatnode.command_line.build_parser('recon')\n"
        "assert parser.parse_args(['recon']).verb == 'recon'\n"
        "print(*sorted(name for name in sys.modules if name.startswith('splatnode.') and 'verb' in name))"
    )
    loaded = subprocess.check_output([sys.executable, "-c", code], cwd=ROOT, text=True).split()
    assert loaded == [
        "splatnode.capture.verbs",
        "splatnode.recon.verbs",
        "splatnode.viewer.verbs",
    ]


def test_no_threads_of_a_library_spin_while_they_wait():
    code = "import splatnode.command_line, os; print(os.environ['OMP_WAIT_POLICY'], os.environ['OPENBLAS_NUM_THREADS'])"
    plain = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    printed = subprocess.check_output([sys.executable, "-c", code], cwd=ROOT, env=plain, text=True)
    assert printed.split() == ["passive", "1"]


@pytest.mark.parametrize(
    "error, code",
    [
        (ValueError("size must be 1 or more, got 0"), 2),
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "photos"), 2),
        (NotADirectoryError(errno.ENOTDIR, "Not a directory", "photos"), 2),
        (PermissionError(errno.EACCES, "Permission denied", "photos"), 77),
        (ResultWriteError(errno.EACCES, "cannot write 3 files to out. Choose another folder"), 73),
        (ResultWriteError(errno.ENOTDIR, "cannot write 3 files to out. Choose another folder"), 73),
        (ResultWriteError(errno.ENOSPC, "cannot write 3 files to out. Free some space"), 74),
        (OSError(errno.EIO, "Input/output error"), 74),
        (ModuleNotFoundError("No module named 'cv2'", name="cv2"), 69),
        (RuntimeError("a bug"), 70),
        (ZeroDivisionError("a bug"), 70),
        (KeyboardInterrupt(), 130),
    ],
)
def test_an_error_is_one_line_and_a_code(monkeypatch, capsys, error, code):
    assert run_verb(monkeypatch, raising(error)) == code
    said = capsys.readouterr().err
    assert said.startswith("splatnode: ") and said.count("\n") == 1
    if not isinstance(error, KeyboardInterrupt):
        assert (getattr(error, "strerror", None) or str(error)) in said


@pytest.mark.parametrize("verb", [verb.name for verb in command_line.list_verbs()])
def test_every_verb_can_say_what_it_takes(verb, capsys):
    with pytest.raises(SystemExit) as end:
        command_line.main([verb, "--help"])
    assert end.value.code == 0 and f"splatnode {verb}" in capsys.readouterr().out


def test_a_missing_module_is_told_with_what_brings_it(monkeypatch, capsys):
    for module, brought in {**system.EXTRAS, **system.REQUIRED}.items():
        error = ModuleNotFoundError(f"No module named '{module}'", name=f"{module}.part")
        assert run_verb(monkeypatch, raising(error)) == 69
        named = f"'splatnode[{brought}]'" if module in system.EXTRAS else brought
        assert f"No module named '{module}'. " in (said := capsys.readouterr().err) and f"pip install {named}" in said
    assert run_verb(monkeypatch, raising(ModuleNotFoundError("No module named 'x'", name="x"))) == 69
    assert "pip install" not in (said := capsys.readouterr().err) and "./run in place of splatnode" in said


def test_what_brings_a_module_is_what_the_project_says():
    from importlib.metadata import requires

    extras = {}
    for line in requires("splatnode") or ():
        if "extra ==" in line:
            extras.setdefault(re.split(r"[<>=!~ \[;]", line)[0].lower(), set()).add(
                line.split("extra ==")[1].strip(" '\"")
            )
    distributions = {
        module: {"PIL": "pillow", "rerun": "rerun-sdk"}.get(module, module.replace("_", "-"))
        for module in system.EXTRAS
    }
    bringing = {module: extras.get(name, set()) - {"dev"} for module, name in distributions.items()}
    assert bringing == {module: {extra} for module, extra in system.EXTRAS.items()}
    # No module of splatnode needs what makes the site of docs/.
    assert {name for name, brought in extras.items() if brought - {"dev", "docs"}} == set(distributions.values())


@pytest.mark.parametrize("to", ["1", "2"])
def test_when_nobody_reads_any_more_nothing_is_said(to):
    program = (
        "import sys\nfrom splatnode import command_line\nfrom splatnode.capture.process.terminal import say\n"
        "from splatnode.capture.process.arguments import Verb\n"
        f"act = lambda args: [say('line', error={to == '2'}) for _ in range(100000)] and 0\n"
        "command_line.VERBS = (Verb('act', '', lambda parser: None, act),)\n"
        "sys.exit(command_line.main(['act']))"
    )
    piped = f'{{ "{sys.executable}" -c "$0" {"2>&1 >/dev/null" if to == "2" else ""}; echo $? >&3; }} | head -n 1'
    read, write = os.pipe()
    command = ["bash", "-c", f"exec 3>&{write}; {piped}", program]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, pass_fds=(write,), check=False)
    os.close(write)
    with os.fdopen(read) as codes:
        assert (codes.read(), done.stdout, done.stderr) == ("141\n", "line\n", "")


def test_debug_shows_the_traceback(monkeypatch, capsys):
    assert run_verb(monkeypatch, raising(RuntimeError("a bug")), "--debug") == 70
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("redirected, encoding", [(">&-", "utf-8"), ("", "ascii"), ("", "utf-8:strict")])
def test_what_standard_output_cannot_take_costs_no_result(tmp_path, redirected, encoding):
    name = "b\udcff" if encoding == "utf-8:strict" else "ü"
    command = f'"{sys.executable}" -m splatnode export "{tmp_path}" --to spz --out "{tmp_path}/{name}.spz" {redirected}'
    (tmp_path / "scene.ply").write_bytes(encode_ply(GaussianArrays.empty()))
    env = {**os.environ, "PYTHONIOENCODING": encoding}
    done = subprocess.run(["sh", "-c", command], cwd=ROOT, env=env, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert (tmp_path / f"{name}.spz").is_file()


@pytest.mark.parametrize("code", [0, 65])
def test_the_verb_decides_the_exit_code(monkeypatch, code):
    assert run_verb(monkeypatch, lambda args: code) == code


@pytest.mark.parametrize("number, code", [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_signals_end_a_verb_cleanly(number, code):
    program = (
        "import signal, sys, time\nfrom splatnode import command_line\n"
        "from splatnode.capture.process.arguments import Verb\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a shell's background jobs inherit it ignored
        "def wait(args):\n"
        "    try:\n"
        "        print('ready', flush=True)\n"
        "        time.sleep(60)\n"
        "    finally:\n"
        "        print('tidied', flush=True)\n"
        "command_line.VERBS = (Verb('wait', '', lambda parser: None, wait),)\n"
        "sys.exit(command_line.main(['wait']))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program], cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    time.sleep(0.05)
    process.send_signal(number)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, out) == (code, "tidied\n")
    assert "Traceback" not in err


def test_the_second_signal_ends_a_process_at_once():
    program = (
        "import signal\n"
        "from splatnode.capture.process import system\n"
        "now = [0.0]\n"
        "system.time.monotonic = lambda: now[0]\n"
        "system.handle_first_signal((signal.SIGTERM, signal.SIGINT), lambda: print('stopping', flush=True))\n"
        "for now[0], number in ((0.0, 15), (0.1, 15), (0.2, 2), (0.8, 2)):\n"
        "    signal.raise_signal(number)\n"
        "    print('goes on', flush=True)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, text=True, capture_output=True, timeout=60)
    assert (done.returncode, done.stdout) == (-signal.SIGINT, "stopping\ngoes on\ngoes on\ngoes on\n")


def test_a_stop_that_an_import_turns_into_its_own_error_is_a_stop(monkeypatch, capsys):
    def interrupted_import(_args):
        try:
            signal.raise_signal(signal.SIGTERM)
        except SystemExit as error:
            raise ImportError("cannot import name 'gui' from partially initialized module") from error

    before = signal.getsignal(signal.SIGTERM)
    try:
        assert run_verb(monkeypatch, interrupted_import) == 0
    finally:
        signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "argv, said",
    [
        (["replay", "photos"], "--out"),
        (["replay", "photos", "--out", "o", "--views", "0"], "must be a whole number from 1 to"),
        (["replay", "photos", "--out", "o", "--seed", str(2**63)], "must be a whole number from 0 to"),
        (["demo", "--out", "o", "--seed", str(2**63)], "must be a whole number from 0 to"),
        (["replay", "photos", "--out", "o", "--size", "big"], "must be a whole number from 1 to"),
        (["replay", "photos", "--out", "o", "--budget-s", "nan"], "must be a number of seconds above 0"),
        (["replay", "photos", "--out", "o", "--max-mb", "0"], "must be a number of megabytes above 0"),
        (["replay", "photos", "--out", "o", "--views", "3", "--frames", "a,b,c"], "not allowed with"),
        (["replay", "photos", "--out", "o", "--frames", "a,,c"], "commas between them"),
        (["export", "scene.ply", "--to", "docx"], "choose from"),
        (["export", "scene.ply", "--to", "ply", "--crop", "1,2,3"], "must be six numbers"),
        (["export", "scene.ply", "--to", "ply", "--crop", "-1,0,0,-2,1,1"], "must have x0 below x1"),
        (["export", "scene.ply", "--to", "ply", "--crop", "0,0,0,1,nan,1"], "must be six numbers"),
        (["replay", "photos", "--out", "o", "--crop", "0,0,0,1,1,1"], "unrecognized"),
        (["fly"], "choose from"),
    ],
)
def test_usage_errors_end_with_2(capsys, argv, said):
    with pytest.raises(SystemExit) as end:
        command_line.main(argv)
    assert end.value.code == 2
    assert said in capsys.readouterr().err


def test_no_verb_shows_the_help(capsys):
    assert command_line.main([]) == 2
    assert "replay" in capsys.readouterr().err


def test_replay_flags_arrive_and_unset_ones_are_none():
    parser = command_line.build_parser()
    args = parser.parse_args(["replay", "photos", "--out", "o", "--frames", "a.jpg, b.jpg", "--budget-s", "2.5"])
    assert args.frames == ("a.jpg", "b.jpg")
    assert args.budget_s == 2.5
    for unset in ("config", "preset", "prior", "size", "max_gaussians", "max_mb", "seed", "views"):
        assert getattr(args, unset) is None
    assert not args.json


def test_bench_lists_are_parsed():
    args = command_line.build_parser().parse_args(
        ["bench", "a", "b", "--views", "3,6,12", "--methods", "fast,best", "--checkpoints", "100,400", "--out", "o"]
    )
    assert (args.views, args.methods, args.seeds) == ((3, 6, 12), ("fast", "best"), 1)
    assert args.checkpoints == (100, 400)
    assert [scene.name for scene in args.scenes] == ["a", "b"]


def test_export_offers_the_formats_that_there_are():
    assert tuple(list_format_names()) == list_export_formats()


def test_export_writes_beside_the_scene_but_never_over_a_file(tmp_path, capsys):
    from splatnode.recon.result.export import read_gaussians, write_file
    from splatnode.recon.result.export.formats.ply import encode_ply

    one = GaussianArrays(
        means=np.zeros((1, 3), np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.full((1, 3), 0.1, np.float32),
        opacities=np.full(1, 0.5, np.float32),
        sh=np.zeros((1, 1, 3), np.float32),
        source_frame=np.zeros(1, np.int32),
    )
    write_file(tmp_path / "scene.ply", encode_ply(one))
    assert command_line.main(["export", str(tmp_path), "--to", "splat"]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "scene.splat")
    assert len(read_gaussians(tmp_path / "scene.splat")) == 1
    assert command_line.main(["export", str(tmp_path), "--to", "splat"]) == 2
    assert "--out" in capsys.readouterr().err


def test_a_box_may_begin_with_a_minus():
    argv = ["export", "scene.ply", "--to", "ply", "--crop", "-1,-.5,0,1,2.5,3", "--multi-view-only"]
    args = command_line.build_parser().parse_args(argv)
    assert args.crop == (-1, -0.5, 0, 1, 2.5, 3) and args.multi_view_only and args.scene.name == "scene.ply"


def test_doctor_finds_the_core_and_what_it_needs(capsys):
    assert command_line.main(["doctor", "--json"]) == 0
    states = {finding["name"]: finding["state"] for finding in json.loads(capsys.readouterr().out)}
    assert states["core"] == states["torch"] == states["numpy"] == "ok"


def test_doctor_demands_what_an_installation_brings_and_no_more():
    from importlib.metadata import requires

    from splatnode.recon import doctor

    plain = [line for line in requires("splatnode") or () if ";" not in line]  # without a condition
    assert set(doctor.REQUIRED.values()) == {re.split(r"[<>=!~ ]", line)[0].lower() for line in plain}


def test_a_user_without_a_home_is_told_what_to_set(monkeypatch, capsys):
    def no_home():
        raise RuntimeError("Could not determine home directory.")

    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME", "XDG_DATA_HOME", "SPLATNODE_WEIGHTS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", no_home)
    assert command_line.main(["doctor"]) == 2
    found = capsys.readouterr().out
    assert "has no home directory; set XDG_STATE_HOME" in found and "set SPLATNODE_WEIGHTS" in found
    assert command_line.main(["weights", "list"]) == 2
    assert capsys.readouterr().err.count("has no home directory; set SPLATNODE_WEIGHTS") == 1


def test_doctor_fails_when_the_core_is_missing(monkeypatch, capsys):
    from splatnode.recon import core, doctor

    def missing():
        raise RuntimeError("the compiled core is missing. Run: python recon/core/compile.py")

    monkeypatch.setattr(core, "library", missing)
    assert doctor.doctor(argparse.Namespace(json=False, rates=None)) == 2
    assert "Run: python recon/core/compile.py" in capsys.readouterr().out


def test_each_verb_leads_to_a_function():
    """Verbs name their functions in text, so that help loads nothing."""
    rooms = ("capture", "recon", "viewer", "extras", "splatnode")
    named = [
        found
        for room in rooms
        for path in (ROOT / room).rglob("*.py")
        for found in re.findall(r'import_lazily\(\s*"([\w.]+)",\s*"(\w+)"', path.read_text())
    ]
    assert len(named) > 20
    assert [each for each in named if not hasattr(import_module(each[0]), each[1])] == []
