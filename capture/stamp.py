"""When an image was captured: a time, and the clock that it was read from."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import Enum
from typing import Annotated

import msgspec

LARGEST_NS = 2**62  # 146 years
_NS = 10**9
_READINGS = 5  # of both clocks, of which the one that was disturbed least counts


class Clock(Enum):
    """The clock that a time is read from. Times of two clocks cannot be compared."""

    UTC = "utc"
    LOCAL = "local"
    FILE = "file"
    RECORDING = "recording"

    @property
    def meaning(self) -> str:
        return _MEANINGS[self]


_MEANINGS = {
    Clock.UTC: "since 1970, UTC",
    Clock.LOCAL: "since 1970 by the camera's date and time, whose time zone is not known",
    Clock.FILE: "since 1970, UTC, when the file was last written",
    Clock.RECORDING: "since the recording, or its simulation, began",
}


@dataclass(frozen=True)
class Stamp:
    """A time of capture. Raises ValueError where it is before its clock's zero, or beyond LARGEST_NS."""

    ns: Annotated[int, msgspec.Meta(ge=0, le=LARGEST_NS)]  # nanoseconds
    clock: Clock  # what they are counted from: UTC, LOCAL, FILE or RECORDING

    def __post_init__(self) -> None:
        if not 0 <= self.ns <= LARGEST_NS:
            raise ValueError(f"a time stamp must be 0 to 2**62 ns, got {self.ns}")

    @property
    def seconds(self) -> str:
        """In decimal digits, none of which is lost."""
        return f"{self.ns // _NS}.{self.ns % _NS:09d}"


def nearest_stamp(ns: int, clock: Clock) -> Stamp:
    """The stamp of `ns`, which may be anything: a clock may be set to any year, and a file's time, too."""
    return Stamp(min(max(0, ns), LARGEST_NS), clock)


def wall_clock(mono_ns: int) -> Stamp:
    """Converts a time of this machine's monotonic clock to the wall clock, if nobody has set it since."""
    return nearest_stamp(mono_ns + min(_reading() for _ in range(_READINGS))[1], Clock.UTC)


def _reading() -> tuple[int, int]:
    """How long it took to read both clocks, and how far the wall clock is ahead of the monotonic one, nanoseconds."""
    before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
    return after - before, wall - (before + after) // 2
