"""What a report says of the process that made it."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.result.report import peak_rss_mb


def test_peak_memory_is_this_process_own():
    before = peak_rss_mb()
    if before is None:
        pytest.skip("this system does not tell a process's peak memory")
    block = np.ones(30_000_000, np.uint8) * 2
    after = peak_rss_mb()
    assert after is not None and after >= before and after * 1e6 > block.nbytes
