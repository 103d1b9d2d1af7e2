"""The compiled core: one C ABI, built once per instruction set and chosen when it is first used.

Everything in here is reached through the Python functions beside its use (`recon.rasterize`,
`recon.priors.stereo`, ...), which check shapes and types; nothing else should call it.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from splatnode.recon.core.compile import INSTRUCTION_SETS, library_path, machine

# What the processor must be able to do before a library may be loaded, in the words of /proc/cpuinfo.
_REQUIRED_FLAGS = {
    "avx512": {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl", "avx2", "fma", "bmi2"},
    "avx2": {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe"},
    "neon_dotprod": {"asimddp"},
    "neon": set(),
    "baseline": set(),
}
_HWCAP = 16  # of the auxiliary vector (Linux, elf.h)
_HWCAP_ASIMDDP = 1 << 20  # of the processor (Linux on aarch64, asm/hwcap.h)


class _Limit(threading.local):
    """How many threads the work of one thread may take."""

    threads: int | None = None  # None: as many as the process may use


_limit = _Limit()


def instruction_sets() -> list[str]:
    """The instruction sets that are compiled here and that this processor can run, best first.

    `SPLATNODE_ISA` narrows the choice to one (for tests and benchmarks).
    """
    wanted = os.environ.get("SPLATNODE_ISA")
    flags = _processor_flags()
    return [
        name
        for name in INSTRUCTION_SETS.get(machine(), {"baseline": []})
        if _REQUIRED_FLAGS[name] <= flags and library_path(name).exists() and wanted in (None, name)
    ]


@functools.cache
def library(instruction_set: str | None = None) -> ctypes.CDLL:
    """The core library for the best instruction set, or for the one named. Its threads are set from the affinity.

    Raises RuntimeError when it has not been compiled.
    """
    usable = [instruction_set] if instruction_set else instruction_sets()
    if not usable:
        raise RuntimeError(
            "the compiled core is missing, or $SPLATNODE_ISA names one that cannot run here. "
            "Run: python recon/core/compile.py"
        )
    core = ctypes.CDLL(str(library_path(usable[0])))
    core.core_set_threads(default_threads())
    return core


def pointer(array: Any) -> ctypes.c_void_p:
    """To the first element of a C-contiguous NumPy array, which must outlive its use."""
    return ctypes.c_void_p(array.ctypes.data)


def default_threads() -> int:
    """As many threads as this process may use processors (its affinity, not the machine's size)."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def set_threads(threads: int) -> None:
    """Bounds the core's threads, for the whole process. Raises ValueError below 1."""
    library().core_set_threads(_check_threads(threads))


def num_usable_threads() -> int:
    """As many as the work of this thread may take, itself included."""
    return min(default_threads(), _limit.threads or sys.maxsize)


def current_thread_limit() -> int | None:
    """The limit that holds for the work of this thread; None: there is none."""
    return _limit.threads


def limit_threads(threads: int | None) -> None:
    """From now on the work of this thread takes at most so many; that of other threads is as it was.

    Raises ValueError below 1.
    """
    library().core_limit_threads(0 if threads is None else _check_threads(threads))
    _limit.threads = threads


@contextmanager
def apply_thread_limit(threads: int | None) -> Iterator[None]:
    """Inside the block the work of this thread takes at most so many threads; None: no other limit than before.

    Raises ValueError below 1.
    """
    before = _limit.threads
    limit_threads(before if threads is None else threads)
    try:
        yield
    finally:
        limit_threads(before)


def _check_threads(threads: int) -> int:
    if threads < 1:
        raise ValueError(f"threads must be at least 1, got {threads}")
    return threads


def give_back_memory() -> None:
    """Gives the system what the allocator holds of freed memory, where the C library can (glibc); takes some ms.

    Between the stages of a reconstruction that is up to a third of all that the process holds.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(ctypes.c_size_t(0))


def _processor_flags() -> set[str]:
    if machine() == "aarch64":
        return _aarch64_flags()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("flags"):
                return set(line.split(":", 1)[1].split())
    except OSError:
        pass
    return set()


def _aarch64_flags() -> set[str]:
    """Returns the CPU flags that matter. An emulator's /proc/cpuinfo is its host's; this query is right."""
    if sys.platform == "darwin":
        return {"asimddp"}  # from the first processors of Apple's own on
    capabilities = ctypes.CDLL(None).getauxval
    capabilities.restype = ctypes.c_ulong
    return {"asimddp"} if capabilities(ctypes.c_ulong(_HWCAP)) & _HWCAP_ASIMDDP else set()
