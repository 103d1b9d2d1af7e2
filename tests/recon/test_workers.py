import threading

import pytest

from splatnode.recon.workers import each


def test_results_are_in_order_and_arguments_go_together():
    assert each(pow, [2, 3, 4], [3, 2, 1]) == [8, 9, 4]
    assert each(abs, []) == []


def test_work_is_done_beside_the_caller_and_its_errors_are_raised():
    assert threading.get_ident() not in each(lambda _: threading.get_ident(), range(4))
    with pytest.raises(ZeroDivisionError):
        each(lambda x: 1 / x, [1, 0])
