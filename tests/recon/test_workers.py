"""Work side by side: results in order, errors in their place, nothing begun for whoever stops asking."""

from __future__ import annotations

import threading

import pytest

from splatnode.recon.core import default_threads
from splatnode.recon.threads import map_parallel, map_parallel_lazily


def test_results_are_in_order_and_arguments_go_together():
    assert map_parallel(pow, [2, 3, 4], [3, 2, 1]) == [8, 9, 4]
    assert map_parallel(abs, []) == []


def test_work_is_done_beside_the_caller_and_its_errors_are_raised():
    assert threading.get_ident() not in map_parallel(lambda _: threading.get_ident(), range(4))
    with pytest.raises(ZeroDivisionError):
        map_parallel(lambda x: 1 / x, [1, 0])


def test_results_come_in_the_order_of_the_items():
    first_may_end = threading.Event()

    def slow_first(item: int) -> int:
        if item == 0 and default_threads() > 1:
            assert first_may_end.wait(60)
        first_may_end.set()
        return 10 * item

    assert list(map_parallel_lazily(slow_first, range(20))) == [10 * item for item in range(20)]
    assert list(map_parallel_lazily(slow_first, [])) == []


def test_an_error_comes_in_the_place_of_its_result():
    def fails(item: int) -> int:
        if item == 3:
            raise ValueError("the third")
        return item

    results = map_parallel_lazily(fails, range(10))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="the third"):
        next(results)


def test_who_stops_asking_begins_no_more():
    begun = []
    results = map_parallel_lazily(begun.append, range(1000))
    next(results)
    results.close()  # pyright: ignore[reportAttributeAccessIssue]
    assert len(begun) <= default_threads() + 2
