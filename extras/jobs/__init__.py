"""Work in processes of its own, some at a time: on cores of this machine, or on a Ray cluster. It runs without torch.

Here is one process with its limits, or some of them at a time, and calls of functions of values in processes; on this
machine these are copies of one that has imported what they need, the `template`; `ray` moves functions of values to a
cluster. None of them knows what the work is.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import io
import itertools
import json
import os
import pickle
import platform
import resource
import select
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from types import FunctionType
from typing import Any, Protocol, TypeVar

from splatnode.capture.process import python
from splatnode.capture.process.files import (
    NotOwnerOnly,
    check_owner_only,
    make_owner_only_folder,
    open_itself,
    temporary_folder,
)
from splatnode.extras.jobs import launch

# A process: started on cores of its own, watched, and ended where it takes too long or too much; or some at a time.

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
    arguments = [launch.__file__, str(os.getpid()), ",".join(map(str, cores))]
    return python.make_isolated_command("-S", *arguments, *command)


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


# The call of a function of values lies in a folder, `template` is its process, and the answer lies in the same folder,
# or the reason why there is none. On this machine calls are made in copies of a process that has imported what they
# need: see `template`. Each has cores of its own, free of other work of this user. Work that another machine does, or
# that goes on later, needs the same splatnode: its version, and a digest of its sources, which a version in
# development does not tell.

CALL, ANSWER, ERROR, LOG = "call", "answer", "error.txt", "log"  # files of a call's folder

Work = Callable[[], Any]  # that can be pickled: a functools.partial of a module's function


@dataclass(frozen=True)
class Answer:
    """The answer of a call."""

    pickled: bytes | None  # what the function returned; None: nothing
    reason: str  # why it returned nothing: a sentence, or what it raised with its traceback; else empty
    end: End  # of its process

    def value(self) -> Any:
        """Returns the function's result. Raises RuntimeError with the reason where there is none."""
        if self.pickled is None:
            raise RuntimeError(self.reason)
        return pickle.loads(self.pickled)


def pack_call(work: Work) -> bytes:
    """A call for any machine with this splatnode: where the modules of the call are found, the function's, the call."""
    packed = io.BytesIO()
    pickler = _Pickler(packed)
    pickler.dump(work)
    places = sorted(filter(None, {python.place_of(module) for module in pickler.modules}))
    module = getattr(work, "func", work).__module__
    return pickle.dumps(places) + pickle.dumps(module) + packed.getvalue()


class _Pickler(pickle.Pickler):
    """Notes the modules of all functions and classes that it writes."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.modules: set[str] = set()

    def persistent_id(self, obj: object) -> None:
        if isinstance(obj, (FunctionType, type)):
            self.modules.add(obj.__module__)


def write_call(call: bytes, folder: Path) -> Path:
    """Makes the folder of a `pack_call` call, for this user alone. Raises OSError, NotOwnerOnly where it cannot be."""
    make_owner_only_folder(folder, "--out or $TMPDIR", ours=True)
    (folder / CALL).write_bytes(call)
    return folder


def start_call(folder: Path, cores: Sequence[int]) -> Child:
    """A fresh process that makes the call of a folder on `cores`. Raises OSError."""
    return Child.start(python.command("splatnode.extras.jobs.template", str(folder)), folder / LOG, cores)


def answer_of(folder: Path, end: End) -> Answer:
    """The answer of a call whose process has ended; nobody else can put one into the folder of `write_call`."""
    if end.exit_code == 0 and (folder / ANSWER).exists():
        return Answer((folder / ANSWER).read_bytes(), "", end)
    if (folder / ERROR).exists():
        return Answer(None, (folder / ERROR).read_text(), end)
    return Answer(None, end.reason or f"ended with exit code {end.exit_code} and said nothing", end)


def usable_cores() -> tuple[int, ...]:
    """Their numbers, rising."""
    return tuple(sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1))


def chosen_cores(wanted: int | None) -> tuple[int, ...]:
    """The first `wanted` of them; None: all. Raises ValueError where there are fewer."""
    allowed = usable_cores()
    if wanted is not None and wanted > len(allowed):
        raise ValueError(f"--cores must be at most {len(allowed)}, which this process may use; got {wanted}")
    return allowed[:wanted]


@contextlib.contextmanager
def free_core() -> Iterator[int]:
    """A core that no other work is on, of whatever worker of this user; where none is, the one with this turn."""
    cores = usable_cores()
    folder = Path(tempfile.gettempdir(), f"splatnode-cores-{os.getuid()}")
    make_owner_only_folder(folder, "$TMPDIR", ours=True)
    for core in cores:
        with (folder / str(core)).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield core
            return
    yield cores[os.getpid() % len(cores)]


ALONE = 0.05  # others take at most so much of the time of the cores; the kernel counts in steps of 10 ms
_SLACK_S = 0.05  # of that counting
_NOT_IDLE = (0, 1, 2, 5, 6, 7)  # of a line of /proc/stat: user, nice, system, irq, softirq, stolen by other machines
_STAT = Path("/proc/stat")
_CPUS = Path("/sys/devices/system/cpu")


@dataclass(frozen=True)
class Moment:
    """The processor time that was used by a moment."""

    at_s: float  # of a clock that never goes back
    own_s: float  # processor time of this process and of those of its helpers that have ended
    busy_s: float | None  # time in which the cores did anything for anybody; None: the system does not tell
    cores: tuple[int, ...]  # on which this process may run


def now() -> Moment:
    """Returns the usage of this process's cores, and of those that share their circuits."""
    cores = usable_cores()
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    own_s = sum(each.ru_utime + each.ru_stime for each in used)
    return Moment(time.monotonic(), own_s, _busy_s(add_sibling_cores(cores)), cores)


def others_share(since: Moment, until: Moment) -> float | None:
    """The share of the time of the cores that others took between two moments; None where the system does not tell."""
    if since.busy_s is None or until.busy_s is None:
        return None
    passed_s = (until.at_s - since.at_s) * len(since.cores)
    others_s = until.busy_s - since.busy_s - (until.own_s - since.own_s)
    return max(0.0, others_s - _SLACK_S) / max(passed_s, _SLACK_S)


def add_sibling_cores(cores: tuple[int, ...], cpus: Path = _CPUS) -> set[int]:
    """The cores, and those that are further threads of the same physical ones: what runs there slows them."""
    found = set(cores)
    for core in cores:
        with contextlib.suppress(OSError, ValueError):
            found |= _parse_cpu_list((cpus / f"cpu{core}" / "topology" / "thread_siblings_list").read_text())
    return found


def _parse_cpu_list(text: str) -> set[int]:
    """Parses a list such as 0-3,8."""
    bounds = (part.partition("-") for part in text.strip().split(",") if part)
    return {number for first, _, last in bounds for number in range(int(first), int(last or first) + 1)}


def _busy_s(cores: set[int]) -> float | None:
    try:
        lines = [line.split() for line in _STAT.read_text().splitlines() if line.startswith("cpu")]
        counts = {line[0]: line[1:] for line in lines}
        ticks = sum(int(counts[f"cpu{core}"][column]) for core in cores for column in _NOT_IDLE)
    except (OSError, KeyError, IndexError, ValueError):  # not Linux, or a container that hides it
        return None
    return ticks / os.sysconf("SC_CLK_TCK") if ticks else None


_DIGITS = 8  # hexadecimal
_ROOMS = ("capture", "recon")  # whose code results depend on


@cache
def own_version() -> str:
    """Such as "0.1.0 (1f3a5b7c)"; two that are the same give the same results on one kind of processor."""
    package = Path(__file__).parents[2]
    digest = hashlib.sha256()
    for room in _ROOMS:
        for file in sorted((package / room).rglob("*.py")) + sorted((package / room / "core").glob("*.cpp")):
            digest.update(str(file.relative_to(package)).encode() + b"\0" + file.read_bytes())
    try:
        version = metadata.version("splatnode")
    except metadata.PackageNotFoundError:
        version = "not installed"
    return f"{version} ({digest.hexdigest()[:_DIGITS]})"


def other_version(begun_with: str) -> str | None:
    """Returns a message if this machine's splatnode is not the one that began the work; None if it is."""
    if (version := own_version()) == begun_with:
        return None
    there = f"the worker on {platform.node()} has splatnode {version}, the work was begun with {begun_with}"
    return f"{there}; install the same on all machines"


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
        output = self._process.stdout
        assert output is not None
        while self._alive and select.select([output], [], [], timeout_s)[0]:
            read, timeout_s = output.read(65536), 0.0
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
    where nobody else can change what lies there, else one among temporary files. Raises NotOwnerOnly, OSError.
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
