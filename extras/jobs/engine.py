"""Some processes at a time, each on cores of its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from typing import TypeVar

from splatnode.extras.jobs.child import Child, End, Limits

T = TypeVar("T")

_POLL_S = 0.02


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
