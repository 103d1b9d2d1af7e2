"""Calls, some at a time: in processes on cores of this machine, or on a Ray cluster.

On this machine they are made in copies of a process that has imported what they need: see `template`."""

from __future__ import annotations

import contextlib
import itertools
import json
import select
import shutil
import signal
import subprocess
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from splatnode.capture.process import python
from splatnode.capture.process.files import NotOwnerOnly, check_owner_only, make_owner_only_folder, temporary_folder
from splatnode.extras.jobs.call import LOG, Answer, answer_of, start_call, write_call
from splatnode.extras.jobs.child import NOT_RUN, Child, Limits, make_launch_command, run_processes, wait_for_end
from splatnode.extras.jobs.cores import chosen_cores, free_core, usable_cores
from splatnode.extras.jobs.version import other_version, own_version


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


@dataclass(frozen=True)
class Task:
    about: Any  # what the caller knows it by
    call: bytes  # `call.packed`


Take = Callable[[], Task | None]  # the next one; None where there is nothing to begin now
Answers = Callable[[Take, Limits, Path], Generator[tuple[Any, Answer], None, None]]


@dataclass(frozen=True)
class Engine:
    """The processes or the cluster that make calls.

    `answers(take, limits, folder)` gives what each task is about, with its answer, as they come. `take` is asked again
    after each end, and all is over when nothing runs any more. Calls that run on this machine lie in `folder` (of
    `work_folder`) meanwhile. What is running when the iterator is closed is ended.
    """

    cores_each: int  # that a call has
    answers: Answers


@contextlib.contextmanager
def work_folder(out: Path) -> Iterator[Path]:
    """An empty folder of this user alone for what is under way in `out`, which this process holds; removed at the end.

    Calls are pickles: whoever could put one there could run anything as this user. So it is a hidden folder in `out`
    where nobody else can change what lies there, else one among temporary files. Raises NotPrivate, OSError.
    """
    folder = out / ".calls"
    shutil.rmtree(folder, ignore_errors=True)  # of a driver that was killed
    try:
        check_owner_only(out)
    except NotOwnerOnly:
        with temporary_folder("splatnode-calls-") as instead:
            yield instead
        return
    if folder.is_symlink():
        folder.unlink()
    make_owner_only_folder(folder, "--out", ours=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def make_serial_engine() -> Engine:
    """One call at a time, on all cores that this process may use."""
    return _make_local_engine([usable_cores()])


@contextlib.contextmanager
def engine(cores: int | None, ray: str | None) -> Iterator[Engine]:
    """`cores` calls at a time, each on one core; None: one at a time, on all cores.

    `ray` is the address of a cluster; "": of one that is begun here. There each call has one core, and None means as
    many as keep all cores busy. Raises ValueError for more cores than there are; NoCluster; ModuleNotFoundError without
    ray.
    """
    if ray is None:
        yield make_serial_engine() if cores is None else _make_local_engine([(core,) for core in chosen_cores(cores)])
        return
    from splatnode.extras.jobs import ray as cluster  # takes a second, and is an extra

    with cluster.join_cluster(ray, None if ray else len(chosen_cores(cores))):
        yield Engine(1, partial(_answers_on_ray, cores))


def _make_local_engine(places: Sequence[Sequence[int]]) -> Engine:
    return Engine(len(places[0]), partial(_answers_here, places))


def _answers_here(
    places: Sequence[Sequence[int]], take: Take, limits: Limits, folder: Path
) -> Generator[tuple[Any, Answer], None, None]:
    numbers = itertools.count()

    def next_call() -> tuple[Any, Path] | None:
        return (task := take()) and (task.about, write_call(task.call, folder / str(next(numbers))))

    with open_copies(places[0]) as copies:
        running = run_processes(next_call, lambda item, cores: copies.start_call(item[1], cores), places, limits)
        with contextlib.closing(running):
            for (about, place), end in running:
                answer = answer_of(place, end)
                shutil.rmtree(place, ignore_errors=True)
                yield about, answer


def _answers_on_ray(most: int | None, take: Take, limits: Limits, _: Path) -> Generator[tuple[Any, Answer], None, None]:
    from splatnode.extras.jobs import ray

    numbers, under_way = itertools.count(), dict[int, Any]()

    def next_call() -> tuple[int, bytes] | None:
        if (task := take()) is None:
            return None
        under_way[number := next(numbers)] = task.about  # which stays here
        return number, task.call

    run = partial(_run_numbered, limits=limits, version=own_version())
    for (number, _call), found in ray.map_on_cluster(next_call, run, most, limits.memory_mb):
        yield under_way.pop(number), Answer(None, found.reason, NOT_RUN) if isinstance(found, ray.LostCall) else found


def _run_numbered(item: tuple[int, bytes], limits: Limits, version: str) -> Answer:
    return run_here(item[1], limits, version)


def run_here(call: bytes, limits: Limits, version: str) -> Answer:
    """Makes the call of a driver with this `version` of splatnode, on a core of this machine that no other work is on.

    It may be made more than once, after a worker or a machine is lost. Raises OSError where no file can be written.
    """
    if (other := other_version(version)) is not None:
        return Answer(None, other, NOT_RUN)
    with temporary_folder("splatnode-call-") as folder, free_core() as core:
        place = write_call(call, folder / "0")
        return answer_of(place, wait_for_end(start_call(place, (core,)), limits))
