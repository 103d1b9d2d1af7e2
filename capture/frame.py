"""Frame and Intrinsics: the only image types in the project."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.exposure_settings import ExposureSettings
from splatnode.capture.given_pose import GivenPose
from splatnode.capture.gravity import Gravity
from splatnode.capture.motion import Motion
from splatnode.capture.process.printable import LONGEST_NAME, LONGEST_TEXT, sanitize_text
from splatnode.capture.right_image import RightImage
from splatnode.capture.stamp import Stamp

LARGEST_NUMBER = 2**62  # of ids and stamps
LARGEST_SIDE = 65_535  # pixels, as of a JPEG
LARGEST_IMAGE = 1 << 30  # pixels
COEFFICIENTS = {  # of each lens model: the most that it takes, and what they are
    "opencv": (14, "OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]"),
    "fisheye": (4, "k1 k2 k3 k4 of OpenCV's fisheye"),
}
SOURCES = ("exif", "given", "calibration", "estimated")
_SMALLEST_FOCAL, _LARGEST_LENS = 1e-6, 1e9  # pixels, and the coefficients' size


@dataclass(frozen=True)
class Intrinsics:
    """A camera's calibration, in pixels of an image `width` x `height`.

    The centre of the top-left pixel is (0.5, 0.5), as in COLMAP. `distortion` are the coefficients of the lens'
    `model`: "opencv" (radial and tangential, k1 k2 p1 p2 ...; a pinhole where there are none) or "fisheye"
    (equidistant, k1 k2 k3 k4). `source` tells where the numbers come from: "exif" (nominal, a few per cent),
    "given" or "calibration" (trusted), "estimated" (by the reconstruction).
    """

    width: int  # of the images that were calibrated, pixels
    height: int  # likewise, pixels
    fx: float  # focal length across, pixels
    fy: float  # focal length down, pixels
    cx: float  # principal point from the left border, pixels: OpenCV's plus 0.5
    cy: float  # principal point from the upper border, pixels: OpenCV's plus 0.5
    source: str  # calibration or given: the lens is trusted; exif: it is right to a few per cent
    distortion: tuple[float, ...] = ()  # of its model, as OpenCV's k1 k2 p1 p2 k3 ...; none: all are 0
    model: str = "opencv"  # of the lens: opencv (a pinhole where there are no coefficients), fisheye (k1 k2 k3 k4)

    def __post_init__(self) -> None:
        lens = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if min(self.width, self.height, self.fx, self.fy) <= 0 or not all(map(math.isfinite, lens)):
            raise ValueError(f"intrinsics must be finite, sizes and focal lengths above 0; got {self}")
        if max(self.width, self.height) > LARGEST_SIDE:
            raise ValueError(f"intrinsics must be of at most {LARGEST_SIDE} pixels a side; got {self}")
        if min(self.fx, self.fy) < _SMALLEST_FOCAL or max(map(abs, lens)) > _LARGEST_LENS:
            raise ValueError(f"intrinsics must be within {_SMALLEST_FOCAL:g} and {_LARGEST_LENS:g}; got {self}")
        if self.model not in COEFFICIENTS:
            known = ", ".join(COEFFICIENTS)
            raise ValueError(f"the model of a lens in intrinsics must be one of {known}, got {self.model[:40]!a}")
        most, what = COEFFICIENTS[self.model]
        if len(self.distortion) > most:
            raise ValueError(
                f"distortion must be {what}, got {len(self.distortion)} numbers for the model {self.model}. "
                "Calibrate with cv2.calibrateCamera, or cv2.fisheye.calibrate and model: fisheye."
            )
        if self.source not in SOURCES:
            raise ValueError(f"the source of intrinsics must be one of {', '.join(SOURCES)}, got {self.source[:40]!a}")

    @property
    def K(self) -> npt.NDArray[np.float64]:  # (3, 3)
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> Intrinsics:
        """The same camera for its image resized to `width` x `height`."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a stream, within bounds that hold for all that is made of it: `make_frame` where they may not hold."""

    frame_id: int  # position in its stream, from 0
    name: str  # printable, unique in its stream; for a file, its name as `printable_name` writes it
    stamp_ns: int  # time in its stream, which never falls; of a live camera, the monotonic clock at exposure
    image: npt.NDArray[np.uint8]  # (H, W, 3) RGB
    intrinsics: Intrinsics | None  # None: nothing is known about this camera
    encoded: bytes | None = field(default=None, repr=False)  # the JPEG or PNG that `image` was decoded from, if any
    captured_at: Stamp | None = None  # None: nobody knows
    mask: npt.NDArray[np.bool_] | None = field(default=None, repr=False)  # (H, W), False: not used; None: all is used
    given_pose: GivenPose | None = None  # of its camera, by odometry or a tracker; None: nobody knows
    motion: Motion | None = None  # of its camera since earlier frames, by wheels or an IMU; None: nobody knows
    gravity: Gravity | None = None  # in its camera's frame; None: nobody knows
    right: RightImage | None = field(default=None, repr=False)  # of a stereo camera, whose left image is `image`
    exposure: ExposureSettings | None = None  # as its camera or its EXIF tells; None: nobody knows
    camera: str = (
        ""  # which camera took it through which lens, as EXIF tells: different ones share none; empty: unknown
    )

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", sanitize_text(self.name, LONGEST_NAME))
        if self.image.ndim != 3 or self.image.shape[2] != 3 or self.image.dtype != np.uint8:
            raise ValueError(f"image must be (H, W, 3) uint8, got {self.image.shape} {self.image.dtype}")
        if not 1 <= self.width <= LARGEST_SIDE or not 1 <= self.height <= LARGEST_SIDE:
            raise ValueError(f"image must have 1 to {LARGEST_SIDE} pixels a side, got {self.width} x {self.height}")
        if self.width * self.height > LARGEST_IMAGE:
            raise ValueError(f"image must have at most {LARGEST_IMAGE} pixels, got {self.width} x {self.height}")
        if self.mask is not None and (self.mask.shape != self.image.shape[:2] or self.mask.dtype != np.bool_):
            raise ValueError(f"mask must be {self.image.shape[:2]} bool, got {self.mask.shape} {self.mask.dtype}")
        if self.right is not None and self.right.image.shape != self.image.shape[:2]:
            raise ValueError(f"the right image must be {self.image.shape[:2]}, got {self.right.image.shape}")
        if not self.name:
            raise ValueError("a frame must have a name")
        for what, number in (("frame_id", self.frame_id), ("stamp_ns", self.stamp_ns)):
            if not 0 <= number <= LARGEST_NUMBER:
                raise ValueError(f"{what} must be 0 to 2**62, got {number}")

    @property
    def height(self) -> int:
        return self.image.shape[0]

    @property
    def width(self) -> int:
        return self.image.shape[1]


def reduce_image(image: npt.NDArray[np.uint8], longer_side: int) -> npt.NDArray[np.uint8]:
    """`image` (H, W, 3) by the largest whole factor that leaves its longer side at least `longer_side` pixels.

    Averages whole blocks, halving where it can, which is ten times as fast as resampling to an exact size.
    """
    factor = max(1, max(image.shape[:2]) // longer_side)
    if factor % 2 == 0 and factor > 2:
        return reduce_image(reduce_image(image, max(image.shape[:2]) // 2), longer_side)
    size = max(1, image.shape[1] // factor), max(1, image.shape[0] // factor)
    whole = image[: size[1] * factor, : size[0] * factor]
    return cv2.resize(whole, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


@dataclass(frozen=True)
class DroppedFrame:
    """An image that was left out, and why: a result, not an exception."""

    name: str  # its file's, or that by which it was given
    reason: str  # one sentence

    def __post_init__(self) -> None:
        """Both are shown to people, and what a decoder says of a stranger's file is a stranger's text."""
        object.__setattr__(self, "name", sanitize_text(self.name, LONGEST_NAME))
        object.__setattr__(self, "reason", sanitize_text(self.reason, LONGEST_TEXT))


def make_frame(
    frame_id: int,
    name: str,
    stamp_ns: int,
    image: npt.NDArray[np.uint8],
    intrinsics: Intrinsics | None,
    encoded: bytes | None = None,
    captured_at: Stamp | None = None,
    mask: npt.NDArray[np.bool_] | None = None,
    given_pose: GivenPose | None = None,
    motion: Motion | None = None,
    gravity: Gravity | None = None,
    right: RightImage | None = None,
    exposure: ExposureSettings | None = None,
    camera: str = "",
) -> Frame | DroppedFrame:
    """Makes a Frame of what a camera or a file gave; drops it, with the reason, where it is out of a Frame's bounds."""
    try:
        came = given_pose, motion, gravity, right, exposure, camera
        return Frame(frame_id, name, stamp_ns, image, intrinsics, encoded, captured_at, mask, *came)
    except ValueError as error:
        return DroppedFrame(name, f"it cannot be used: {error}")


def rename_frame(frame: Frame, frame_id: int, name: str, stamp_ns: int) -> Frame | DroppedFrame:
    """The same image as another frame, which may be beyond a Frame's bounds."""
    known = frame.image, frame.intrinsics, frame.encoded, frame.captured_at, frame.mask
    came = frame.given_pose, frame.motion, frame.gravity, frame.right, frame.exposure, frame.camera
    return make_frame(frame_id, name, stamp_ns, *known, *came)
