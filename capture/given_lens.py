"""A lens that is given for all photographs: which of them it can be of, and what is said where it is of none."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

from splatnode.capture.frame import Frame, Intrinsics


def same_aspect(intrinsics: Intrinsics, width: int, height: int) -> bool:
    """Whether an image of this size can be one of the camera's, resized."""
    return abs(intrinsics.width * height - intrinsics.height * width) <= max(width, height)


def seen_through(each: Any, known: Intrinsics) -> Any:
    """The frame with this lens, if it can be one of its images."""
    if not isinstance(each, Frame) or not same_aspect(known, each.width, each.height):
        return each
    return replace(each, intrinsics=known.resized(each.width, each.height))


def check_fits(known: Intrinsics, sizes: Collection[tuple[int, int]]) -> None:
    """Raises ValueError where there are photographs, of these sizes, and the lens can be of none of them."""
    if sizes and not any(same_aspect(known, *size) for size in sizes):
        shown = ", ".join(f"{width} x {height}" for width, height in sorted(set(sizes)))
        raise ValueError(
            f"intrinsics must be of images of the photographs' aspect ratio, got those of {known.width} x "
            f"{known.height} for {shown}. Give the size of the images that were calibrated, or photographs of its "
            "aspect ratio"
        )
