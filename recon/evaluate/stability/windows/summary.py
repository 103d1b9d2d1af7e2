"""The rows counted: how often an answer is right, by angle and by count; and what the 95 % bounds are worth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from splatnode.recon.evaluate.stability.windows.row import WindowOutcome, WindowRow

ANGLE_BINS = (
    ("below 8", 0.0, 8.0),
    ("8 to 15", 8.0, 15.0),
    ("15 to 25", 15.0, 25.0),
    ("25 to 40", 25.0, 40.0),
    ("above 40", 40.0, 360.0),
)  # degrees
KINDS = ("rotation", "centre", "focal")  # of errors that have a bound
PERCENTILES = (50, 90, 95, 99)


@dataclass(frozen=True)
class Tally:
    """Windows of one method, by what became of them; and whether the cameras were right that it had, published or not.

    A method that registers and then refuses (splatnode) has cameras for which `own_right` and
    `own_right_published` differ.
    """

    sets: int
    right: int  # published, right, all photographs placed
    right_part: int  # the same with photographs left out
    between: int  # published, neither right nor beyond the claim
    wrong: int  # published, beyond the claim
    refused: int
    failed: int
    own_right: int  # all cameras right, all photographs placed
    own_right_published: int
    own_right_part: int  # all cameras right, photographs left out
    own_right_part_published: int


@dataclass(frozen=True)
class Coverage:
    """How many published cameras, and of each kind of error: the share within its bound, and percentiles of the ratio.

    None where nothing was claimed.
    """

    cameras: int
    within: dict[str, float | None]
    ratio: dict[str, dict[str, float] | None]  # error over bound, by percentile


def summarise(rows: Sequence[WindowRow]) -> dict[str, Any]:
    """Returns what windows.json holds besides its rows, by method."""
    return {
        method: {
            "all": asdict(tally_rows(mine)),
            "by_angle": {name: asdict(tally_rows(some)) for name, some in group_by_angle(mine).items()},
            "by_count": {str(count): asdict(tally_rows(some)) for count, some in group_by_count(mine).items()},
            "coverage": {
                "all": asdict(measure_coverage(mine)),
                **{str(count): asdict(measure_coverage(some)) for count, some in group_by_count(mine).items()},
            },
        }
        for method, mine in group_by_method(rows).items()
    }


def group_by_method(rows: Sequence[WindowRow]) -> dict[str, list[WindowRow]]:
    return {name: [row for row in rows if row.method == name] for name in dict.fromkeys(row.method for row in rows)}


def group_by_angle(rows: Sequence[WindowRow]) -> dict[str, list[WindowRow]]:
    return {name: [row for row in rows if least <= row.angle_deg < most] for name, least, most in ANGLE_BINS}


def group_by_count(rows: Sequence[WindowRow]) -> dict[int, list[WindowRow]]:
    return {count: [row for row in rows if row.count == count] for count in sorted({row.count for row in rows})}


def tally_rows(rows: Iterable[WindowRow]) -> Tally:
    every = list(rows)
    found = [row.outcome for row in every]
    own, part = ([row for row in every if row.right and row.whole is whole] for whole in (True, False))
    return Tally(
        sets=len(every),
        **{kind.value: found.count(kind) for kind in WindowOutcome},
        own_right=len(own),
        own_right_published=sum(row.published for row in own),
        own_right_part=len(part),
        own_right_part_published=sum(row.published for row in part),
    )


def measure_coverage(rows: Iterable[WindowRow]) -> Coverage:
    """Measures the coverage of the bounds of the published cameras."""
    cameras = [camera for row in rows if row.published for camera in row.cameras]
    claimed = {kind: [c.pair_with_bounds()[kind] for c in cameras if kind in c.pair_with_bounds()] for kind in KINDS}
    return Coverage(
        cameras=len(cameras),
        within={kind: compute_share_within(pairs) for kind, pairs in claimed.items()},
        ratio={kind: _compute_percentiles(pairs) for kind, pairs in claimed.items()},
    )


def compute_share_within(pairs: Sequence[tuple[float, float]]) -> float | None:
    """The share of errors that are at most their bound."""
    return sum(error <= bound for error, bound in pairs) / len(pairs) if pairs else None


def _compute_percentiles(pairs: Sequence[tuple[float, float]]) -> dict[str, float] | None:
    if not pairs:
        return None
    ratios = [error / max(bound, 1e-9) for error, bound in pairs]
    return {
        str(percent): float(value)
        for percent, value in zip(PERCENTILES, np.percentile(ratios, PERCENTILES), strict=True)
    }
