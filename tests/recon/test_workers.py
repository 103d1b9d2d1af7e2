"""Work side by side: results in order, errors in their place, nothing begun for whoever stops asking."""

from __future__ import annotations

import threading

import pytest

from splatnode.recon.core import default_threads
from splatnode.recon.workers import each, in_turn


def test_results_are_in_order_and_arguments_go_together():
    assert each(pow, [2, 3, 4], [3, 2, 1]) == [8, 9, 4]
    assert each(abs, []) == []


def test_work_is_done_beside_the_caller_and_its_errors_are_raised():
    assert threading.get_ident() not in each(lambda _: threading.get_ident(), range(4))
    with pytest.raises(ZeroDivisionError):
        each(lambda x: 1 / x, [1, 0])


def test_results_come_in_the_order_of_the_items():
    first_may_end = threading.Event()

    def slow_first(item: int) -> int:
        if item == 0 and default_threads() > 1:
            assert first_may_end.wait(60)
        first_may_end.set()
        return 10 * item

    assert list(in_turn(slow_first, range(20))) == [10 * item for item in range(20)]
    assert list(in_turn(slow_first, [])) == []


def test_an_error_comes_in_the_place_of_its_result():
    def fails(item: int) -> int:
        if item == 3:
            raise ValueError("the third")
        return item

    results = in_turn(fails, range(10))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="the third"):
        next(results)


def test_who_stops_asking_begins_no_more():
    begun = []
    results = in_turn(begun.append, range(1000))
    next(results)
    results.close()  # pyright: ignore[reportAttributeAccessIssue]
    assert len(begun) <= default_threads() + 2
