"""Another user of the same machine: a process with an id of its own, where this one may make such a process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

OTHER = 64321  # a user whom no machine has


def needs_second_user() -> None:
    if os.geteuid() != 0:
        pytest.skip("needs root, which can be two users")


def as_other(program: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Runs the Python program as the other user, whose umask takes nothing."""
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        cwd="/",
        env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"},
        user=OTHER,
        group=OTHER,
        extra_groups=[],
        umask=0,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


def open_to_all(folder: Path) -> Path:
    """`folder`, as everybody's /tmp is; pytest's folders above it can be passed through."""
    folder.mkdir()
    folder.chmod(0o1777)
    for each in folder.parents:
        if each.stat().st_uid == os.geteuid() and not each.stat().st_mode & 0o001:
            each.chmod(each.stat().st_mode | 0o011)
    return folder
