"""How many threads a piece of work takes: the core's and torch's, of the thread that does it and of its helpers.

OpenCV's own threads are the process's and are left as they are: they change no result, and little of the work is
OpenCV's.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from splatnode.recon import core


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
