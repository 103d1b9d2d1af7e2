"""What the parsimony benchmark tells of its rows, and the configurations that it compares."""

from __future__ import annotations

import json
import os

import pytest

from splatnode.extras.evaluate.protocol import Settings
from tests.bench.quality.parsimony import configurations, write
from tests.bench.quality.parsimony_chart import (
    PIXEL,
    RIVAL,
    SELF,
    draw,
    half_is_worse,
    no_worse_than_pixels,
    on_front,
    summary,
    twice_is_better,
)


def row(method: str, count: int, psnr: float, ssim: float = 0.8, lpips: float = 0.1, views: int = 6) -> dict:
    sizes = {"num_gaussians": count, "spz_bytes": 17 * count, "peak_rss_mb": 700.0}
    return {"scene": "s", "views": views, "method": method, "psnr": psnr, "ssim": ssim, "lpips": lpips, **sizes}


def methods(*rows: dict) -> dict[str, dict]:
    return {each["method"]: each for each in rows}


def test_a_chosen_scene_is_on_the_front_unless_a_smaller_one_is_better():
    chosen = row(SELF, 100, 25.0)
    larger, worse = row("x2", 200, 26.0), row("x0.5", 50, 24.0, 0.7, 0.2)
    assert all(on_front(methods(chosen, larger, worse)).values())
    better = row("x0.25", 25, 25.1, 0.7, 0.2)  # but only in one measure
    assert on_front(methods(chosen, better)) == {"psnr": False, "ssim": True, "lpips": True, "together": True}
    assert not any(on_front(methods(chosen, row(RIVAL, 100, 25.1, 0.9, 0.05))).values())


def test_no_worse_than_a_gaussian_a_pixel_means_within_the_bars():
    chosen = row(SELF, 100, 25.0, 0.800, 0.100)
    assert all(no_worse_than_pixels(methods(chosen, row(PIXEL, 1000, 25.09, 0.804, 0.099))).values())
    assert not any(no_worse_than_pixels(methods(chosen, row(PIXEL, 1000, 25.11, 0.806, 0.097))).values())


def test_half_is_worse_where_two_measures_are_and_twice_is_better_beyond_a_margin():
    chosen = row(SELF, 100, 25.0, 0.800, 0.100)
    assert half_is_worse(methods(chosen, row("x0.5", 50, 24.9, 0.799, 0.09)))
    assert not half_is_worse(methods(chosen, row("x0.5", 50, 25.1, 0.801, 0.11)))
    within, beyond = row("x2", 200, 25.09, 0.8029, 0.0981), row("x2", 200, 25.11, 0.8031, 0.0979)
    assert not any(twice_is_better(methods(chosen, within)).values())
    assert all(twice_is_better(methods(chosen, beyond)).values())
    told = summary([chosen, row("x0.5", 50, 24.0, 0.7, 0.2), beyond, row(SELF, 100, 20.0, views=3)])
    assert (told["sized"], told["half_is_worse"], told["twice_is_better"]["lpips"]) == (1, 1, 1)


def test_a_file_is_replaced_whole(tmp_path):
    out, before = tmp_path / "parsimony.json", tmp_path / "before"
    out.write_text("before")
    os.link(out, before)
    write([], Settings(), out)
    assert before.read_text() == "before" and json.loads(out.read_text())["rows"] == []


def test_the_summary_takes_means_over_cases():
    rows = [
        row(SELF, 100, 25.0),
        row(PIXEL, 2000, 24.0),
        row(SELF, 300, 20.0, views=3),
        row(PIXEL, 2000, 20.0, views=3),
    ]
    told = summary(rows)
    assert told["cases"] == told["compared_with_pixels"] == 2
    assert told["share_of_pixels"] == pytest.approx(0.1)
    assert told["spz_mb_6_views"] == pytest.approx(0.0017) and told["peak_rss_mb_6_views"] == 700.0
    assert told["on_front"]["together"] == 2
    assert summary([])["cases"] == 0


def test_the_chart_is_a_picture():
    assert draw([row(SELF, 100, 25.0), row("x2", 200, 26.0), row(PIXEL, 900, 24.0)])[:4] == b"\x89PNG"


def test_the_rivals_are_of_the_size_that_was_chosen_and_refined_as_long():
    found = configurations(8000)
    assert found["x0.25"].most_gaussians == 2000 and found["x4"].most_gaussians == 32000
    assert found[RIVAL].first_gaussians == 8000 and found[SELF].most_gaussians is None
    assert found[PIXEL].pixelwise is not None and found[PIXEL].optimize.control is None
    assert len({config.optimize.iterations for config in found.values()}) == 1
