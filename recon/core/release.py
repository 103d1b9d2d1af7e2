"""The release, and the proof that it works: `./run release [--out DIR] [TARGET ...]`; `./run wheels`: wheels alone.

Wheels are for other machines, too: Zig compiles the core for each target with all its instruction sets, and a copy of
the project with those libraries, and no others, goes through the build backend. Wheels are tied to a platform but to
no version of Python.

It makes the sdist and the wheels in `dist`. What this machine can run is installed in a clean environment outside the
checkout, where it makes the demo's scene: its wheel, and the sdist with a compiler and without one. Wheels for Linux
must need no newer system than their names say, as auditwheel sees it."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatnode.capture.process import python
from splatnode.recon.core.compile import HERE, TARGETS, find_compiler, find_zig, machine

ROOT = HERE.parents[1]
_PACKED = ("capture", "configs", "recon", "splatnode", "viewer", "pyproject.toml", "README.md", "LICENSE")
FROM_COPY = "import sys; sys.path.insert(0, sys.argv[1])"  # of the project, whose backend is the one that builds
_BUILD = f"""
{FROM_COPY}
from splatnode.recon.core import backend
print(backend.build_wheel(sys.argv[2], {{"target": sys.argv[3]}}))
"""
_OURS = ("PYTHON", "SPLATNODE", "VIRTUAL_ENV")  # how variables begin that would tell the environment of this one
_LAST = 2000  # characters of what a program said that failed
WANTED = {"webcam.yaml", "systemd/splatnode-capture.service", "udev/80-splatnode-oak.rules"}  # some of what is packed


def build_wheel(target: str, out: Path) -> Path:
    """The wheel for one of TARGETS, in the folder `out`. Raises RuntimeError where it cannot be built, with the reason.

    It needs setuptools and ziglang in this environment, and the project's own folder: an installed package will not do.
    """
    if not (ROOT / "pyproject.toml").exists():
        raise RuntimeError(f"{ROOT} is not the project's folder: wheels are built from a checkout or an sdist")
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="splatnode-wheel-") as folder:
        for name in _PACKED:
            _copy(ROOT / name, Path(folder) / name)
        command = python.make_isolated_command("-c", _BUILD, folder, str(out.resolve()), target)
        result = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if result.returncode != 0:
        raise RuntimeError(f"the wheel for {target} was not built:\n{result.stderr[-4000:]}")
    return out / result.stdout.splitlines()[-1]


def _copy(source: Path, to: Path) -> None:
    """Without what was compiled for this machine."""
    if source.is_dir():
        shutil.copytree(source, to, symlinks=True, ignore=shutil.ignore_patterns("_core_*", "__pycache__", ".build-*"))
    else:
        shutil.copy2(source, to)


class TrialFailed(Exception):
    """The artefact cannot be installed, or does not do what it should; the message says what was seen."""


@dataclass(frozen=True)
class Trial:
    """The result of an artefact's trial in a clean environment."""

    installed_bytes: int  # with all that it requires, and the byte code that pip compiles
    install_s: float
    demo: str  # the demo's verdict, with the quality of views that it had not seen


def try_artefact(artefact: Path, constraints: Path, folder: Path, compiler: bool) -> Trial:
    """Installs `artefact` in the empty `folder` and runs it there; without `compiler`, none can be found meanwhile.

    Raises TrialFailed.
    """
    environment = folder / "environment"
    programs = environment / "bin"
    variables = clean_environment(os.environ, None if compiler else programs)
    _run(python.make_isolated_command("-m", "venv", str(environment)), folder, variables)
    before, began_s = size_of(environment), time.monotonic()
    pip = [str(programs / "python"), "-I", "-m", "pip", "install", "--quiet", "-c", str(constraints)]
    _run([*pip, str(artefact)], folder, variables)
    install_s, installed_bytes = time.monotonic() - began_s, size_of(environment) - before
    _run([str(programs / "splatnode"), "config", "--write", "configs"], folder, variables)
    if lacking := [name for name in sorted(WANTED) if not (folder / "configs" / name).is_file()]:
        raise TrialFailed(f"`splatnode config --write` does not write {', '.join(lacking)}")
    report = _run([str(programs / "splatnode"), "demo", "--out", "demo", "--json"], folder, variables)
    return Trial(installed_bytes, install_s, format_verdict(json.loads(report)))


def format_verdict(report: dict[str, Any]) -> str:
    """The demo's report in a few words. Raises TrialFailed where its scene is not published, or was not measured."""
    code = report["verdict"]["code"]
    if not report["verdict"]["publishable"] or "held_out" not in report:
        raise TrialFailed(f"the demo's verdict is {code}: {report['verdict']['message']}")
    return f"{code}, {report['held_out']['psnr']:.1f} dB, {report['seconds']['total']:.0f} s"


def clean_environment(variables: os._Environ[str] | dict[str, str], only_path: Path | None) -> dict[str, str]:
    """The environment variables without what tells of this checkout; with `only_path`, without any compiler, too."""
    kept = {name: value for name, value in variables.items() if not name.startswith(_OURS)}
    if only_path is None:
        return kept
    kept.pop("CXX", None)
    return {**kept, "PATH": str(only_path)}


def size_of(folder: Path) -> int:
    """Bytes of all files beneath `folder`; links are not followed."""
    return sum(path.lstat().st_size for path in folder.rglob("*") if not path.is_dir() or path.is_symlink())


def _run(command: list[str], folder: Path, variables: dict[str, str]) -> str:
    """Returns the output of the command. Raises TrialFailed where it fails."""
    result = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True)
    if result.returncode != 0:
        said = (result.stderr or result.stdout).strip()[-_LAST:]
        raise TrialFailed(f"{Path(command[0]).name} {' '.join(command[1:])} ended with {result.returncode}:\n{said}")
    return result.stdout


_NOT_PACKED = (".*", "out", "build", "dist", "docs", "__pycache__", "*.egg-info", "_core_*")
_BUILD_SDIST = f"{FROM_COPY}; from splatnode.recon.core import backend; print(backend.build_sdist(sys.argv[2]))"
_HEADINGS = ("artefact", "size", "installed", "in", "demo")
_NO_TRIAL = "not for this machine"


@dataclass(frozen=True)
class Row:
    """One line of the table: an artefact, or a way to install it."""

    artefact: str
    size_bytes: int
    trial: Trial | None  # None: there was none, or it failed
    remark: str  # why there is no trial
    good: bool

    @property
    def cells(self) -> tuple[str, ...]:
        size = _megabytes(self.size_bytes)
        if self.trial is None:
            return (self.artefact, size, "-", "-", self.remark)
        installed, seconds = _megabytes(self.trial.installed_bytes), f"{self.trial.install_s:.0f} s"
        return (self.artefact, size, installed, seconds, self.trial.demo)


def table(rows: Sequence[Row]) -> str:
    """The rows beneath their headings, in columns."""
    lines = [_HEADINGS, *(row.cells for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(_HEADINGS))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )


def _megabytes(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.1f} MB" if size_bytes < 1e8 else f"{size_bytes / 1e6:.0f} MB"


def target_here() -> str | None:
    """The one of TARGETS that this machine can run, or None."""
    system = {"linux": "linux", "darwin": "macos"}.get(sys.platform)
    return next(
        (name for name in TARGETS if name.startswith(f"{system}-") and TARGETS[name].machine == machine()), None
    )


def build_sdist(out: Path) -> Path:
    """The sdist of the checkout, in the folder `out`. Raises RuntimeError where it cannot be built, with the reason."""
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="splatnode-sdist-") as folder:
        copy = Path(folder) / "splatnode"
        shutil.copytree(ROOT, copy, symlinks=True, ignore=shutil.ignore_patterns(*_NOT_PACKED))
        command = python.make_isolated_command("-c", _BUILD_SDIST, str(copy), str(out.resolve()))
        result = subprocess.run(command, cwd=copy, capture_output=True, text=True)
    if result.returncode != 0:
        raise RuntimeError(f"the sdist was not built:\n{result.stderr[-4000:]}")
    return out / result.stdout.splitlines()[-1]


def find_required_platform(said: str) -> str:
    """The platform tag that a wheel deserves, in what `auditwheel show` says of it. Raises RuntimeError without one."""
    words = " ".join(said.split())
    _, found, rest = words.partition('is consistent with the following platform tag: "')
    if not found:
        raise RuntimeError(f"auditwheel does not say what system the wheel needs: {words[:400]}")
    return rest.partition('"')[0]


def check_tag(wheel: Path) -> None:
    """Raises RuntimeError where a wheel for Linux needs a newer system than its name says, or cannot be judged."""
    command = python.make_isolated_command("-m", "auditwheel", "show", str(wheel))
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode != 0:
        raise RuntimeError(f"auditwheel cannot read {wheel.name}: {result.stderr[-1000:]}")
    if not wheel.stem.endswith(deserved := find_required_platform(result.stdout)):
        raise RuntimeError(f"{wheel.name} needs {deserved}")


def run_trial(name: str, artefact: Path, compiler: bool = True) -> Row:
    """The row of an artefact that is installed and run; what was seen where it fails goes to standard error."""
    size_bytes = artefact.stat().st_size
    print(f"trying {name} in a clean environment", file=sys.stderr, flush=True)
    with tempfile.TemporaryDirectory(prefix="splatnode-trial-") as folder:
        try:
            trial = try_artefact(artefact.resolve(), ROOT / "constraints.txt", Path(folder), compiler)
        except TrialFailed as error:
            print(f"{name}: {error}", file=sys.stderr, flush=True)
            return Row(name, size_bytes, None, "FAILED", good=False)
    return Row(name, size_bytes, trial, "", good=True)


def _wheel_row(target: str, out: Path) -> Row:
    wheel = build_wheel(target, out)
    if target.startswith("linux-"):
        check_tag(wheel)
    if target == target_here():
        return run_trial(wheel.name, wheel)
    return Row(wheel.name, wheel.stat().st_size, None, _NO_TRIAL, good=True)


def _sdist_rows(out: Path) -> list[Row]:
    sdist = build_sdist(out)
    rows = [run_trial(f"{sdist.name}, compiler of PyPI", sdist, compiler=False)]
    compiler = find_compiler()
    if compiler is None or compiler == find_zig():
        remark = "no compiler is installed here"
        return [*rows, Row(f"{sdist.name}, compiler installed", sdist.stat().st_size, None, remark, good=True)]
    return [*rows, run_trial(f"{sdist.name}, {compiler[0]}", sdist)]


def _row_or_failure(name: str, make: Callable[[], list[Row]]) -> list[Row]:
    """Returns the rows of `make`; an artefact that cannot be built, or is mislabelled, has its own row."""
    try:
        return make()
    except RuntimeError as error:
        print(f"{name}: {error}", file=sys.stderr, flush=True)
        return [Row(name, 0, None, "FAILED", good=False)]


def parse_arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    """Reads the targets, all by default, the folder, and whether wheels alone are wanted."""
    parser = argparse.ArgumentParser(prog="./run release", description=__doc__)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"some of {', '.join(TARGETS)} (default: all)")
    parser.add_argument("--out", type=Path, default=Path("dist"), metavar="DIR", help="default: dist")
    parser.add_argument("--wheels-only", action="store_true", help="make the wheels, and try nothing: ./run wheels")
    args = parser.parse_args(argv)
    if unknown := set(args.targets) - set(TARGETS):
        parser.error(f"no target {', '.join(sorted(unknown))}; there are: {', '.join(TARGETS)}")
    args.targets = args.targets or list(TARGETS)
    return args


def build_wheels(targets: Sequence[str], out: Path) -> int:
    """Builds the wheels and prints their paths; 1 where one could not be built."""
    failed = 0
    for target in targets:
        try:
            print(build_wheel(target, out), flush=True)
        except RuntimeError as error:
            print(error, file=sys.stderr)
            failed = 1
    return failed


def main(argv: Sequence[str] | None = None) -> int:
    """Makes the release and prints the table, or the wheels alone; 1 where anything is not good."""
    args = parse_arguments(argv)
    targets, out = args.targets, args.out
    if args.wheels_only:
        return build_wheels(targets, out)
    rows: list[Row] = []
    for target in targets:
        print(f"building the wheel for {target}", file=sys.stderr, flush=True)
        rows += _row_or_failure(f"wheel for {target}", lambda target=target: [_wheel_row(target, out)])
    print("building the sdist", file=sys.stderr, flush=True)
    rows += _row_or_failure("sdist", lambda: _sdist_rows(out))
    print(table(rows))
    bad = [row.artefact for row in rows if not row.good]
    print(f"NOT GOOD: {', '.join(bad)}" if bad else f"{out}: all good", file=sys.stderr if bad else sys.stdout)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
