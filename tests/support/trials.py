"""Trials of the stability matrix without what a run costs, which is never twice the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

COSTS = ("seconds", "fresh_seconds", "processor_seconds", "peak_rss_mb", "cores", "processor", "others")


def without_costs(trials: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [{name: value for name, value in trial.items() if name not in COSTS} for trial in trials]
