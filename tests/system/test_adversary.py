"""Every boundary reads what an adversary draws for it, or refuses it with its own error; hypothesis chooses, too.

The bench does the same millions of times and watches the memory and the disk: `python -m tests.bench adversary`.
"""

from __future__ import annotations

import logging
import random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.support.adversary.boundaries import BOUNDARIES, Boundary, attempt

DRAWN = 300  # cases by chance
CHOSEN = 40  # cases that hypothesis chooses


@pytest.fixture(autouse=True)
def quiet():
    """What is refused is logged, here thousands of times."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("boundary", BOUNDARIES, ids=lambda boundary: boundary.name)
def test_what_is_drawn_is_read_or_refused(boundary: Boundary, tmp_path):
    outcomes = set()
    for number in range(DRAWN):
        case = boundary.draw(random.Random(f"test {boundary.name} {number}"))
        try:
            outcomes.add(attempt(boundary, case, tmp_path / "case"))
        except Exception as error:
            pytest.fail(f"case {number} of {boundary.name}: {type(error).__name__}: {error}\n{case!r:.2000}")
    assert "read" in outcomes  # else the cases are too wild to reach far into the boundary


@pytest.mark.parametrize("boundary", BOUNDARIES, ids=lambda boundary: boundary.name)
@settings(max_examples=CHOSEN, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True, database=None)
@given(chance=st.randoms(use_true_random=False))
def test_what_hypothesis_chooses_is_read_or_refused(boundary: Boundary, chance: random.Random, tmp_path_factory):
    attempt(boundary, boundary.draw(chance), tmp_path_factory.getbasetemp() / "chosen")
