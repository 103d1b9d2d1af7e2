"""A wheel or an sdist on trial: in a clean environment outside the checkout, where it makes the scene of the demo."""

from __future__ import annotations

import json
import os
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatnode.capture.process import python

_OURS = ("PYTHON", "SPLATNODE", "VIRTUAL_ENV")  # how variables begin that would tell the environment of this one
_LAST = 2000  # characters of what a program said that failed
WANTED = {"webcam.yaml", "systemd/splatnode-capture.service", "udev/80-splatnode-oak.rules"}  # some of what is packed


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
