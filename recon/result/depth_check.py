"""What the images say of depth images that came with them: that they fit, or what is wrong with them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


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
    scale_error: float | None = None  # by which depths are too large, as a share, where it is why

    def record(self) -> dict[str, object]:
        """As the report states it."""
        return {
            "code": self.code.value,
            "message": self.message,
            "camera": self.camera_id,
            "points": self.num_points,
            "shift_px": None if self.shift_px is None else list(self.shift_px),
            "scale_error": self.scale_error,
        }
