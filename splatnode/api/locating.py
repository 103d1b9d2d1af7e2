"""Where a further photograph of a scene was taken."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from splatnode.api.photographs import Lens, Picture, photographs, with_lens
from splatnode.capture.frame import Frame
from splatnode.capture.process.progress import told_to_nobody
from splatnode.recon.locating.locate import locate
from splatnode.recon.locating.outcome import Located, NotLocated
from splatnode.recon.result.landmarks import Landmarks


def localised(landmarks: Landmarks, image: str | PathLike[str] | Picture, lens: Lens | None) -> Located | NotLocated:
    """The camera of one photograph, a file or a picture. Raises TypeError, ValueError, FileNotFoundError."""
    if isinstance(image, (str, PathLike)) and not Path(image).is_file():
        raise FileNotFoundError(f"no photograph {str(image)!r}; give a file, or a picture")
    given = with_lens(photographs([image], None, False, told_to_nobody), lens).frames
    (frame, *_) = given
    if not isinstance(frame, Frame):
        raise ValueError(f"image {frame.name} cannot be read: {frame.reason}")
    return locate(landmarks, frame.image, frame.intrinsics)
