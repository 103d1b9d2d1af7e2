"""What is remembered between tests: a question is answered once, and no caller changes another's answer."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.core import apply_thread_limit
from tests.support import reuse


@pytest.fixture
def counted():
    asked: list[int] = []

    def double(image: np.ndarray, factor: int) -> np.ndarray:
        asked.append(factor)
        return factor * image

    return asked, reuse.remember(double, most=2)


def test_the_same_question_is_answered_once_and_another_anew(counted):
    asked, double = counted
    image = np.arange(6).reshape(2, 3)
    for factor in (2, 2, 3, 2):
        np.testing.assert_array_equal(double(image, factor), factor * image)
    assert asked == [2, 3]
    np.testing.assert_array_equal(double(image + 1, 2), 2 * (image + 1))
    with apply_thread_limit(1):
        double(image + 1, 2)
    assert asked == [2, 3, 2, 2]


def test_the_oldest_answer_goes_first_and_answers_are_the_callers_own(counted):
    asked, double = counted
    image = np.ones(3)
    double(image, 2)[:] = 0
    np.testing.assert_array_equal(double(image, 2), 2 * image)
    for factor in (3, 4, 2):
        double(image, factor)
    assert asked == [2, 3, 4, 2]


def test_tests_of_what_is_remembered_compute_it_each_time(counted, monkeypatch):
    asked, double = counted
    monkeypatch.setattr(reuse, "_active", False)
    double(np.ones(3), 2)
    double(np.ones(3), 2)
    assert asked == [2, 2]
