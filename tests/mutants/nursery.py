"""Runs pytest again and again without importing PyTorch again and again: `python -m tests.mutants.nursery`.

It imports what the product and its tests need of others, and nothing of the product. For each line of JSON on its
standard input, {"arguments": [...], "output": FILE, "timeout_s": S}, it forks a process that runs pytest, and answers
with a line: the exit code, or null where the time did not suffice.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import time

PACKAGES = ("torch", "cv2", "scipy.optimize", "scipy.spatial", "hypothesis", "msgspec", "zmq", "yaml", "pytest")
_LOOK_S = 0.05  # between looks at whether pytest has ended
_UNDER_PYTEST = 3  # exit code where pytest itself could not be run


def main() -> None:
    for name in PACKAGES:
        importlib.import_module(name)
    for line in sys.stdin:
        request = json.loads(line)
        child = os.fork()
        if child == 0:
            _become_pytest(request["arguments"], request["output"])
        print(json.dumps(_wait(child, request["timeout_s"])), flush=True)


def _become_pytest(arguments: list[str], output: str) -> None:
    """Ends the process."""
    code = _UNDER_PYTEST
    try:
        os.setsid()  # with all that tests start
        nothing, told = os.open(os.devnull, os.O_RDONLY), os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        for descriptor, source in ((0, nothing), (1, told), (2, told)):
            os.dup2(source, descriptor)
        import pytest

        code = int(pytest.main(arguments))
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
