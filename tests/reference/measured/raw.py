"""Raw files of tests/bench/results/, numbers as the pages print them, and tables in Markdown."""

from __future__ import annotations

import gzip
import json
import textwrap
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from statistics import mean
from typing import Any

from tests.conftest import ROOT

RESULTS = ROOT / "tests" / "bench" / "results"
WIDTH = 118


@cache
def raw(name: str) -> dict[str, Any]:
    """Returns the content of a raw file, which may be compressed. Nobody may change it."""
    path = RESULTS / f"{name}.json"
    data = path.read_bytes() if path.exists() else gzip.decompress(path.with_suffix(".json.gz").read_bytes())
    return json.loads(data)


def part(value: float, digits: int) -> str:
    """Returns 0.8274 as .827, as the pages print what is below 1."""
    return f"{value:.{digits}f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.{digits}f}"


def change(value: float, digits: int = 1) -> str:
    """Returns a difference with its sign."""
    return f"{'−' if value < 0 else '+'}{part(abs(value), digits)}"


def thousands(count: float) -> str:
    """Returns 28 412 as 28 000."""
    return f"{round(count, -3):,.0f}".replace(",", " ")


def percent(share: float, digits: int = 0) -> str:
    """Returns .031 as 3 %."""
    return f"{100 * share:.{digits}f} %"


def span(ends: Sequence[float], digits: int = 2) -> str:
    """Returns the least and the greatest as `.83 to 1.07`."""
    return " to ".join(part(end, digits) for end in (min(ends), max(ends)))


def scores(row: dict[str, Any], lpips: str = "lpips") -> str:
    """Returns `26.0 / .890 / .073`: PSNR, SSIM, LPIPS."""
    return " / ".join((f"{row['psnr']:.1f}", part(row["ssim"], 3), part(row[lpips], 3)))


def ends(name: str, **wanted: object) -> list[dict[str, Any]]:
    """Returns the final rows of a benchmark that have the wanted values."""
    rows = [row for row in raw(name)["rows"] if row["final"]]
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def average_over_sets(rows: Iterable[dict[str, Any]], value: Callable[[dict[str, Any]], float]) -> float:
    """Returns the mean over sets of photographs of the mean over seeds."""
    sets: dict[tuple[str, int], list[float]] = {}
    for row in rows:
        sets.setdefault((row["scene"], row["views"]), []).append(value(row))
    return mean(mean(values) for values in sets.values())


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Returns a table in Markdown."""
    lines = [f"| {' | '.join(header)} |", f"{'|---' * len(header)}|"]
    return "\n".join([*lines, *(f"| {' | '.join(map(str, row))} |" for row in rows)])


def bullets(*sentences: str) -> str:
    """Returns a list in Markdown, broken into lines."""
    wrap = textwrap.TextWrapper(WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    kept = (f"- {sentence}".replace(" %", "\0%").replace(" dB", "\0dB") for sentence in sentences)
    return "\n".join(map(wrap.fill, kept)).replace("\0", " ")


def require(holds: bool, what: str) -> None:
    """Raises where a raw file no longer says what the words of a page say."""
    if not holds:
        raise AssertionError(f"a raw file says otherwise: {what}. Change the words in tests/reference/measured/")
