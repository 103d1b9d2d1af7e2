"""Keyframes of a recording: chosen as a live camera's are, and thinned evenly where they are more than can be used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.quality import Limits
from splatnode.capture.selection import Config, Selector

THINNED = "thinned out"  # why a keyframe was given up again


@dataclass(frozen=True, eq=False)
class Choice:
    """The keyframes of a recording, in its order, and what became of its other frames."""

    names: tuple[str, ...]  # of the keyframes
    keyframes: tuple[Frame, ...]  # none where all that there are were asked for
    dropped: tuple[DroppedFrame, ...]  # what the recording could not give
    examined: int  # frames
    taken: Mapping[str, int]  # of the keyframes, by what they add: "coverage", "parallax", ...
    left_out: Mapping[str, int]  # of the other frames, by the reason
    what: str = "frame"  # one of those that were examined: "photograph"

    def record(self) -> dict[str, object]:
        """For report.json."""
        counts = {"taken": dict(self.taken), "left_out": dict(self.left_out)}
        return {"frames": self.examined, "keyframes": len(self.names), **counts}

    def __str__(self) -> str:
        """For people: how many, and why."""
        taken = ", ".join(f"{count} {reason}" for reason, count in self.taken.items())
        others = ", ".join(f"{count} {reason}" for reason, count in self.left_out.items())
        told = f"{len(self.names)} of {self.examined} {self.what}s are keyframes ({taken})"
        return f"{told}; the others: {others}" if others else told


def choose(
    recording: Iterable[Frame | DroppedFrame], config: Config, limits: Limits, most: int | None, what: str = "frame"
) -> Choice:
    """At most `most` keyframes, evenly along the way; only they are held in memory. None: the names of all.

    When there are more, every second one is given up, and from then on every second one is taken: so the camera's way
    stays covered whatever its length.
    """
    selector = Selector(config, limits)
    kept: list[tuple[str, Frame | None, str]] = []
    dropped: list[DroppedFrame] = []
    left_out: Counter[str] = Counter()
    examined = found = 0
    step = 1  # one in so many of the frames that the selector takes is kept
    for frame in recording:
        if isinstance(frame, DroppedFrame):
            dropped.append(frame)
            continue
        examined += 1
        decision = selector.decide(frame)
        reason = decision.reason.split(":")[0]
        if not decision.take:
            left_out[reason] += 1
            continue
        if found % step == 0:
            kept.append((frame.name, None if most is None else frame, reason))
        else:
            left_out[THINNED] += 1
        found += 1
        if most is not None and len(kept) > most:
            left_out[THINNED] += len(kept) // 2
            kept, step = kept[::2], 2 * step
    taken = Counter(reason for *_, reason in kept)
    names = tuple(name for name, *_ in kept)
    frames = tuple(frame for _, frame, _ in kept if frame is not None)
    return Choice(names, frames, tuple(dropped), examined, taken, left_out, what)
