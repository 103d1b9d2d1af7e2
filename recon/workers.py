"""Independent pieces of work, one for each processor that the caller may use at a time.

Threads pay where NumPy, OpenCV, SciPy, PoseLib or the core do the work, which let others run meanwhile. The functions
must not change what others read.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from splatnode.recon.core import allowed_threads, limit_threads, limited_threads

Item = TypeVar("Item")
T = TypeVar("T")


def each(function: Callable[..., T], *arguments: Iterable) -> list[T]:
    """What `function` returns for each of the arguments, taken together as by `map`, in order."""
    return list(in_turn(lambda together: function(*together), zip(*arguments, strict=False)))


def in_turn(function: Callable[[Item], T], items: Iterable[Item]) -> Iterator[T]:
    """`function` of each of the items, in their order, as soon as it is known.

    Whoever stops asking gives up the few items that are under way, and no more are begun. What `function` raises is
    raised in the place of its result.
    """
    threads = allowed_threads()
    waiting: deque[Future[T]] = deque()
    with ThreadPoolExecutor(threads, initializer=limit_threads, initargs=(limited_threads(),)) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > threads:  # one more than are worked on, so that nobody waits for the next
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
