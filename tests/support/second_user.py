"""Another user of the same machine: a process with an id of its own, where this one may make such a process."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

OTHER = 64321  # a user whom no machine has


BECOMES = f"""
import os, socket, stat, sys  # before: the other user may not be able to read where they lie
os.setgroups([])
os.setresgid({OTHER}, {OTHER}, {OTHER})
os.setresuid({OTHER}, {OTHER}, {OTHER})
os.umask(0)
"""


@pytest.fixture
def shared_tmp() -> Iterator[Path]:
    """A folder as /tmp is: everybody may put something there. Skips where this process cannot be two users."""
    if os.geteuid() != 0:
        pytest.skip("needs root, which can be two users")
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o1777)
        if as_other("print(os.getuid(), os.access(sys.argv[1], os.W_OK))", folder).stdout != f"{OTHER} True\n":
            pytest.skip("needs root, which can be two users")
        yield Path(folder)


def as_other(program: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Runs the program, which has os, socket, stat and sys, as the other user, whose umask takes nothing."""
    command = [sys.executable, "-c", BECOMES + program, *map(str, arguments)]
    return subprocess.run(command, cwd="/", capture_output=True, text=True, check=False, timeout=60)
