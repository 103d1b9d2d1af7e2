"""The memory of this process: how much it has, and that malloc keeps what was freed.

Without keeping it, the kernel takes the pages of each frame back and zeroes them anew for the next one. Measured with
30 frames of 720p a second: a quarter of what the process costs besides decoding.
"""

from __future__ import annotations

import ctypes
import os

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_LARGEST = 64 << 20  # bytes; larger arrays come from the kernel and go back to it. A frame of 20 megapixels is smaller


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
