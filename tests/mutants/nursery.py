"""Runs pytest again and again without importing PyTorch again and again: `python -m tests.mutants.nursery`.

It imports what the product and its tests need of others, and nothing of the product. For each line of JSON on its
standard input, {"arguments": [...], "output": FILE, "timeout_s": S}, it forks a process that runs pytest, and answers
with a line: {"code": the exit code, or null where time did not suffice, "test": the first that failed, or the last}
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

PACKAGES = ("torch", "cv2", "scipy.optimize", "scipy.spatial", "hypothesis", "msgspec", "zmq", "yaml", "pytest")
_LOOK_S = 0.05  # between looks at whether pytest has ended
_UNDER_PYTEST = 3  # exit code where pytest itself could not be run


def main() -> None:
    for name in PACKAGES:
        importlib.import_module(name)
    for line in sys.stdin:
        request = json.loads(line)
        at_test = Path(f"{request['output']}.test")
        at_test.write_text("", encoding="utf-8")
        child = os.fork()
        if child == 0:
            _become_pytest(request["arguments"], request["output"], at_test)
        code = _wait(child, request["timeout_s"])
        print(json.dumps({"code": code, "test": at_test.read_text(encoding="utf-8") or None}), flush=True)


class _Watcher:
    """A plugin of pytest that writes down the id of the test that runs, up to the first that fails."""

    def __init__(self, path: Path) -> None:
        self._path, self._failed = path, False

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        if not self._failed:
            self._path.write_text(nodeid, encoding="utf-8")

    def pytest_runtest_logreport(self, report: Any) -> None:
        self._failed |= report.failed

    def pytest_collectreport(self, report: Any) -> None:
        if report.failed:
            self.pytest_runtest_logstart(report.nodeid)
            self._failed = True


def _become_pytest(arguments: list[str], output: str, at_test: Path) -> None:
    """Ends the process."""
    code = _UNDER_PYTEST
    try:
        os.setsid()  # with all that tests start
        nothing, written = (
            os.open(os.devnull, os.O_RDONLY),
            os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600),
        )
        for descriptor, source in ((0, nothing), (1, written), (2, written)):
            os.dup2(source, descriptor)
        import pytest

        code = int(pytest.main(arguments, plugins=[_Watcher(at_test)]))
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def _wait(child: int, timeout_s: float) -> int | None:
    ends = time.monotonic() + timeout_s
    while time.monotonic() < ends:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(_LOOK_S)
    os.killpg(child, signal.SIGTERM)
    time.sleep(_LOOK_S)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


if __name__ == "__main__":
    main()
