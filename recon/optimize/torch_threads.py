"""How many threads torch computes with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """One thread for torch inside the block, and as many as before after it.

    The core has its own threads; torch's would only wait for each other over the little that is left to them. Their
    number holds for the whole process: a generator must not be suspended inside the block.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
