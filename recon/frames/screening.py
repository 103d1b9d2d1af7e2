"""Frames that say nothing new are left out before anything is computed from them: copies, blank and blurred ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture import quality
from splatnode.capture.frame import Frame
from splatnode.recon.result.verdict import Code


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    limits: quality.Limits = quality.Limits()


@dataclass(frozen=True, eq=False)
class Look:
    """What the screening keeps in mind of a frame."""

    name: str
    quality: quality.Quality
    thumbnail: npt.NDArray[np.uint8]  # (h, w, 3) RGB
    size: tuple[int, int]  # width and height of the frame


@dataclass(frozen=True)
class Rejected:
    """A frame that is left out, and the verdict if nothing but such frames is left."""

    name: str
    code: Code
    reason: str


def look(frame: Frame) -> Look:
    scale = min(1.0, quality.THUMBNAIL_SIDE / max(frame.width, frame.height))
    size = max(1, round(frame.width * scale)), max(1, round(frame.height * scale))
    thumbnail = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    return Look(frame.name, quality.assess(frame.image), thumbnail, (frame.width, frame.height))


def screen(looks: Sequence[Look], config: Config) -> tuple[list[int], list[Rejected]]:
    """Which of the frames are worth working on, by position, and why the others are not.

    Of copies the first is kept. Blur is compared with the sharpest frame of all, so that the order does not matter.
    """
    sharpest = min((look.quality.blur_px for look in looks if look.quality.blur_px is not None), default=None)
    kept: list[int] = []
    rejected: list[Rejected] = []
    for index, look in enumerate(looks):
        why = quality.why_unusable(look.quality, config.limits, sharpest)
        if why is not None:
            rejected.append(Rejected(look.name, _code(look.quality, config.limits), why))
            continue
        copied = next((looks[other] for other in kept if _same(look, looks[other], config.limits)), None)
        if copied is None:
            kept.append(index)
        else:
            rejected.append(Rejected(look.name, Code.STATIC_CAMERA, f"duplicate of {copied.name}"))
    return kept, rejected


def _code(measured: quality.Quality, limits: quality.Limits) -> Code:
    blank = measured.blur_px is None or measured.contrast < limits.contrast
    exposed = 1.0 - measured.dark - measured.bright >= limits.exposed
    return Code.LOW_TEXTURE if blank or not exposed else Code.BLUR


def _same(one: Look, other: Look, limits: quality.Limits) -> bool:
    if one.size != other.size:
        return False
    return quality.why_redundant(quality.novelty(one.thumbnail, other.thumbnail), limits) is not None
