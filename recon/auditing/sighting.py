"""A camera of a station in one recording: where it stood, or why that is not known."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon.auditing.motion import measure_motion
from splatnode.recon.locating.locate import Localization, localize_with_inliers, prepare_query_image
from splatnode.recon.locating.photographs import choose_intrinsics
from splatnode.recon.result.landmarks import Landmarks

MOVING = "MOVING"  # the code of a camera that did not stand still
UNREADABLE = "UNREADABLE"


@dataclass(frozen=True, eq=False)
class CameraSighting:
    """A camera that stood still."""

    photograph: str
    placed: Localization


@dataclass(frozen=True)
class SightingFailure:
    """Why it is not known where a camera stood."""

    photograph: str
    code: str  # a Reason of recon/locating/outcome.py, MOVING or UNREADABLE
    message: str


def localize_camera(
    landmarks: Landmarks, frames: Iterable[Frame | DroppedFrame], fov_deg: float | None = None
) -> CameraSighting | SightingFailure:
    """Localizes the camera that took these images of one recording; there is at least one.

    `fov_deg` is its angle of view across the longer side, in degrees. Of several photographs all that can be placed
    must be of one place.
    """
    first, problem = None, None
    for frame in frames:
        if isinstance(frame, DroppedFrame):
            problem = problem or SightingFailure(frame.name, UNREADABLE, frame.reason)
            continue
        try:
            photograph = prepare_query_image(frame.image, choose_intrinsics(frame, fov_deg), name=frame.name)
        except ValueError as error:  # of its lens, which nothing can undo
            problem = problem or SightingFailure(frame.name, UNREADABLE, str(error))
            continue
        found = localize_with_inliers(landmarks, photograph)
        if not isinstance(found, Localization):
            problem = problem or SightingFailure(frame.name, found.code.value, found.message)
        elif first is None:
            first = CameraSighting(frame.name, found)
        elif (since := measure_motion(first.placed, found)).is_significant:
            told = f"since {first.photograph} it moved by {since.format_motion(landmarks.unit, landmarks.metric)}"
            return SightingFailure(
                frame.name, MOVING, f"{told}: only a camera that stands still in a recording can be compared"
            )
    if first is not None:
        return first
    assert problem is not None  # there is at least one photograph
    return problem
