"""How coarse pictures are while the person drags."""

from __future__ import annotations

import pytest

from splatnode.viewer.shapes import SLOWEST_S, choose_first_divisor, choose_next_divisor


@pytest.mark.parametrize(("seconds", "part"), [(0.0, 1), (0.05, 1), (0.08, 2), (0.2, 2), (0.4, 3), (5.0, 4)])
def test_the_first_picture_is_as_coarse_as_the_last_full_one_asks_for(seconds, part):
    assert choose_first_divisor(seconds) == part


def test_the_next_ones_keep_the_pace():
    assert choose_next_divisor(1, 0.2) == 2 and choose_next_divisor(4, 0.2) == 4
    assert choose_next_divisor(3, 0.04) == 3  # finer would be late
    assert choose_next_divisor(3, 0.005) == 2 and choose_next_divisor(1, 0.001) == 1


@pytest.mark.parametrize("full_s", [0.01, 0.1, 0.3, 0.7])
def test_it_settles(full_s):
    part = choose_first_divisor(full_s)
    parts = [part := choose_next_divisor(part, full_s / part**2) for _ in range(20)]
    assert len(set(parts[5:])) == 1 and full_s / parts[-1] ** 2 <= SLOWEST_S
