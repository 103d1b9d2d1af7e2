"""How coarse a picture is painted while the person drags: as fine as keeps up with the hand."""

from __future__ import annotations

import math

SLOWEST_S = (
    0.05  # a picture while dragging may take: twice that, with what else a window does, are 10 pictures a second
)
_COARSEST = 4


def choose_first_divisor(seconds: float) -> int:
    """Returns the divisor of width and height with which a picture of `seconds` in full takes SLOWEST_S at most."""
    return min(max(math.ceil(math.sqrt(seconds / SLOWEST_S) - 0.1), 1), _COARSEST)


def choose_next_divisor(part: int, seconds: float) -> int:
    """The divisor after a picture with this one took `seconds`: coarser where it was late, finer where time is left."""
    if seconds > SLOWEST_S:
        return min(part + 1, _COARSEST)
    finer = max(part - 1, 1)
    return finer if seconds * (part / finer) ** 2 < 0.8 * SLOWEST_S else part
