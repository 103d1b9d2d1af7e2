"""What a run came to, as a table for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_HEAD = ("boundary", "cases", "refused", "accepted", "defects", "seconds", "slowest", "memory")


def lines(results: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A row for each boundary, and a line of counts for each other campaign."""
    found = []
    if "boundaries" in results:
        rows = [_HEAD, *(_cells(name, row) for name, row in results["boundaries"]["rows"].items())]
        widths = [max(len(row[column]) for row in rows) for column in range(len(_HEAD))]
        for row in rows:
            cells = [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
            found.append("  ".join([row[0].ljust(widths[0]), *cells]))
    for name, result in results.items():
        counts = {key: each for key, each in result.items() if isinstance(each, (int, float, str))}
        found.append(f"{name}: " + ", ".join(f"{key} {each}" for key, each in counts.items()))
    return found


def _cells(name: str, row: Mapping[str, Any]) -> tuple[str, ...]:
    slowest = f"{1e3 * row['slowest_s']:.0f} ms (case {row['slowest_case']})"
    counts = (str(row[key]) for key in ("cases", "refused", "accepted", "defects"))
    return name, *counts, f"{row['seconds']:.1f}", slowest, f"{row['peak_mb']:.0f} MB"
