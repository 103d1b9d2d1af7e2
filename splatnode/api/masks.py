"""Masks as a program has them: a folder, a file, or one for each photograph of a list."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TypeAlias

import numpy.typing as npt

from splatnode.api.photographs import Images, list_images, picture_name
from splatnode.capture.cameras.folder import frame_name
from splatnode.capture.frame import Frame
from splatnode.capture.masks import Find, Mask, open_masks, parse_mask, read_mask

# In a list one for each photograph, in the order of the photographs; None: that one is used whole.
MaskOf: TypeAlias = "str | PathLike[str] | npt.NDArray[Any] | None"
Masks: TypeAlias = "str | PathLike[str] | npt.NDArray[Any] | Sequence[MaskOf]"


def make_mask_finder(masks: Masks, images: Images) -> Find:
    """Finds the mask of a frame of `images`. Raises TypeError, ValueError, FileNotFoundError."""
    if isinstance(masks, (str, PathLike)):
        return open_masks(Path(masks))
    given, of = list_images(images), list(masks)
    if len(given) == 1 and isinstance(given[0], (str, PathLike)) and Path(given[0]).is_dir():
        raise TypeError("masks must be a folder of masks where images is a folder, got a list")
    if len(of) != len(given):
        raise ValueError(
            f"masks must be one for each of the {len(given)} photographs (None: all is used), got {len(of)}"
        )
    names = [frame_name(Path(fspath(each))) if isinstance(each, (str, PathLike)) else None for each in given]
    by_name = {name or picture_name(index): mask for index, (name, mask) in enumerate(zip(names, of, strict=True))}
    return lambda frame: _mask(by_name.get(frame.name), frame)


def _mask(given: MaskOf, frame: Frame) -> Mask | None:
    if given is None:
        return None
    return read_mask(Path(given), frame) if isinstance(given, (str, PathLike)) else parse_mask(given)
