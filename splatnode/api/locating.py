"""Where a further photograph of a scene was taken."""

from __future__ import annotations

from os import PathLike

from splatnode.api.photographs import Lens, Picture, photographs, with_lens
from splatnode.capture.frame import Frame
from splatnode.capture.process.progress import told_to_nobody
from splatnode.recon.locating.locate import locate
from splatnode.recon.locating.outcome import Located, NotLocated
from splatnode.recon.result.landmarks import Landmarks


def localised(landmarks: Landmarks, image: str | PathLike[str] | Picture, lens: Lens | None) -> Located | NotLocated:
    """The camera of one photograph, a file or a picture. Raises TypeError, ValueError, FileNotFoundError."""
    given = with_lens(photographs(image, None, False, told_to_nobody), lens).frames
    if len(given) != 1:
        raise ValueError(f"image must be one photograph, got {len(given)}. Ask for each alone")
    (frame,) = given
    if not isinstance(frame, Frame):
        raise ValueError(f"image {frame.name} cannot be read: {frame.reason}")
    return locate(landmarks, frame.image, frame.intrinsics)
