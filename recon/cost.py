"""What a reconstruction will take, roughly, before it begins: by what the built-in capture took, with as many views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

FEW = 12  # photographs: of so many, the end is near before an estimate is read
# Views, seconds and 10^6 bytes of the largest memory; two cores, preset balanced (tests/bench/results/growth.json).
MEASURED = ((3, 17.5, 481), (6, 23.2, 543), (12, 33.0, 629), (24, 55.9, 775), (48, 103.0, 1212))
_BYTES_A_PIXEL = 3  # of each photograph, which stays in memory as it was read
_SECONDS_RANGE = 0.5, 3.0  # times as long: more cores and a preset that does less, or a slow machine with other work
_MEMORY_RANGE = 0.9, 1.6


def format_cost(sizes: Sequence[tuple[int, int]]) -> str | None:
    """One line about the photographs with these widths and heights; None for so few that nobody needs to know."""
    if len(sizes) <= FEW:
        return None
    views, seconds, megabytes = np.array(MEASURED).T
    count, pixels = len(sizes), sum(width * height for width, height in sizes)
    took_s, took_mb = (
        _interpolate(count, views, seconds),
        _interpolate(count, views, megabytes) + _BYTES_A_PIXEL * pixels / 1e6,
    )
    shortest, longest = (took_s * times for times in _SECONDS_RANGE)
    least, most = (took_mb * times / 1000 for times in _MEMORY_RANGE)
    time = (
        f"{shortest:.0f} to {longest:.0f} s" if longest < 120 else f"{shortest / 60:.1f} to {longest / 60:.0f} minutes"
    )
    memory = f"{least:.1f} to {most:.1f} GB of memory"
    return f"{count} photographs, {pixels / 1e6:.0f} megapixels in all: about {time}, {memory}"


def _interpolate(count: int, views: np.ndarray, measured: np.ndarray) -> float:
    """Between the measured counts; beyond the last one it goes on as between the last two."""
    if count <= views[-1]:
        return float(np.interp(count, views, measured))
    slope = (measured[-1] - measured[-2]) / (views[-1] - views[-2])
    return float(measured[-1] + slope * (count - views[-1]))
