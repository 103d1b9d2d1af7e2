"""The copy of the checkout in which mutants live: the checkout itself is never changed."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.mutants.mutant import Mutant, apply_mutant

_CORE = "recon/core"
# The core for the best instruction set of this machine alone: the others would take twice as long again
_COMPILE = """
from splatnode.recon.core import compile, instruction_sets
family, best = compile.machine(), instruction_sets()[0]
for path in compile.HERE.glob("_core_*"):
    path.unlink()
compile.INSTRUCTION_SETS = {family: {best: compile.INSTRUCTION_SETS[family][best]}}
compile.compile_core()
"""
_ENDED_BY_TESTS = (1, 2)  # exit codes of pytest: a test failed; a file could not be read
_NOTHING_RAN = (0, 5)  # all passed; there was no test


@dataclass(frozen=True)
class TestRun:
    """One run of pytest: the first test that failed, if any, or the end of the time."""

    failed: str | None
    in_time: bool
    seconds: float


class Copy:
    """A clone of the checkout with what is not committed yet, and with the compiled core."""

    def __init__(self, root: Path, folder: Path) -> None:
        self._root, self.folder = root, folder
        self.commit = self._git(root, "rev-parse", "--short", "HEAD").strip()
        self._git(folder.parent, "clone", "--quiet", "--shared", "--no-checkout", str(root), str(folder))
        self._git(folder, "checkout", "--quiet", "--detach", self._git(root, "rev-parse", "HEAD").strip())
        self._carry_over("--modified", "--others", "--exclude-standard")
        for name in self._list_files("--deleted"):
            (folder / name).unlink(missing_ok=True)
        for pattern in ("_core_*.so", "_core_*.stamp"):
            for path in (root / _CORE).glob(pattern):
                shutil.copy2(path, folder / _CORE)
        self._nursery = subprocess.Popen(
            [sys.executable, "-m", "tests.mutants.nursery"],
            cwd=folder,
            env=self._environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    @contextmanager
    def apply(self, mutant: Mutant) -> Iterator[None]:
        """The copy has this fault for the while."""
        path = self.folder / mutant.file
        before = path.read_text(encoding="utf-8")
        libraries = {each: each.read_bytes() for each in (self.folder / _CORE).glob("_core_*")}
        self._write(path, apply_mutant(mutant, before))
        try:
            if mutant.is_native:
                subprocess.run([sys.executable, "-c", _COMPILE], check=True, cwd=self.folder, env=self._environment())
            yield
        finally:
            self._write(path, before)
            if mutant.is_native:
                for library, data in libraries.items():
                    library.unlink(missing_ok=True)  # one that is loaded stays whole
                    library.write_bytes(data)

    def run_tests(self, tests: Sequence[str], timeout_s: float, without: Sequence[str] = ()) -> TestRun:
        """Runs files of tests, or tests, in this order, up to the first that fails; long ones never run.

        Raises RuntimeError where pytest could not run them.
        """
        left_out = [part for each in without for part in ("--deselect", each)]
        options = ["-q", "-x", "--tb=no", "-p", "no:cacheprovider", "-m", "not long", *left_out]
        started = time.monotonic()
        output = self.folder.parent / "output"
        code, test = self._ask_nursery([*options, *tests], timeout_s, output)
        seconds = time.monotonic() - started
        if code is None or code in _NOTHING_RAN:
            return TestRun(None, code is not None, seconds)
        if (code in _ENDED_BY_TESTS or code < 0) and test:  # below 0: a signal ended the process, such as SIGSEGV
            return TestRun(test, True, seconds)
        told = output.read_text(encoding="utf-8", errors="replace")[-3000:]
        raise RuntimeError(f"pytest must pass or name a failed test, ended with {code}:\n{told}")

    def _ask_nursery(self, arguments: Sequence[str], timeout_s: float, output: Path) -> tuple[int | None, str | None]:
        """The exit code of pytest, which writes to `output`, and the first test that failed, or the last that ran."""
        assert self._nursery.stdin is not None and self._nursery.stdout is not None  # pipes
        request = {"arguments": [*arguments], "output": str(output), "timeout_s": timeout_s}
        self._nursery.stdin.write(json.dumps(request) + "\n")
        self._nursery.stdin.flush()
        answer = self._nursery.stdout.readline()
        if not answer:
            raise RuntimeError("the process that runs pytest must answer, and has ended")
        told = json.loads(answer)
        return told["code"], told["test"]

    def close(self) -> None:
        self._nursery.communicate()

    def _environment(self) -> Mapping[str, str]:
        shared = os.environ.get("SPLATNODE_SHARED", str(self._root.parent / "shared"))
        own = {
            "PYTHONPATH": str(self.folder),
            "SPLATNODE_SHARED": shared,
            "PYTEST_ADDOPTS": "",
            "PYTHONPYCACHEPREFIX": "",
        }
        return {**os.environ, **own}

    def _write(self, path: Path, text: str) -> None:
        """Python would take the bytecode of a text of the same length and second for that of this one."""
        path.write_text(text, encoding="utf-8")
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            compiled.unlink()

    def _carry_over(self, *which: str) -> None:
        for name in self._list_files(*which):
            source, target = self._root / name, self.folder / name
            if source.is_file() and not source.is_symlink():
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(source, target)

    def _list_files(self, *which: str) -> list[str]:
        return [name for name in self._git(self._root, "ls-files", "-z", *which).split("\0") if name]

    @staticmethod
    def _git(folder: Path, *arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=folder, check=True, capture_output=True, text=True).stdout


@contextmanager
def make_copy(root: Path) -> Iterator[Copy]:
    """A copy of the checkout in a temporary folder, which goes at the end."""
    with (
        TemporaryDirectory(prefix="splatnode-mutants-", ignore_cleanup_errors=True) as folder,
        contextlib.closing(Copy(root, Path(folder) / "checkout")) as copy,
    ):
        yield copy
