"""Masks: which pixels of a photograph are used. White (any value above 0) is used, black is ignored.

What is ignored never gets past this file: a smooth fill of its surroundings takes its place before anything looks at
the photograph, and the frame carries the mask, so that the fill counts for nothing either.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture import image_header
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.image_file import (
    ORIENTATION,
    SUFFIXES,
    UnusableImage,
    decode_any_image,
    read_image_file,
    upright,
)
from splatnode.capture.image_header import read_header
from splatnode.capture.process.system import outlast
from splatnode.capture.process.text import guard_untrusted, sanitize_name

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]  # (H, W), True where the photograph is used

CONVENTION = "white (any value above 0) is used, black is ignored"
LEAST_USED = 0.05  # of a photograph: with less there is nothing to match
LOSSY_LEVEL = 128  # of 255: below, a JPEG's or WebP's pixel is black, which its noise hides
_LOSSY = {".jpg", ".jpeg", ".webp"}
_FILL_SIDE = 64  # pixels of the longer side at which the fill is found: it shows no detail

Find = Callable[[Frame], Mask | None]  # the mask of a frame; None: it has none
_Other = TypeVar("_Other")  # what a camera gives beside frames


class UnusableMask(ValueError):
    """A mask that cannot be one of its photograph; the text says what was expected."""


def apply_mask(frame: Frame, mask: Mask) -> Frame | DroppedFrame:
    """The frame without what `mask` (H, W) hides, beside what a mask of its own hides already.

    Left out where hardly anything remains. Raises UnusableMask for a mask of another size.
    """
    height, width = mask.shape
    if (width, height) != (frame.width, frame.height):
        raise UnusableMask(
            f"the mask of {frame.name} has {width} x {height} pixels (aspect {width / height:.3f}), its photograph "
            f"{frame.width} x {frame.height} (aspect {frame.width / frame.height:.3f}); make the mask of that size"
        )
    used = mask if frame.mask is None else mask & frame.mask
    if used.mean() < LEAST_USED:
        shown = f"{100 * used.mean():.1f} %"
        return DroppedFrame(frame.name, f"its mask leaves {shown} of it: in a mask {CONVENTION}; is it inverted?")
    if used.all():
        return frame
    return replace(frame, image=fill_masked(frame.image, used), mask=used, encoded=None)


def mask_frames(
    frames: Iterable[Frame | _Other], find: Find, tell: Callable[[str], None] = lambda line: None
) -> Iterator[Frame | DroppedFrame | _Other]:
    """The frames, each with its mask, and all else as it is; `tell` hears which have none. Raises UnusableMask."""
    whole = []
    for frame in frames:
        mask = find(frame) if isinstance(frame, Frame) else None
        if isinstance(frame, Frame) and mask is None:
            whole.append(frame.name)
        yield apply_mask(frame, mask) if isinstance(frame, Frame) and mask is not None else frame
    if whole:
        more = f" and {len(whole) - 5} more" if len(whole) > 5 else ""
        tell(f"used whole, because there is no mask of it: {', '.join(whole[:5])}{more}")


def open_masks(path: Path) -> Find:
    """Finds masks in a folder, by the name of the photograph or its stem; a file is the mask of all photographs.

    Of several cameras the masks may lie in a folder of each (left/0001.png), and one that is called as a camera
    (left.png) is the mask of all of its photographs that have no own. Raises FileNotFoundError and UnusableMask where
    there is none, or two of one name.
    """
    if path.is_file():
        return open_single_mask(path)
    if not path.is_dir():
        raise FileNotFoundError(f"{str(path)!r} is not there; give a folder of masks: {CONVENTION}")
    by_stem: dict[str, Path] = {}
    inside = (child for child in sorted(path.iterdir()) if child.is_dir() and not child.name.startswith("."))
    for file in (*sorted(path.iterdir()), *(file for child in inside for file in sorted(child.iterdir()))):
        if file.name.startswith(".") or file.suffix.lower() not in SUFFIXES or not file.is_file():
            continue
        of_camera = "" if file.parent == path else f"{sanitize_name(file.parent.name)}/"
        stem = of_camera + sanitize_name(file.stem)
        if stem in by_stem:
            both = f"{by_stem[stem].name} and {sanitize_name(file.name)}"
            raise UnusableMask(f"{str(path)!r} has two masks of one photograph, {both}; remove one")
        by_stem[stem] = file
    if not by_stem:
        raise UnusableMask(f"{str(path)!r} holds no masks; each must be an image named as its photograph: {CONVENTION}")

    def find(frame: Frame) -> Mask | None:
        file = by_stem.get(frame.name) or by_stem.get(frame.name.rpartition(".")[0] or frame.name)
        file = file or (by_stem.get(frame.camera_id) if frame.camera_id else None)
        return None if file is None else read_mask(file, frame)

    return find


def open_single_mask(path: Path) -> Find:
    """The mask in this file for every frame, read once for each of its sizes. Raises UnusableMask."""
    known: dict[tuple[int, int], Mask] = {}

    def find(frame: Frame) -> Mask:
        size = frame.height, frame.width
        if size not in known:
            known[size] = read_mask(path, frame)
        return known[size]

    return find


_MOST_TIMES = 4  # as many pixels as its photograph: a mask of another size is decoded, and refused by its size
_LEAST_BOUND = 1 << 20  # pixels that may be decoded of any photograph's mask


def read_mask(path: Path, frame: Frame) -> Mask:
    """The mask (H, W) in an image file, turned as its photograph is. Raises UnusableMask.

    A mask that has the size of the photograph as it is stored, not turned yet, is turned as the photograph's EXIF says.
    """
    most = max(_MOST_TIMES * frame.width * frame.height, _LEAST_BOUND)
    try:
        image = outlast(lambda: decode_any_image(read_image_file(path, most), most).image, sanitize_name(path.name))
    except (UnusableImage, OSError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise UnusableMask(f"the mask {sanitize_name(path.name)} cannot be read: {why}") from error
    level = LOSSY_LEVEL if path.suffix.lower() in _LOSSY else 1
    mask = image.max(2) >= level
    if mask.shape != (frame.height, frame.width) and mask.shape == (frame.width, frame.height):
        return upright(mask, _orientation(frame))
    return mask


def parse_mask(given: object) -> Mask:
    """A mask (H, W) as a program has it: an array of bool or of any numbers, above 0 where the photograph is used.

    Raises TypeError.
    """
    array = np.asarray(given)
    if array.ndim == 3 and array.shape[2] in (1, 3):
        array = array.max(2)
    if array.ndim != 2 or array.dtype.kind not in "buif":
        raise TypeError(f"a mask must be an array (H, W) of bool or numbers, got {array.shape} {array.dtype}")
    return array > 0


def fill_masked(image: Image, mask: Mask) -> Image:
    """The image (H, W, 3) with a smooth fill of what is used around it where `mask` (H, W) is False.

    It is found from coarse to fine on a small copy: each gap takes the mean of the nearest level that has any.
    """
    height, width = mask.shape
    scale = min(1.0, _FILL_SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    weights = mask.astype(np.float32)
    levels = [(cv2.resize(image * weights[..., None], size, interpolation=cv2.INTER_AREA),
               cv2.resize(weights, size, interpolation=cv2.INTER_AREA))]  # fmt: skip
    while max(levels[-1][1].shape) > 1:
        colour, weight = levels[-1]
        half = (weight.shape[1] + 1) // 2, (weight.shape[0] + 1) // 2
        smaller = [cv2.resize(each, half, interpolation=cv2.INTER_AREA) for each in (colour, weight)]
        levels.append((smaller[0], smaller[1]))
    fill = np.zeros((1, 1, 3), np.float32)
    for colour, weight in reversed(levels):
        coarser = cv2.resize(fill, weight.shape[::-1], interpolation=cv2.INTER_LINEAR)
        known = np.minimum(1.0, weight * 4)[..., None]
        fill = known * colour.reshape(coarser.shape) / np.maximum(weight, 1e-6)[..., None] + (1 - known) * coarser
    smooth = cv2.resize(fill.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(mask[..., None], image, np.clip(np.rint(smooth), 0, 255).astype(np.uint8))


def _orientation(frame: Frame) -> int:
    """Returns the orientation that the EXIF of the frame's file tells; 1 where it tells none."""
    if frame.encoded is None:
        return 1
    with guard_untrusted(UnusableMask, frame.name):
        tags = image_header.read_tags(read_header(frame.encoded).exif)
    return int(image_header.first(tags, ORIENTATION) or 1)
