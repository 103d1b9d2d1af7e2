"""Threads of a piece of work: the limit of one caller holds for it and its helpers, and for nobody else."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from splatnode.recon import core, threads
from splatnode.recon.matching.features import NearestNeighbourConfig, match, quantise
from splatnode.recon.threads import map_parallel


@pytest.fixture
def four():
    """The core with four threads, whatever this machine has."""
    core.set_threads(4)
    yield
    core.set_threads(core.default_threads())


def allowed() -> int:
    return core.library().core_get_threads()


def test_a_limit_holds_inside_the_block(four):
    with threads.apply_thread_limit(3):
        with threads.apply_thread_limit(2):
            assert allowed() == 2
        with threads.apply_thread_limit(None):
            assert allowed() == 3
        assert allowed() == 3
    assert allowed() == 4


def test_the_limit_of_one_caller_is_not_anothers(four):
    with ThreadPoolExecutor(1) as other, threads.apply_thread_limit(1):
        assert allowed() == 1 and torch.get_num_threads() == 1
        assert other.submit(allowed).result() == 4
        assert other.submit(core.current_thread_limit).result() is None


def test_helpers_have_the_limit_of_whom_they_help(four, monkeypatch):
    monkeypatch.setattr(core, "default_threads", lambda: 4)
    beside, most, guard = set(), [], threading.Lock()

    def work(item: int) -> int:
        with guard:
            beside.add(item)
            most.append(len(beside))
        time.sleep(0.02)
        with guard:
            beside.remove(item)
        return allowed()

    with threads.apply_thread_limit(2):
        assert set(map_parallel(work, range(8))) == {2}
    assert max(most) <= 2
    assert set(map_parallel(work, range(8))) == {4}


def test_a_result_is_the_same_however_many_threads_work_and_whoever_works_beside(four):
    rng = np.random.default_rng(0)
    drawn = np.abs(rng.normal(size=(2, 3000, 128)))
    first, second = quantise((drawn / np.linalg.norm(drawn, axis=2, keepdims=True)).astype(np.float32))
    alone = match(first, second, NearestNeighbourConfig(ratio=1.0))
    assert len(alone)

    def limited(count: int) -> bool:
        with threads.apply_thread_limit(count):
            return all(np.array_equal(match(first, second, NearestNeighbourConfig(ratio=1.0)), alone) for _ in range(3))

    with ThreadPoolExecutor(6) as pool:
        assert all(pool.map(limited, [1, 2, 3, 4, 1, 2]))


def test_torch_has_the_number_that_was_asked_for_also_in_a_new_thread():
    def in_a_block() -> int:
        with threads.apply_thread_limit(2):
            return torch.get_num_threads()

    before = torch.get_num_threads()
    with threads.apply_thread_limit(1), ThreadPoolExecutor(1) as other:
        assert other.submit(in_a_block).result() == min(2, core.default_threads())
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == before


def test_fewer_than_one_thread_is_refused():
    with pytest.raises(ValueError, match="threads must be at least 1, got 0"), threads.apply_thread_limit(0):
        pass
    assert core.current_thread_limit() is None
