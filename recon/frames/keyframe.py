"""Keyframe: an accepted frame with its features, and its image at modelled size, to which the scene is fitted."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame, Intrinsics

# Thresholds in pixels hold at this longer side of an image: an error counts as error * REFERENCE_SIDE / longer side.
REFERENCE_SIDE = 1024


# What OpenCV and NumPy raise where they cannot work with the pixels or points of one image. Such a fault costs that
# image or that pair, and is logged with its name; every other exception is a fault of ours and surfaces.
LIBRARY_ERRORS = (cv2.error, np.linalg.LinAlgError)

PLAIN = 1.0  # the tilt of features of the image as it is


@dataclass(frozen=True, eq=False)
class Features:
    """Local features of a frame at full size. A point may have several descriptors, one for each simulated tilt."""

    points: npt.NDArray[np.float64]  # (M, 2) pixels of the full-size image, top-left pixel centre at (0.5, 0.5)
    descriptors: npt.NDArray[np.uint8]  # (D, 128) as matching/features.py quantises them
    point_of: npt.NDArray[np.int64]  # (D,) the point that a descriptor describes
    # (D,) simulated tilt: by which the image's width was divided; below 1, its height was multiplied by it; 1 for none
    tilt: npt.NDArray[np.float64]

    def select_tilt(self, tilt: float) -> Features:
        """Returns the features with the descriptors of this tilt alone, in their order: the strongest first."""
        chosen = self.tilt == tilt
        return Features(self.points, self.descriptors[chosen], self.point_of[chosen], self.tilt[chosen])


_KEY_POINTS = 64  # features whose places tell any two photographs apart


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame that was accepted, with what every later stage needs of it."""

    frame: Frame  # undistorted, at full size
    image: npt.NDArray[np.uint8]  # (h, w, 3) RGB at modelled size
    features: Features
    lens: Intrinsics | None = None  # estimated, whose distortion was taken out of all of it; None: nothing was
    moving: float = 0.0  # share of the frame that its mask hides because it was found to move

    @property
    def name(self) -> str:
        """Returns the frame's name, by which its point maps, views and cameras are found."""
        return self.frame.name

    @property
    def scale(self) -> tuple[float, float]:
        """Modelled width over full width, and modelled height over full height."""
        return self.image.shape[1] / self.frame.width, self.image.shape[0] / self.frame.height

    @property
    def mask(self) -> npt.NDArray[np.bool_] | None:
        """(h, w) at modelled size, True where all that a pixel is made of is used; None: all pixels are."""
        if self.frame.mask is None:
            return None
        return resize_mask(self.frame.mask, *self.image.shape[:2])


def content_key(keyframe: Keyframe) -> bytes:
    """A key to sort keyframes by what they show, so that an answer does not depend on the order in which they came."""
    return keyframe.features.points[:_KEY_POINTS].tobytes()


def longer_side(frame: Frame) -> int:
    """Returns the longer side of the frame at full size, pixels."""
    return max(frame.width, frame.height)


def principal_point(frame: Frame) -> npt.NDArray[np.float64]:
    """(2,) pixels of the frame at full size: as its intrinsics give it, else the middle of the image."""
    if frame.intrinsics is not None:
        return np.array([frame.intrinsics.cx, frame.intrinsics.cy])
    return np.array([frame.width / 2.0, frame.height / 2.0])


def compute_model_size(width: int, height: int, longer_side: int) -> tuple[int, int]:
    """(width, height) with the longer side at most `longer_side`; images are never enlarged."""
    scale = min(1.0, longer_side / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def resize_mask(mask: npt.NDArray[np.bool_], height: int, width: int) -> npt.NDArray[np.bool_]:
    """(height, width) of a mask (H, W): True where all that a pixel is made of is used."""
    return cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.999


def resize_image(image: npt.NDArray[np.uint8], longer_side: int) -> npt.NDArray[np.uint8]:
    """`image` (H, W, 3) area-resampled to its modelled size (h, w, 3); itself where it has that size."""
    width, height = compute_model_size(image.shape[1], image.shape[0], longer_side)
    if (width, height) == (image.shape[1], image.shape[0]):
        return image
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
