"""What tells that depth images have another unit than they say, before a scene is made by it."""

from __future__ import annotations

from collections.abc import Iterable

from splatnode.capture.depth_image import describe_doubtful_unit
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.process.text import sanitize_name


def describe_doubtful_units(frames: Iterable[Frame | DroppedFrame]) -> str:
    """Describes what speaks against the units of depth images, by the first that it is about; empty: nothing does."""
    depths = {each.name: each.depth for each in frames if isinstance(each, Frame) and each.depth is not None}
    doubts = {name: doubt for name, depth in depths.items() if (doubt := describe_doubtful_unit(depth))}
    if not doubts:
        return ""
    name, doubt = next(iter(doubts.items()))
    return f"the depth image of {sanitize_name(name)}: {doubt} ({len(doubts)} of {len(depths)} depth images)"
