"""The memory of this process: how much it has, and that malloc keeps what was freed.

Without keeping it, the kernel takes the pages of each frame back and zeroes them anew for the next one. Measured with
30 frames of 720p a second: a quarter of what the process costs besides decoding.
"""

from __future__ import annotations

import ctypes
import functools
import logging
import os

log = logging.getLogger(__name__)

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_LARGEST = 64 << 20  # bytes; larger arrays come from the kernel and go back to it. A frame of 20 megapixels is smaller


def keep_freed() -> None:
    """Has malloc keep freed memory; where the C library is not glibc, nothing changes."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGEST)
        mallopt(_M_TRIM_THRESHOLD, 2 * _LARGEST)


def resident_mb() -> float:
    """Resident memory of this process now, in 2^20 bytes; 0 where that cannot be read, which is said once.

    Heartbeats tell of it: where no file can be opened, they have the more to come.
    """
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    except (OSError, MemoryError, ValueError, IndexError) as error:
        _say_unknown(f"{type(error).__name__}: {error}")
        return 0.0


@functools.cache
def _say_unknown(why: str) -> None:
    log.warning("how much memory this process has cannot be read (%s): 0 MB is told", why)
