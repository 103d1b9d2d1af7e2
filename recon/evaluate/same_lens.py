"""Held-out photographs as a scene shows them: without the distortion that was taken out of its own photographs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.lenses.undistort import undistort_frame
from splatnode.recon.evaluate.regions import UNKNOWN, Counts
from splatnode.recon.result.snapshot import CameraEstimate

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]


def select_one_lens(cameras: Sequence[CameraEstimate]) -> Sequence[CameraEstimate]:
    """Those whose photographs had a distortion taken out, if they are most; else those whose had none."""
    bent = [camera for camera in cameras if camera.lens is not None]
    return bent if 2 * len(bent) > len(cameras) else [camera for camera in cameras if camera.lens is None]


def undistort_view(lens: Intrinsics | None, image: Image, mask: Mask) -> tuple[Image, Mask]:
    """A photograph (H, W, 3), and where it is used (H, W), without the distortion of `lens`; None: as they are.

    Raises ValueError where `lens` folds its picture over.
    """
    if lens is None:
        return image, mask
    frame = undistort_frame(Frame(0, "photograph", 0, image, lens, mask=mask))
    return frame.image, np.ones(frame.image.shape[:2], bool) if frame.mask is None else frame.mask


def undistort_counts(lens: Intrinsics | None, counts: Counts) -> Counts | None:
    """How many photographs show each pixel (H, W) of a photograph, without the distortion of `lens`.

    UNKNOWN where pixels that differ in it are mixed. None for a fisheye, whose picture gets another shape.
    """
    if lens is None:
        return counts
    if lens.model == "fisheye":
        return None
    blank, straight = np.zeros((*counts.shape, 3), np.uint8), np.full_like(counts, UNKNOWN)
    for count in np.unique(counts):
        straight[undistort_view(lens, blank, counts == count)[1]] = count
    return straight


def average_intrinsics(cameras: Sequence[CameraEstimate], width: int, height: int) -> npt.NDArray[np.float64]:
    """(3, 3) K for an image `width` x `height`: mean focal lengths and principal point, relative to the image sizes."""
    longer = np.array([max(camera.width, camera.height) for camera in cameras])
    Ks = np.stack([camera.K for camera in cameras])
    fx, fy = (float((Ks[:, i, i] / longer).mean()) * max(width, height) for i in (0, 1))
    cx = float((Ks[:, 0, 2] / [camera.width for camera in cameras]).mean()) * width
    cy = float((Ks[:, 1, 2] / [camera.height for camera in cameras]).mean()) * height
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
