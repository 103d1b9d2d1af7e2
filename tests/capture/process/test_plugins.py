"""Plug-ins are found by the entry points of `extras` and of installed distributions, and loaded when they are used."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from configparser import ConfigParser
from pathlib import Path

import pytest

from splatnode.capture.config import Camera, CaptureConfig
from splatnode.capture.process import plugins
from splatnode.capture.process.config import ConfigError, load_config
from tests.conftest import ROOT

ALIEN = '''
"""Grey frames of another package."""

import msgspec


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    count: int = 2


def stream(config):
    return iter(())
'''
DECLARED = """
[console_scripts]
alien = alien_plugins:main

[splatnode.cameras]
alien = alien_plugins.camera [extra]
mcap = alien_plugins.camera
gone = alien_plugins.gone
wants = alien_plugins.wants

[splatnode.verbs]
greet = alien_plugins.verb:GREET
replay = alien_plugins.verb:GREET
gone = alien_plugins.verb:GONE
"""
VERB = """
from splatnode.capture.process.arguments import Verb

GREET = Verb("greet", "say hello", lambda parser: None, lambda args: print("hello") or 0)
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of the path in which a distribution with plug-ins is installed."""
    package, information = tmp_path / "alien_plugins", tmp_path / "alien-1.0.dist-info"
    package.mkdir()
    information.mkdir()
    modules = {"__init__": "", "camera": ALIEN, "verb": VERB, "wants": "import there_is_no_such_package"}
    for name, text in modules.items():
        (package / f"{name}.py").write_text(text)
    (information / "entry_points.txt").write_text(DECLARED)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for name in [name for name in sys.modules if name.split(".")[0] == "alien_plugins"]:
        del sys.modules[name]


def splatnode(*arguments: str, path: Path = ROOT, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(path)}
    command = [sys.executable, "-m", "splatnode", *arguments]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)


def test_what_extras_names_is_there():
    """Each line of its file leads to something, with the name that the line has."""
    groups = ConfigParser()
    groups.read_string((ROOT / "extras" / "entry_points.txt").read_text())
    assert {name.rpartition(".")[0] for name in groups.sections()} == {"splatnode"}
    for group in groups.sections():
        for name, target in groups[group].items():
            entry = plugins.entry_points(group)[name]
            assert entry.target == target and entry.file.samefile(ROOT / "extras" / "entry_points.txt")
            if group in (plugins.VERBS, plugins.VIEWERS):
                assert entry.load().name == name


def test_a_camera_of_another_package_is_a_kind_like_any_other(installed, tmp_path):
    path = tmp_path / "capture.yaml"
    path.write_text("camera: {kind: alien, count: 3}")
    camera = load_config(path, CaptureConfig).camera
    assert camera.config.count == 3 and camera.module.__name__ == "alien_plugins.camera"
    assert {"alien", "folder", "mcap"} <= set(Camera.kinds())
    assert Camera.load_module("mcap").__name__.startswith("splatnode.")  # a name that is taken stays as it was


def test_a_plug_in_that_cannot_be_imported_says_who_declares_it(installed):
    cameras = plugins.entry_points(plugins.CAMERAS)
    with pytest.raises(plugins.BrokenPlugin, match=r"'gone' of splatnode.cameras must be alien_plugins.gone, as "):
        cameras["gone"].load()
    with pytest.raises(ConfigError, match=r"gone: the plug-in alien_plugins\.gone of alien does not load"):
        Camera.load_module("gone")
    with pytest.raises(ModuleNotFoundError, match="there_is_no_such_package"):
        cameras["wants"].load()


def test_a_name_that_two_packages_give_to_two_things_is_refused_and_one_that_is_installed_twice_is_not(installed):
    again = installed / "later"
    for name, target in (("alien-0.9", "an_older.camera"), ("Martian_Eyes-1.0", "martian.camera")):
        (again / f"{name}.dist-info").mkdir(parents=True)
        lines = f"[splatnode.cameras]\nalien = {target}\ngone = alien_plugins.gone\nmcap = {target}\n"
        (again / f"{name}.dist-info" / "entry_points.txt").write_text(lines)
        sys.path.append(str(again) if name.startswith("alien") else "")
        cameras = plugins.entry_points(plugins.CAMERAS)
        if name.startswith("alien"):
            assert cameras["alien"].load().__name__ == "alien_plugins.camera"
    with pytest.raises(plugins.BrokenPlugin, match="brought by one package; alien and martian-eyes both do. Uninstall"):
        cameras["alien"].load()
    with pytest.raises(ConfigError, match="alien and martian-eyes both do"):
        Camera.load_module("alien")
    assert cameras["gone"].rival is None and cameras["mcap"].load().__name__.startswith("splatnode.")


def test_a_verb_of_another_package_is_offered_and_one_that_is_broken_is_left_out(installed):
    done = splatnode("greet", path=f"{installed}{os.pathsep}{ROOT}")
    assert (done.returncode, done.stdout) == (0, "hello\n")
    assert done.stderr.count("\n") == 1 and "left out: the plug-in 'gone'" in done.stderr
    assert "reconstruct a folder" in splatnode("--help", path=f"{installed}{os.pathsep}{ROOT}").stdout


BROKEN = """
from types import SimpleNamespace
from splatnode.capture.process.arguments import Verb
from splatnode.viewer.verbs import FurtherViewer

def fail(parser):
    raise KeyError("nothing")

LACKS = SimpleNamespace(name="lacks", summary="has no function")
FAILS = Verb("fails", "fails when its options are asked for", fail, lambda args: 0)
HELP = Verb("percent", "100% of it", lambda parser: parser.add_argument("--all", help="50%"), lambda args: 0)
VIEWER = FurtherViewer("fails", "fails when its options are asked for", "shows", lambda source, args: None, fail)
EMPTY = SimpleNamespace(name="empty")
"""
BROKEN_LINES = """
[splatnode.verbs]
lacks = broken_plugins:LACKS
fails = broken_plugins:FAILS
percent = broken_plugins:HELP

[splatnode.viewers]
fails = broken_plugins:VIEWER
empty = broken_plugins:EMPTY

[splatnode.export_formats]
empty = broken_plugins:EMPTY
"""


def test_a_plug_in_without_its_functions_is_named_and_the_rest_goes_on(tmp_path, monkeypatch):
    (tmp_path / "broken_plugins.py").write_text(BROKEN)
    (tmp_path / "broken-1.0.dist-info").mkdir()
    (tmp_path / "broken-1.0.dist-info" / "entry_points.txt").write_text(BROKEN_LINES)
    path = f"{tmp_path}{os.pathsep}{ROOT}"
    of_view = ["fails", "empty"]
    for words, names in ((["--help"], ["lacks", "fails", "percent", *of_view]), (["view", "--help"], of_view)):
        done = splatnode(*words, path=path)
        assert done.returncode == 0 and "usage: splatnode" in done.stdout and "Traceback" not in done.stderr
        assert [line.split("'")[1] for line in done.stderr.splitlines()] == names, done.stderr
    assert "has no add_arguments and no run" in splatnode("--help", path=path).stderr
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(
        plugins.BrokenPlugin, match="must have DEFAULT_NAME, export; broken_plugins:EMPTY of broken has"
    ):
        plugins.entry_points(plugins.EXPORT_FORMATS)["empty"].load()


def test_without_the_room_the_core_runs_and_offers_what_it_has(tmp_path):
    """As where `extras` is not installed: its verbs, cameras and formats are not offered, and the rest works."""
    copy = tmp_path / "copy"
    ignored = shutil.ignore_patterns("__pycache__", "extras", ".build-*")
    shutil.copytree(ROOT / "splatnode", copy / "splatnode", ignore=ignored)
    helped = splatnode("--help", path=copy, cwd=tmp_path).stdout
    assert "replay" in helped and "bench" not in helped and "calibrate" not in helped
    assert "mcap" not in splatnode("view", "--help", path=copy, cwd=tmp_path).stdout
    done = splatnode("bench", path=copy, cwd=tmp_path)
    assert done.returncode == 2 and "invalid choice: 'bench'" in done.stderr


@pytest.mark.parametrize("entry", ["", ".", "sub", "HERE"])
def test_a_folder_of_data_plugs_nothing_in(tmp_path, monkeypatch, entry):
    """As where $PYTHONPATH ends with a colon: the current folder is on the path, or a relative one."""
    for place in (tmp_path, tmp_path / "sub"):
        (place / "x.dist-info").mkdir(parents=True)
        (place / "x.dist-info" / "entry_points.txt").write_text("[splatnode.recordings]\nstranger = evil\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path) if entry == "HERE" else entry])
    assert "stranger" not in plugins.entry_points("splatnode.recordings")
