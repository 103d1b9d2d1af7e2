"""Case by case: the best other method, in each measure's own sense of better."""

from __future__ import annotations

import pytest

from splatnode.extras.evaluate.protocol import Row
from splatnode.extras.evaluate.regions import RegionScore
from splatnode.extras.evaluate.report import SHOWN, WHOLE, compute_margins, make_case_tables


def row(method: str, psnr: float | None, lpips: float = 0.1, scene: str = "church", seed: int = 0) -> Row:
    regions = {} if psnr is None else {"shown": RegionScore(80.0, psnr + 1, 0.9, lpips / 2)}
    return Row(
        scene=scene,
        views=6,
        method=method,
        seed=seed,
        checkpoint=None,
        final=True,
        psnr=psnr,
        ssim=None if psnr is None else 0.8,
        lpips_alex=None if psnr is None else lpips,
        regions=regions,
        seconds={"total": 1.0},
        peak_rss_mb=None,
        verdict="OK",
    )


ROWS = [
    row("balanced", 25.0, 0.10),
    row("balanced", 26.0, 0.10, seed=1),
    row("fast", 40.0, 0.01),  # ours, too: it is no rival
    row("instantsplat-xl", 24.0, 0.08),
    row("paper", 24.5, 0.20),
    row("balanced", None, scene="refused"),
    row("paper", 20.0, scene="refused"),
]


def test_the_best_other_is_chosen_by_the_measure():
    (psnr,), (perceptual,) = compute_margins(ROWS, WHOLE[0]), compute_margins(ROWS, WHOLE[2])
    assert (psnr.by, psnr.ours, psnr.lead) == ("paper", 25.5, pytest.approx(1.0))
    assert (perceptual.by, perceptual.lead) == ("instantsplat-xl", pytest.approx(-0.02))


def test_the_error_of_a_lead_is_that_of_both():
    (one,) = compute_margins(ROWS, WHOLE[0])
    (both,) = compute_margins([*ROWS, row("paper", 25.5, seed=1)], WHOLE[0])
    assert one.error is None  # the best other has one seed
    assert both.lead == pytest.approx(0.5) and both.error == pytest.approx(
        0.5**0.5
    )  # variances of .5, of two seeds each


def test_regions_are_compared_where_they_were_measured():
    (shown,) = compute_margins(ROWS, SHOWN[0])
    assert shown.ours == pytest.approx(26.5) and shown.best == pytest.approx(25.5)
    assert not compute_margins([r for r in ROWS if r.method in ("balanced", "fast")], SHOWN[0])


def test_the_table_says_what_is_lost():
    whole, shown = make_case_tables(ROWS)
    case, total = whole.body
    assert case[:4] == ("church 6", "25.50", "24.50 paper", "+1.00") and case[-1] == "-0.0200"
    assert total[1] == "1 of 1" and total[-3] == "0 of 1"
    assert shown.body[0][1] == "26.50"


def test_the_chart_of_the_cases_is_a_picture():
    case_chart = pytest.importorskip("splatnode.extras.evaluate.charts", reason="matplotlib is not installed")
    assert case_chart.draw_case_charts([*ROWS, row("paper", 25.5, seed=1)])["cases.png"].startswith(b"\x89PNG")
    assert case_chart.draw_case_charts([r for r in ROWS if r.method == "fast"]) == {}
