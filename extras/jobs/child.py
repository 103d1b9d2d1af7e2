"""A process: started on cores of its own, watched, and ended where it takes too long or too much; or some at a time."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

from splatnode.capture.process import python
from splatnode.capture.process.files import open_itself
from splatnode.extras.jobs import launch

_LOOK_EVERY_S = 0.1  # at the memory
_POLL_S = 0.02
T = TypeVar("T")
_LARGEST_TAIL = 4096  # bytes of what it said that are looked through for a reason
_OURS = "splatnode: "  # before a sentence of the command line


@dataclass(frozen=True)
class Limits:
    """The limits of one process; None: none."""

    memory_mb: float | None = None  # 10^6 bytes of resident memory, with what its process has started
    timeout_s: float | None = None


@dataclass(frozen=True)
class End:
    """How a process ended."""

    exit_code: int | None  # None: it was killed
    reason: str  # one sentence, where it was killed or said one; else empty
    seconds: float
    memory_mb: float  # the most that was seen, a look each tenth of a second


NOT_RUN = End(None, "", 0.0, 0.0)  # of a process that was never begun


class Process(Protocol):
    """A process as a child uses it, which leads a group of its own. `Popen` is one."""

    @property
    def pid(self) -> int: ...

    def poll(self) -> int | None:
        """Its exit code, below 0 the number of the signal that ended it; None while it runs."""
        ...

    def wait(self) -> object:
        """Returns when it has ended."""
        ...


class Child:
    """A running process."""

    def __init__(self, process: Process, log: Path) -> None:
        """`log` is where it prints."""
        self._process, self._log, self._began_s = process, log, time.monotonic()
        self._looked_s = self._memory_mb = 0.0

    @classmethod
    def start(cls, command: Sequence[str], log: Path, cores: Sequence[int]) -> Child:
        """Starts it on `cores`; what it prints goes into `log`. Raises OSError."""
        with open_itself(log, "wb") as printed:
            process = subprocess.Popen(
                make_launch_command(command, cores),
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # who interrupts the driver must not make it fail
            )
        return cls(process, log)

    def check_end(self, limits: Limits) -> End | None:
        """How it ended; None while it runs. It is killed here where it exceeds `limits`."""
        code, now_s = self._process.poll(), time.monotonic()
        if code is not None:
            self.stop()  # what it has started and left
            return self._end(
                code if code >= 0 else None, _read_last_message(self._log) if code >= 0 else _describe_signal(-code)
            )
        if now_s >= self._looked_s + _LOOK_EVERY_S:
            self._looked_s, self._memory_mb = now_s, max(self._memory_mb, tree_mb(self._process.pid))
        if limits.memory_mb is not None and self._memory_mb > limits.memory_mb:
            return self._stop_for(f"took {self._memory_mb:.0f} MB of memory; --max-memory allows {limits.memory_mb:g}")
        if limits.timeout_s is not None and now_s - self._began_s > limits.timeout_s:
            return self._stop_for(f"took longer than the {limits.timeout_s:g} s that --timeout-s allows")
        return None

    def stop(self) -> None:
        """Ends it, and all that it has started, at once."""
        with contextlib.suppress(ProcessLookupError, PermissionError):  # nobody is left of them
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def _stop_for(self, reason: str) -> End:
        self.stop()
        return self._end(None, reason)

    def _end(self, exit_code: int | None, reason: str) -> End:
        return End(exit_code, reason, time.monotonic() - self._began_s, self._memory_mb)


def make_launch_command(command: Sequence[str], cores: Sequence[int]) -> list[str]:
    """The command that runs `command` on `cores` until this process ends: see `launch`."""
    told = [launch.__file__, str(os.getpid()), ",".join(map(str, cores))]
    return python.make_isolated_command("-S", *told, *command)


def wait_for_end(child: Child, limits: Limits) -> End:
    """Waits for its end. It is ended where this is interrupted."""
    try:
        while (end := child.check_end(limits)) is None:
            time.sleep(_POLL_S)
        return end
    finally:
        child.stop()


def _describe_signal(number: int) -> str:
    name = signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"
    if number == signal.SIGKILL:
        return f"was killed ({name}): mostly memory has run out, and fewer --cores, or --max-memory, leave more of it"
    return f"was ended by {name}"


def _read_last_message(log: Path) -> str:
    """The last sentence for the user in what was printed, or the last line."""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _LARGEST_TAIL))
        lines = [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    ours = [line.removeprefix(_OURS) for line in lines if line.startswith(_OURS)]
    return (ours or [line.strip() for line in lines] or [""])[-1]


_PROC = Path("/proc")


def tree_mb(pid: int) -> float:
    """Resident memory now, in 10^6 bytes; what two of the processes share counts in each. 0 where they have ended."""
    try:
        pages = int((_PROC / str(pid) / "statm").read_text().split()[1])
        helpers = [int(child) for task in (_PROC / str(pid) / "task").iterdir() for child in _children(task)]
    except (OSError, IndexError):  # it has ended meanwhile
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6 + sum(map(tree_mb, helpers))


def _children(task: Path) -> list[str]:
    """None where the thread has ended, or where the kernel does not tell."""
    try:
        return (task / "children").read_text().split()
    except OSError:
        return []


def run_processes(
    take: Callable[[], T | None],
    start: Callable[[T, Sequence[int]], Child],
    places: Sequence[Sequence[int]],
    limits: Limits,
) -> Generator[tuple[T, End], None, None]:
    """Yields what `take` gives, each with its process's end, as they end; as many at a time as `places`.

    A place is the numbers of the cores that a process may use. `take` gives None where there is nothing to begin now:
    it is asked again after each end, and all is over when nothing runs any more. What is running when the iterator is
    closed is ended.
    """
    free, running = list(places), list[tuple[T, Sequence[int], Child]]()
    try:
        while True:
            while free and (task := take()) is not None:
                running.append((task, free[0], start(task, free[0])))
                free.pop(0)
            if not running:
                return
            looks = [(each, each[2].check_end(limits)) for each in running]
            running = [each for each, end in looks if end is None]
            over = [(each, end) for each, end in looks if end is not None]
            for (task, place, _), end in over:
                free.append(place)
                yield task, end
            if not over:
                time.sleep(_POLL_S)
    finally:
        for _, _, child in running:
            child.stop()
