"""Where the seconds of a reconstruction go."""

from __future__ import annotations

import time
from dataclasses import dataclass, field


@dataclass
class Clock:
    """Seconds by stage; "wait" is for the next frame, and for whoever reads the snapshots."""

    started: float = field(default_factory=time.monotonic)
    last: float = field(default_factory=time.monotonic)
    seconds: dict[str, float] = field(default_factory=dict)

    def lap(self, stage: str) -> None:
        """Books the time since the last lap on `stage`."""
        now = time.monotonic()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.last
        self.last = now

    def deadline(self, budget_s: float | None) -> float | None:
        """When, by `time.monotonic()`, so many seconds since the start are over; None: never."""
        return None if budget_s is None else self.started + budget_s

    def resume(self) -> None:
        """Goes on as if no time had passed since the last lap: the work lay by."""
        self.leave_out(time.monotonic() - self.last)

    def leave_out(self, seconds: float) -> None:
        """Goes on as if these seconds since the last lap had not passed: other work was done."""
        self.started, self.last = self.started + seconds, self.last + seconds

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Seconds by stage, and from the start on as "total"."""
        return {**self.seconds, "total": time.monotonic() - self.started}
