"""How many threads a piece of work takes: the core's and torch's, of the thread that does it and of its helpers.

OpenCV's own threads are the process's and are left as they are: they change no result, and little of the work is
OpenCV's.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

from splatnode.recon import core
from splatnode.recon.core import current_thread_limit, limit_threads, num_usable_threads


@contextmanager
def apply_thread_limit(threads: int | None) -> Iterator[None]:
    """Inside the block this thread's work takes at most so many threads; None: as many as before.

    The work of other threads goes on as it did. Raises ValueError below 1.
    """
    with core.apply_thread_limit(threads):
        before = torch.get_num_threads()  # to be asked first: the first question in a thread sets it anew
        if threads is not None:
            torch.set_num_threads(core.num_usable_threads())
        try:
            yield
        finally:
            torch.set_num_threads(before)


# Independent pieces of work, one for each processor that the caller may use at a time.
#
# Threads pay where NumPy, OpenCV, SciPy, PoseLib or the core do the work, which let others run meanwhile. The
# functions must not change what others read.

Item = TypeVar("Item")
T = TypeVar("T")


def map_parallel(function: Callable[..., T], *arguments: Iterable) -> list[T]:
    """Returns `function` of each of the arguments, taken together as by `map`, in order."""
    return list(map_parallel_lazily(lambda together: function(*together), zip(*arguments, strict=False)))


def map_parallel_lazily(function: Callable[[Item], T], items: Iterable[Item]) -> Iterator[T]:
    """`function` of each of the items, in their order, as soon as it is known.

    Whoever stops asking gives up the few items that are under way, and no more are begun. What `function` raises is
    raised in the place of its result.
    """
    threads = num_usable_threads()
    waiting: deque[Future[T]] = deque()
    with ThreadPoolExecutor(threads, initializer=limit_threads, initargs=(current_thread_limit(),)) as pool:
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
