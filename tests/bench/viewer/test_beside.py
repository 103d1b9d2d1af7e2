"""What the measurements of the viewer say of many runs."""

from __future__ import annotations

from tests.bench.viewer.beside import paired


def test_a_median_is_told_with_what_the_rounds_can_vouch_for():
    seven = paired([0.9, 1.1, 1.0, 0.95, 1.02, 0.99, 1.01])
    assert (seven["median"], seven["range"], seven["confidence"]) == (1.0, [0.9, 1.1], 0.984)  # 1 - 2 / 2**7
    nine = paired([float(value) for value in range(9)])
    assert (nine["range"], nine["confidence"]) == ([1.0, 7.0], 0.961)  # 1 - 2 (1 + 9) / 2**9
    assert paired([1.0])["confidence"] == 0.0  # one round vouches for nothing
