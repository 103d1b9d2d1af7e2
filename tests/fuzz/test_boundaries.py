"""Every boundary reads what an adversary draws for it, or refuses it with its own error; hypothesis chooses, too.

`./run fuzz` does the same millions of times, and watches the memory, the time, the disk and stderr as well.
"""

from __future__ import annotations

import logging
import random
import warnings

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.judgement import problem_of_value
from tests.support.adversary.boundaries import BOUNDARIES, Boundary, attempt
from tests.support.adversary.mutants import mutant

DRAWN = 300  # cases by chance, of those that take a millisecond or less
DRAWN_OF_SLOW = 40
CHOSEN = 40  # cases that hypothesis chooses
CHOSEN_OF_SLOW = 5
_SLOW = ("capture.yaml", "recon.yaml", "mcap files", "data sets", "weights")


def _is_slow(boundary: Boundary) -> bool:
    return boundary.name in _SLOW or boundary.name.startswith("port:")


@pytest.fixture(autouse=True)
def quiet():
    """What is refused is logged, here thousands of times."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("boundary", BOUNDARIES, ids=lambda boundary: boundary.name)
def test_what_is_drawn_is_read_or_refused(boundary: Boundary, tmp_path):
    outcomes = set()
    for number in range(DRAWN_OF_SLOW if _is_slow(boundary) else DRAWN):
        rng = random.Random(f"test {boundary.name} {number}")
        case = boundary.draw(rng)
        case = mutant(rng, case) if boundary.mutants and number % 3 == 2 else case
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", RuntimeWarning)  # NumPy's, of a stranger's numbers
                outcomes.add(attempt(boundary, case, tmp_path / "case"))
        except Exception as error:
            pytest.fail(f"case {number} of {boundary.name}: {type(error).__name__}: {error}\n{case!r:.2000}")
    assert "read" in outcomes  # else the cases are too wild to reach far into the boundary


@pytest.mark.parametrize("boundary", BOUNDARIES, ids=lambda boundary: boundary.name)
def test_what_hypothesis_chooses_is_read_or_refused(boundary: Boundary, tmp_path_factory):
    @settings(
        max_examples=CHOSEN_OF_SLOW if _is_slow(boundary) else CHOSEN,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        derandomize=True,
        database=None,
    )
    @given(chance=st.randoms(use_true_random=False))
    def check(chance: random.Random) -> None:
        attempt(boundary, boundary.draw(chance), tmp_path_factory.getbasetemp() / "chosen")

    check()


@pytest.mark.parametrize("boundary", [each for each in BOUNDARIES if not _is_slow(each)], ids=lambda each: each.name)
def test_what_is_read_is_finite_and_shows(boundary: Boundary, tmp_path):
    folder = tmp_path / "case"
    for number in range(60):
        folder.mkdir(mode=0o700, exist_ok=True)
        case = boundary.draw(random.Random(f"value {boundary.name} {number}"))
        try:
            found = boundary.read(case, folder)
        except boundary.reader.refusals:
            continue
        finally:
            folder = tmp_path / f"case{number}"
        assert problem_of_value(found, boundary.printed) == "", case
