"""A recording at the pace at which it was taken."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import Annotated, Literal

import msgspec

from splatnode.capture.frame import DroppedFrame, Frame

FramesPerSecond = Annotated[float, msgspec.Meta(ge=0.001, le=1000)]
Pace = Literal["recorded", "fastest"]  # by the stamps, or as fast as the consumer reads


def pace_frames(items: Iterable[Frame | DroppedFrame], pace: Pace) -> Iterator[Frame | DroppedFrame]:
    """The items, each frame not before its time after the first one's; the stamps stay as they are."""
    start_s, first_ns = 0.0, None
    for item in items:
        if pace == "recorded" and isinstance(item, Frame):
            if first_ns is None:
                start_s, first_ns = time.monotonic(), item.stamp_ns
            time.sleep(max(0.0, start_s + (item.stamp_ns - first_ns) / 1e9 - time.monotonic()))
        yield item
