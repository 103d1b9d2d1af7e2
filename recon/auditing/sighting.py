"""A camera of a station in one recording: where it stood, or why that is not known."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon.auditing.motion import motion
from splatnode.recon.locating.locate import Placed, described, placed
from splatnode.recon.locating.photographs import assumed_lens
from splatnode.recon.result.landmarks import Landmarks

MOVING = "MOVING"  # the code of a camera that did not stand still
UNREADABLE = "UNREADABLE"


@dataclass(frozen=True, eq=False)
class Sighting:
    """A camera that stood still."""

    photograph: str
    placed: Placed


@dataclass(frozen=True)
class NotSeen:
    """Why it is not known where a camera stood."""

    photograph: str
    code: str  # a Reason of recon/locating/outcome.py, MOVING or UNREADABLE
    message: str


def sight(
    landmarks: Landmarks, frames: Iterable[Frame | DroppedFrame], fov_deg: float | None = None
) -> Sighting | NotSeen:
    """Where the camera that took these photographs of one recording stood; there is at least one.

    `fov_deg` is its angle of view across the longer side, in degrees. Of several photographs all that can be placed
    must be of one place.
    """
    first, problem = None, None
    for frame in frames:
        if isinstance(frame, DroppedFrame):
            problem = problem or NotSeen(frame.name, UNREADABLE, frame.reason)
            continue
        try:
            photograph = described(frame.image, assumed_lens(frame, fov_deg), name=frame.name)
        except ValueError as error:  # of its lens, which nothing can undo
            problem = problem or NotSeen(frame.name, UNREADABLE, str(error))
            continue
        found = placed(landmarks, photograph)
        if not isinstance(found, Placed):
            problem = problem or NotSeen(frame.name, found.code.value, found.message)
        elif first is None:
            first = Sighting(frame.name, found)
        elif (since := motion(first.placed, found)).significant:
            told = f"since {first.photograph} it moved by {since.in_words(landmarks.unit, landmarks.metric)}"
            return NotSeen(
                frame.name, MOVING, f"{told}: only a camera that stands still in a recording can be compared"
            )
    if first is not None:
        return first
    assert problem is not None  # there is at least one photograph
    return problem
