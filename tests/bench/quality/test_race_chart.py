"""The race's chart: what a point says of a method beside ours."""

from __future__ import annotations

from dataclasses import replace

import pytest

from splatnode.extras.evaluate.protocol import Row
from splatnode.extras.evaluate.report import LPIPS, PSNR
from tests.bench.quality import race_chart


def row(method: str, scene: str, psnr: float, *, seed: int = 0, size: int = 100, seconds: float | None = 10.0) -> Row:
    return Row(
        scene=scene,
        views=6,
        method=method,
        seed=seed,
        checkpoint=None,
        final=True,
        psnr=psnr,
        ssim=0.8,
        lpips_alex=psnr / 100,
        num_gaussians=size,
        seconds={"total": seconds},
        cores=1,
        processor="a",
        peak_rss_mb=None,
        verdict="OK",
    )


ROWS = [
    *(row("balanced", "fox", psnr, seed=seed) for seed, psnr in enumerate((20.0, 21.0, 22.0))),
    *(row("balanced", "fern", psnr, seed=seed) for seed, psnr in enumerate((24.0, 25.0, 26.0))),
    row("xl", "fox", 20.5, size=900, seconds=40.0),
    row("xl", "bridge", 30.0, size=900, seconds=40.0),  # ours was not scored there
    row("xl+fill", "fern", 26.0, size=400, seconds=None),
    row("untimed", "fern", 26.0, seconds=None),
]


def test_a_point_is_over_the_sets_that_both_have():
    ours, theirs = race_chart.points(ROWS, 6, PSNR)
    assert (ours.method, ours.sets, ours.time, ours.size, ours.lead) == ("balanced", 2, 1.0, 1.0, 0.0)
    assert ours.spread == pytest.approx(0.5**0.5)  # each of the two sets has 1.0
    assert (theirs.method, theirs.sets, theirs.time, theirs.size) == ("xl", 1, 4.0, 9.0)
    assert theirs.lead == pytest.approx(-0.5) and theirs.spread is None


def test_a_set_of_one_seed_counts_as_varying_like_the_others():
    more = [row("xl", "fox", 22.5, seed=1), row("xl", "fern", 25.0)]
    theirs = race_chart.points([*ROWS, *more], 6, PSNR)[1]
    assert theirs.lead == pytest.approx(0.25)  # of 21.5 beside 21, and 25 beside 25
    assert theirs.spread == pytest.approx(1.0)  # the variance is 2 on fox, and the mean is over two sets


def test_less_is_better_where_it_is():
    theirs = race_chart.points(ROWS, 6, LPIPS)[1]
    assert theirs.lead == pytest.approx(0.005)


def test_times_of_other_processors_are_not_compared():
    other = row("xl", "fox", 20.0, seconds=80.0)
    assert race_chart.times([*ROWS, other])["xl"] == pytest.approx(6.0)  # the median of 4 and 8
    assert race_chart.times([*ROWS, replace(other, processor="b")])["xl"] == 4.0


def test_it_is_drawn():
    assert race_chart.draw(ROWS).startswith(b"\x89PNG")
