"""The wheel and the sdist, and the compiler that makes them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from configparser import ConfigParser
from pathlib import Path

import pytest

from splatnode.recon.core import backend, compile
from tests.conftest import ROOT


def build(hook: str, project: Path, before: str = "", settings: dict[str, str] | None = None) -> Path:
    """What the build backend makes of `project`, with this environment's setuptools and no network."""
    code = f"from splatnode.recon.core import backend; {before}\nbackend.{hook}('dist', {settings!r})"
    environment = {**os.environ, "PYTHONPATH": str(project)}
    result = subprocess.run([sys.executable, "-c", code], cwd=project, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    (built,) = (project / "dist").iterdir()
    return built


def read_groups(text: str) -> dict[str, dict[str, str]]:
    """The entry points in a file of them, by group and name."""
    parser = ConfigParser()
    parser.read_string(text)
    return {group: dict(parser[group]) for group in parser.sections()}


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A copy of the project with its compiled core, to build in."""
    compile.compile_core()
    ignored = shutil.ignore_patterns(".git", ".venv", "out", "build", "dist", "__pycache__", "*.egg-info", ".*cache")
    return shutil.copytree(ROOT, tmp_path / "project", ignore=ignored, symlinks=True)


def test_the_wheel_installs_and_its_core_loads(project, tmp_path):
    wheel = build("build_wheel", project)
    assert wheel.name.startswith("splatnode-") and "-py3-none-" in wheel.name and not wheel.name.endswith("-any.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {path.name for path in compile.compile_core()} <= {Path(name).name for name in names}
    assert {"splatnode/__main__.py", "splatnode/capture/frame.py", "splatnode/recon/core/threads.cpp"} <= names
    assert {"splatnode/api/result.py", "splatnode/py.typed"} <= names
    configs = {path.relative_to(ROOT).as_posix() for path in (ROOT / "configs").rglob("*.*")}
    assert {f"splatnode/{name}" for name in configs} <= names and "configs/udev/80-splatnode-oak.rules" in configs
    page = {path.name for path in (ROOT / "viewer" / "web" / "page").iterdir()}
    assert {f"splatnode/viewer/web/page/{name}" for name in page} <= names and "main.js" in page
    assert not [name for name in names if not name.startswith(("splatnode/", "splatnode-"))]
    (told,) = [name for name in names if name.endswith(".dist-info/entry_points.txt")]
    metadata = read_groups(zipfile.ZipFile(wheel).read(told).decode())
    assert metadata.pop("console_scripts") == {"splatnode": "splatnode.__main__:main"}
    assert metadata == read_groups((ROOT / "extras" / "entry_points.txt").read_text())
    assert "splatnode/extras/entry_points.txt" in names

    site = tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(site)]
    subprocess.run([*pip, str(wheel)], check=True)
    code = "import splatnode; splatnode.Result; from splatnode.recon import core; core.library(); print(core.__file__)"
    loaded = subprocess.check_output(
        [sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(site)}, text=True
    )
    assert Path(loaded.strip()).is_relative_to(site)

    write = [sys.executable, "-m", "splatnode", "config", "--write", "mine"]
    subprocess.run(write, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(site)}, check=True)
    assert {f"configs/{path.relative_to(tmp_path / 'mine')}" for path in (tmp_path / "mine").rglob("*.*")} == configs


@pytest.mark.parametrize(
    ("target", "tag"), [("linux-aarch64", "manylinux_2_17_aarch64"), ("macos-arm64", "macosx_11_0_arm64")]
)
def test_a_wheel_for_another_machine_has_that_machines_libraries_alone(project, target, tag):
    """Here the compiler is left out; recon/core/release.py says how such a wheel is made."""
    for library in (project / "recon" / "core").glob("_core_*"):
        library.unlink()
    compiled = """
from splatnode.recon.core.compile import INSTRUCTION_SETS, library_path
def compiled(target):
    for name in INSTRUCTION_SETS[target.machine]:
        library_path(name, target.machine).write_bytes(b"")
backend.compile_core = compiled
"""
    wheel = build("build_wheel", project, compiled, {"target": target})
    assert wheel.name.endswith(f"-py3-none-{tag}.whl")
    names = {Path(name).name for name in zipfile.ZipFile(wheel).namelist()}
    libraries = {name for name in names if name.startswith("_core_")}
    assert libraries == {"_core_aarch64_neon_dotprod.so", "_core_aarch64_neon.so"}


def test_the_sdist_has_the_sources_and_nothing_compiled(project):
    with tarfile.open(build("build_sdist", project)) as archive:
        names = {name.split("/", 1)[-1] for name in archive.getnames()}
    core = ROOT / "recon" / "core"
    sources = {path.name for pattern in ("*.cpp", "*.h", "*.py") for path in core.glob(pattern)}
    assert {f"splatnode/recon/core/{name}" for name in sources} <= names
    assert {"splatnode/extras/entry_points.txt", "splatnode/extras/__init__.py"} <= names
    assert {"splatnode/viewer/web/page/main.js", "splatnode/py.typed", "splatnode/api/result.py"} <= names
    assert {"pyproject.toml", "constraints.txt", "run", "LICENSE", "tests/conftest.py"} <= names
    assert not [name for name in names if name.endswith((".so", ".stamp", ".pyc"))]


def test_without_a_compiler_the_build_asks_for_one(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(compile.importlib.util, "find_spec", lambda name: None)
    assert "ziglang" in backend.get_requires_for_build_wheel()
    assert "ziglang" in backend.get_requires_for_build_editable()
    with pytest.raises(RuntimeError, match="pip install ziglang"):
        compile.compile_core()


def test_with_a_compiler_the_build_asks_for_none(monkeypatch):
    monkeypatch.setenv("CXX", sys.executable)
    assert "ziglang" not in backend.get_requires_for_build_wheel()


def test_a_source_that_does_not_compile_leaves_the_library_alone(project):
    copy = project / "recon" / "core"
    before = {path.name: path.read_bytes() for path in copy.glob("_core_*")}
    for source in copy.glob("*.cpp"):
        source.unlink()
    (copy / "broken.cpp").write_text("int x = ;\n")
    result = subprocess.run([sys.executable, str(copy / "compile.py")], capture_output=True, text=True)
    assert result.returncode != 0
    assert "the C++ core did not compile" in result.stderr and "broken.cpp" in result.stderr
    assert "Traceback" not in result.stderr
    assert {path.name: path.read_bytes() for path in copy.glob("_core_*")} == before
    assert not list(copy.glob(".build-*"))


@pytest.mark.parametrize(
    "flags, wanted",
    [
        (["-march=x86-64-v3"], "-mcpu=x86_64_v3"),
        (["-march=x86-64-v4", "-mprefer-vector-width=512"], "-mcpu=x86_64_v4"),
        (["-march=armv8.2-a+dotprod"], "-mcpu=generic+v8_2a+dotprod"),
        ([], "-mcpu=baseline"),
    ],
)
def test_zig_is_told_the_processor_in_its_own_words(flags, wanted):
    told = compile._zig_flags(flags)
    assert wanted in told and not [flag for flag in told if flag.startswith("-march")]


def test_a_zig_wheel_runs_on_old_systems_and_another_on_this_one(monkeypatch):
    monkeypatch.setattr(compile.sysconfig, "get_platform", lambda: "linux-x86_64")
    monkeypatch.setattr(compile, "machine", lambda: "x86_64")
    monkeypatch.setattr(compile, "find_compiler", lambda: [sys.executable, "-m", "ziglang", "c++"])
    assert compile.platform_tag() == "manylinux_2_17_x86_64"
    monkeypatch.setattr(compile, "find_compiler", lambda: ["g++"])
    assert compile.platform_tag() == "linux_x86_64"


def run_script(*arguments: str, path: Path, venv: Path) -> subprocess.CompletedProcess[str]:
    environment = {"PATH": str(path), "SPLATNODE_VENV": str(venv), "HOME": str(venv)}
    return subprocess.run([str(ROOT / "run"), *arguments], env=environment, capture_output=True, text=True)


@pytest.fixture
def bare_path(tmp_path: Path) -> Path:
    """A PATH with what every Linux has and no Python."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for tool in ("cat", "cksum", "dirname", "sed"):
        (folder / tool).symlink_to(str(shutil.which(tool)))
    return folder


def test_run_names_the_command_where_there_is_no_python(bare_path, tmp_path):
    result = run_script("demo", path=bare_path, venv=tmp_path / "venv")
    assert result.returncode == 69
    assert "needs Python 3.10 or newer" in result.stderr and "apt-get install" in result.stderr


def test_run_names_the_command_where_python_is_too_old(bare_path, tmp_path):
    old = bare_path / "python3"
    old.write_text('#!/bin/sh\n[ "$1" = --version ] && echo Python 3.8.18 && exit\nexit 1\n')
    old.chmod(0o755)
    result = run_script("demo", path=bare_path, venv=tmp_path / "venv")
    assert result.returncode == 69
    assert "found Python 3.8.18" in result.stderr


def test_run_names_the_command_where_venv_is_missing(bare_path, tmp_path):
    without = bare_path / "python3"
    without.write_text('#!/bin/sh\ncase "$*" in *ensurepip*) exit 1;; esac\nexit 0\n')
    without.chmod(0o755)
    result = run_script("demo", path=bare_path, venv=tmp_path / "venv")
    assert result.returncode == 69
    assert "apt-get install python3-venv" in result.stderr


def test_run_without_a_verb_tells_the_verbs(bare_path, tmp_path):
    result = run_script(path=bare_path, venv=tmp_path / "venv")
    assert result.returncode == 2
    assert "demo" in result.stdout and "test" in result.stdout
