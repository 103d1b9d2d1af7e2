"""Live, a keyframe of one camera makes keyframes of what the others took with it, as `FrameSetSelector` has it offline.

Frames come one by one, and other cameras have processes of their own: what is wanted may come before or after it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from splatnode.capture.frame import Frame, Stamp

MOST_HELD = 6  # frames of a camera that others may still want: a fifth of a second at 30 a second
_MOST_WANTED, _MOST_TAKEN = 32, 64  # stamps that are remembered


@dataclass(frozen=True)
class _Wanted:
    """A time at which a camera took a keyframe, and the cameras from which no image is missing."""

    stamp: Stamp
    done: set[str] = field(default_factory=set)


class FrameSetSelection:
    """Which frames the keyframes of other cameras want, and the last frames of each camera that became none.

    With a tolerance of 0 none is wanted: each camera selects by itself.
    """

    def __init__(self, tolerance_s: float) -> None:
        self._tolerance_ns = round(1e9 * tolerance_s)
        self._wanted: deque[_Wanted] = deque(maxlen=_MOST_WANTED)
        self._taken: deque[tuple[str, Stamp]] = deque(maxlen=_MOST_TAKEN)
        self._held: dict[str, deque[Frame]] = {}

    def want(self, stamp: Stamp, from_camera: str = "") -> list[Frame]:
        """Another camera took a keyframe then; returns what the others took with it, one frame of each at most."""
        if not self._tolerance_ns:
            return []
        done = {from_camera, *(camera for camera, at in self._taken if self._are_together(at, stamp))}
        self._wanted.append(_Wanted(stamp, done))
        found = []
        for camera, frames in self._held.items():
            near = [(abs(at.ns - stamp.ns), index, each) for index, each in enumerate(frames)
                    if (at := each.captured_at) is not None and self._are_together(at, stamp)]  # fmt: skip
            if near and camera not in done:
                found.append(min(near)[2])
                done.add(camera)
        return found

    def is_wanted(self, frame: Frame) -> bool:
        """Whether another camera took a keyframe with this frame, and this camera has given none to it."""
        at, camera = frame.captured_at, frame.camera_id
        if at is None or not camera:
            return False
        return any(camera not in each.done and self._are_together(each.stamp, at) for each in self._wanted)

    def hold(self, frame: Frame) -> None:
        """Keeps a frame that became no keyframe, for a while."""
        if self._tolerance_ns and frame.camera_id and frame.captured_at is not None:
            self._held.setdefault(frame.camera_id, deque(maxlen=MOST_HELD)).append(frame)

    def mark_taken(self, frame: Frame) -> None:
        """The frame became a keyframe, and its camera gives no other to a time that is near."""
        if frame.captured_at is not None:
            self._taken.append((frame.camera_id, frame.captured_at))
            for each in self._wanted:
                if self._are_together(each.stamp, frame.captured_at):
                    each.done.add(frame.camera_id)

    def _are_together(self, one: Stamp, other: Stamp) -> bool:
        return one.clock is other.clock and abs(one.ns - other.ns) <= self._tolerance_ns
