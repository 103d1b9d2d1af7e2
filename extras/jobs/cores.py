"""The cores that this process may use: which is free of other work of this user, and how much others took of them."""

from __future__ import annotations

import contextlib
import fcntl
import os
import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from splatnode.capture.process.files import make_owner_only_folder


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
