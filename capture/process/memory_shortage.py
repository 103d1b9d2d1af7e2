"""Errors for want of memory, whoever asked for it."""

from __future__ import annotations

import errno
import re

SHORT_OF_MEMORY = "the memory or the threads that this process may have do not suffice: end others, or raise its limits"
# PyTorch and OpenCV have no exception of their own for it.
_OF_LIBRARIES = re.compile(
    r"can't allocate memory|not enough memory|Insufficient memory|Failed to allocate|bad_alloc|can't start new thread",
    re.IGNORECASE,
)


def is_shortage(error: BaseException) -> bool:
    """Whether something failed for want of memory, which says nothing of what it was done with."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    return isinstance(error, MemoryError) or bool(_OF_LIBRARIES.search(str(error)))
