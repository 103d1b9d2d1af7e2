"""What the images say of depth images that came with them: that they fit, or what is wrong with them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated

import msgspec

from splatnode.capture.messaging.messages import LARGEST, Finite
from splatnode.capture.process.text import LONGEST_NAME, LONGEST_TEXT, sanitize_text

_LONGEST_SENTENCE = 10_000  # characters, of a report; in a message LONGEST_TEXT


class DepthCode(Enum):
    """FITS alone lets depth images count for depth; their unit counts where no other source contradicts it."""

    FITS = "FITS"
    UNTESTED = "DEPTH_UNTESTED"  # too few points of the images have a depth
    SHIFTED = "DEPTH_SHIFTED"  # not aligned with the images
    CONTRADICTS = "DEPTH_CONTRADICTS"  # other depths than the images tell
    SCALE = "DEPTH_SCALE"  # another unit than all other sources of metres give


@dataclass(frozen=True)
class DepthCheck:
    """The judgement on the depth images of one camera."""

    code: DepthCode  # FITS, or what is wrong
    message: str  # one sentence
    camera_id: str = ""  # empty: there is one camera
    num_points: int = 0  # of the images, that were compared
    shift_px: tuple[float, float] | None = None  # across and down, where it is why; pixels of 640 across
    shift_is_least: bool = False  # whether the search ended at `shift_px`: it is so much or more, or no shift at all
    scale_error: float | None = None  # by which depths are too large, as a share, where it is why

    def record(self) -> dict[str, object]:
        """As the report states it."""
        return {
            "code": self.code.value,
            "message": self.message,
            "camera": self.camera_id,
            "points": self.num_points,
            "shift_px": None if self.shift_px is None else list(self.shift_px),
            "shift_is_least": self.shift_is_least,
            "scale_error": self.scale_error,
        }


class StoredDepthCheck(msgspec.Struct, frozen=True):
    """A DepthCheck as the report and messages have it."""

    code: DepthCode
    message: Annotated[str, msgspec.Meta(max_length=_LONGEST_SENTENCE)]
    camera: Annotated[str, msgspec.Meta(max_length=LONGEST_NAME)] = ""
    points: Annotated[int, msgspec.Meta(ge=0, le=LARGEST)] = 0
    shift_px: tuple[Finite, Finite] | None = None
    shift_is_least: bool = False
    scale_error: Finite | None = None

    def restore(self) -> DepthCheck:
        """The judgement that it was made of."""
        return DepthCheck(
            self.code,
            self.message,
            self.camera,
            self.points,
            self.shift_px,
            shift_is_least=self.shift_is_least,
            scale_error=self.scale_error,
        )


class DepthCheckRecord(StoredDepthCheck, frozen=True, forbid_unknown_fields=True):
    """A DepthCheck in a message."""


def make_depth_check_record(check: DepthCheck) -> DepthCheckRecord:
    """The check as a message has it."""
    return DepthCheckRecord(
        check.code,
        sanitize_text(check.message, LONGEST_TEXT),
        sanitize_text(check.camera_id, LONGEST_NAME),
        check.num_points,
        check.shift_px,
        check.shift_is_least,
        check.scale_error,
    )
