"""What is said of the time and the memory before a reconstruction begins."""

from __future__ import annotations

import json
import re

import pytest

from splatnode.recon import cli
from tests.conftest import ROOT


def test_the_figures_are_those_that_were_measured():
    rows = json.loads((ROOT / "tests" / "bench" / "results" / "growth.json").read_text())["rows"]
    measured = tuple((row["views"], round(row["seconds"]["total"], 1), round(row["peak_rss_mb"])) for row in rows)
    assert measured == cli.MEASURED


def said(count: int, side: tuple[int, int] = (640, 480)) -> list[float]:
    """The numbers of the line: how many, megapixels, shortest, longest, least, most."""
    line = cli.format_cost([side] * count)
    assert line is not None and "\n" not in line
    return [float(number) for number in re.findall(r"[0-9.]+", line)]


def test_of_a_few_photographs_nothing_is_said():
    assert cli.format_cost([(4000, 3000)] * cli.FEW) is None
    assert cli.format_cost([(640, 480)] * (cli.FEW + 1)) is not None


@pytest.mark.parametrize(("views", "seconds", "megabytes"), cli.MEASURED[-2:])
def test_what_was_measured_lies_within_what_is_said(views, seconds, megabytes):
    line = cli.format_cost([(640, 480)] * views)
    assert line is not None and line.startswith(f"{views} photographs, ")
    *_, shortest, longest, least, most = said(views)
    unit = 60 if "minutes" in line else 1
    assert shortest * unit < seconds < longest * unit and least < megabytes / 1000 < most


def test_more_photographs_take_longer_and_larger_ones_more_memory():
    few, many, large = said(48), said(200), said(48, (4000, 3000))
    assert many[2] > 3 * few[2] and many[4] > 2 * few[4]
    assert large[2] == few[2] and large[1] == 576 and large[4] > few[4] + 0.9 * 3 * 48 * 11.5e-3
