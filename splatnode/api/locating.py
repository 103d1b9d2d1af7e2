"""Where a further photograph of a scene was taken."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from splatnode.api.photographs import Lens, Picture, apply_lens, load_frames
from splatnode.capture.frame import Frame
from splatnode.capture.odometry import rigid_problem
from splatnode.capture.process.terminal import ignore_progress
from splatnode.recon.locating.localize import follow, localize_image
from splatnode.recon.locating.outcome import Located, NotLocated
from splatnode.recon.result.snapshot import Landmarks

Near: TypeAlias = "Located | NotLocated | npt.ArrayLike | None"


def localize_query(
    landmarks: Landmarks, image: str | PathLike[str] | Picture, lens: Lens | None, near: Near
) -> Located | NotLocated:
    """The camera of one photograph, a file or a picture. Raises TypeError, ValueError, FileNotFoundError."""
    expected = _parse_near(near)
    frame = load_query_frame(image, lens)
    if expected is None:
        return localize_image(landmarks, frame.image, frame.intrinsics)
    return follow(landmarks, frame.image, expected, frame.intrinsics)


def load_query_frame(image: str | PathLike[str] | Picture, lens: Lens | None) -> Frame:
    """The photograph with its lens, if that is known. Raises TypeError, ValueError, FileNotFoundError."""
    if isinstance(image, (str, PathLike)) and not Path(image).is_file():
        raise FileNotFoundError(f"no photograph {str(image)!r}; give a file, or a picture")
    (frame, *_) = apply_lens(load_frames([image], None, False, ignore_progress), lens, [image]).frames
    if not isinstance(frame, Frame):
        raise ValueError(f"image {frame.name} cannot be read: {frame.reason}")
    return frame


def _parse_near(near: Near) -> Located | npt.NDArray[np.float64] | None:
    """Parses the known position of the photograph; None where nothing is known."""
    if near is None or isinstance(near, NotLocated):
        return None
    if isinstance(near, Located):
        return near
    try:
        T_world_camera = np.asarray(near, np.float64)
    except (TypeError, ValueError):
        raise TypeError(_WHAT_NEAR_IS.format(type(near).__name__)) from None
    if T_world_camera.shape != (4, 4):
        raise TypeError(_WHAT_NEAR_IS.format(f"shape {T_world_camera.shape}"))
    if problem := rigid_problem(T_world_camera.ravel().tolist()):
        raise ValueError(f"near must be {problem}")
    return T_world_camera


_WHAT_NEAR_IS = "near must be what localise returned, or T_world_camera (4, 4), got {}"
