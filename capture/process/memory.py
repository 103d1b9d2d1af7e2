"""The memory of this process: how much it has, that malloc keeps what was freed, and what an error for want of it is.

Without keeping it, the kernel takes the pages of each frame back and zeroes them anew for the next one. Measured with
30 frames of 720p a second: a quarter of what the process costs besides decoding.
"""

from __future__ import annotations

import ctypes
import errno
import os
import re

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_LARGEST = 64 << 20  # bytes; larger arrays come from the kernel and go back to it. A frame of 20 megapixels is smaller


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


def keep_freed() -> None:
    """Has malloc keep freed memory; where the C library is not glibc, nothing changes."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGEST)
        mallopt(_M_TRIM_THRESHOLD, 2 * _LARGEST)


def resident_mb() -> float:
    """Resident memory of this process now, in 2^20 bytes."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
