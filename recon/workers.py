"""Independent pieces of work, one for each processor at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from splatnode.recon.core import default_threads

T = TypeVar("T")


def each(function: Callable[..., T], *arguments: Iterable) -> list[T]:
    """What `function` returns for each of the arguments, taken together as by `map`, in order.

    Threads pay where NumPy, OpenCV, SciPy or the core do the work, which let others run meanwhile. The function must
    not change what others read.
    """
    with ThreadPoolExecutor(default_threads()) as workers:
        return list(workers.map(function, *arguments))
