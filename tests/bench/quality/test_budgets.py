"""What the benchmark of budgets tells of its rows."""

from __future__ import annotations

from splatnode.recon.config import preset
from tests.bench.quality.budgets import LIMITS, Row, falls, within


def row(value: float, psnr: float, lpips: float = 0.1, limit: str = "max_mb") -> Row:
    return Row("s", 6, limit, value, 100, 1.0, False, psnr, 0.8, lpips)


def test_a_fall_is_told_where_more_bought_clearly_less():
    rising = [row(1.0, 20.0), row(2.0, 21.0), row(4.0, 20.96), row(8.0, 20.8)]
    assert falls(rising) == ["s 6, max_mb 4 to 8: psnr 20.960 to 20.800"]
    assert falls([row(1.0, 20.0, 0.1), row(2.0, 20.0, 0.11)]) == ["s 6, max_mb 1 to 2: lpips 0.100 to 0.110"]


def test_limits_of_different_kinds_are_not_compared():
    assert falls([row(1.0, 20.0), row(2.0, 10.0, limit="budget_s")]) == []


def test_each_limit_is_set_and_time_counts_from_the_points():
    config = preset("balanced")
    assert within(config, "budget_s", 3.0, spent=4.0).budget_s == 7.0
    assert within(config, "max_gaussians", 500.0, spent=4.0).most_gaussians == 500
    assert within(config, "max_mb", 0.4, spent=4.0).max_mb == 0.4
    assert all(list(values) == sorted(values) for values in LIMITS.values())
