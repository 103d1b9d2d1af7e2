"""Lenses that are given: of which images each of them can be, and what is said where it is of none."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import PurePosixPath
from typing import Any

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.process.printable import LONGEST_NAME, sanitize_text

ALL = "*"  # the key of a lens that is of all images
_AFTER_CAMERA = "/_-. "  # what may follow the name of a camera in the name of an image


@dataclass(frozen=True)
class Lenses:
    """Lenses by the images that they took.

    A key is the name of an image, with or without its suffix; the name of a camera, as `Frame.camera` has it or with
    which the names of its images begin (`left` for left/0001.png and left_0001.png); or a pattern, such as `left*.png`.
    The first kind of key that an image matches counts, in this order.
    """

    by_key: Mapping[str, Intrinsics]

    def find_key(self, name: str, camera: str = "") -> str | None:
        """Returns the key of the lens of an image; None where no lens is of it."""
        return find_key(self.by_key, name, camera)

    def apply(self, each: Any) -> Any:
        """Returns the frame with its lens; as it is where no lens is of it, or one of another aspect ratio.

        Where lenses differ, the key becomes the frame's camera: images of different cameras share no lens.
        """
        if not isinstance(each, Frame) or (key := self.find_key(each.name, each.camera)) is None:
            return each
        lens = self.by_key[key]
        seen = assign_lens(each, lens)
        if seen is each or len(set(self.by_key.values())) == 1:
            return seen
        first = next(other for other, known in self.by_key.items() if known == lens)
        return replace(seen, camera=sanitize_text(first, LONGEST_NAME))

    def check(self, images: Iterable[tuple[str, str, int, int]]) -> None:
        """Raises ValueError where a lens is of no image, or of none of its aspect ratio.

        `images` are names, cameras, widths and heights of all that there are.
        """
        sizes: dict[str, set[tuple[int, int]]] = {key: set() for key in self.by_key}
        names = []
        for name, camera, width, height in images:
            names.append(name)
            if (key := self.find_key(name, camera)) is not None:
                sizes[key].add((width, height))
        for key, found in sizes.items():
            if found:
                check_fits(self.by_key[key], found)
            elif names:
                raise ValueError(
                    f"intrinsics has a lens of {sanitize_text(key, 100)!r}, which is no photograph's: they are called "
                    f"{sanitize_text(min(names), 100)} to {sanitize_text(max(names), 100)}. Name a photograph, a camera with "
                    "which names begin, or a pattern such as left*.png"
                )


def find_key(keys: Collection[str], name: str, camera: str = "") -> str | None:
    """Returns which of the keys an image with this name, of this camera, matches; None: none. See `Lenses`."""
    for exact in (name, name.rpartition(".")[0], PurePosixPath(name).name, camera):
        if exact and exact in keys:
            return exact
    begins = (key for key in keys if key and name.startswith(key) and name[len(key) : len(key) + 1] in _AFTER_CAMERA)
    patterns = (key for key in keys if fnmatchcase(name, key))
    return next(begins, None) or next(patterns, None)


def describe_image(frame: Frame) -> tuple[str, str, int, int]:
    """Returns what `Lenses.check` asks of an image: name, camera, width and height."""
    return frame.name, frame.camera, frame.width, frame.height


def same_aspect(intrinsics: Intrinsics, width: int, height: int) -> bool:
    """Whether an image of this size can be one of the camera's, resized."""
    return abs(intrinsics.width * height - intrinsics.height * width) <= max(width, height)


def assign_lens(each: Any, known: Intrinsics) -> Any:
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
