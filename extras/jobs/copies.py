"""Calls in copies of a process that has imported what they need: see `template`."""

from __future__ import annotations

import contextlib
import json
import select
import signal
import subprocess
from collections.abc import Generator, Sequence
from pathlib import Path

from splatnode.capture.process import python
from splatnode.extras.jobs.call import LOG, start_call
from splatnode.extras.jobs.child import Child, make_launch_command


class Copies:
    """Begins processes that make calls; `open_copies` makes one."""

    def __init__(self, cores: Sequence[int]) -> None:
        self._cores = cores
        self._template: _Template | None = None

    def start_call(self, folder: Path, cores: Sequence[int]) -> Child:
        """A process that makes the call of a folder on `cores`. Raises OSError."""
        for _ in range(2):  # where memory runs out, the system may have ended the template
            if self._template is None:
                self._template = _Template(self._cores)
            if (copy := self._template.fork_copy(folder, cores)) is not None:
                return Child(copy, folder / LOG)
            self.close()
        return start_call(folder, cores)  # which tells why

    def close(self) -> None:
        if self._template is not None:
            self._template.close()
            self._template = None


@contextlib.contextmanager
def open_copies(cores: Sequence[int]) -> Generator[Copies, None, None]:
    """`cores` are as many as each call will have: libraries set their threads by them as they are imported."""
    copies = Copies(cores)
    try:
        yield copies
    finally:
        copies.close()


class _Template:
    """A template that runs, or has ended: then all its copies have."""

    def __init__(self, cores: Sequence[int]) -> None:
        self._process = subprocess.Popen(
            make_launch_command(python.command("splatnode.extras.jobs.template"), cores),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            bufsize=0,
        )
        self._rest = b""
        self._alive = True
        self._begun: list[int] = []  # processes that were told since the last call
        self._codes: dict[int, int] = {}  # of processes that have ended

    def fork_copy(self, folder: Path, cores: Sequence[int]) -> _Copy | None:
        """None where the template has ended."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps([str(folder), list(cores)]).encode() + b"\n")
        except BrokenPipeError:
            return None
        while self._alive and not self._begun:
            self.listen(None)
        return _Copy(self._begun.pop(), self) if self._begun else None

    def code(self, pid: int, wait: bool = False) -> int | None:
        """The exit code of a copy; None while it runs."""
        self.listen(0.0)
        while wait and self._alive and pid not in self._codes:
            self.listen(None)
        return self._codes.get(pid, None if self._alive else -signal.SIGKILL)

    def listen(self, timeout_s: float | None) -> None:
        """Takes in what the template has told; None: waits until it tells anything."""
        told = self._process.stdout
        assert told is not None
        while self._alive and select.select([told], [], [], timeout_s)[0]:
            read, timeout_s = told.read(65536), 0.0
            self._alive = bool(read)
            *lines, self._rest = (self._rest + (read or b"")).split(b"\n")
            for pid, *code in (map(int, line.split()) for line in lines):
                if code:
                    self._codes[pid] = code[0]
                else:
                    self._begun.append(pid)
                    self._codes.pop(pid, None)  # of another process that had this number

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


class _Copy:
    """A `child.Process`."""

    def __init__(self, pid: int, template: _Template) -> None:
        self.pid = pid
        self._template = template

    def poll(self) -> int | None:
        return self._template.code(self.pid)

    def wait(self) -> int | None:
        return self._template.code(self.pid, wait=True)
