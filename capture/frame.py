"""Frame and Intrinsics: the only image types in the project."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, TypeVar

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import UNSET, UnsetType

from splatnode.capture.process.text import LONGEST_NAME, LONGEST_TEXT, is_printable, sanitize_text

if TYPE_CHECKING:
    from splatnode.capture.depth_image import DepthImage


# How odometry says that a camera has moved from one frame to the next: wheels, an IMU, both together.

# Where others say that a camera was: odometry, a tracker, a drone's log.

LEAST_SIGMA = 1e-9  # metres or degrees: below it the weights of least squares overflow
LARGEST_M = 1e6  # of a coordinate, and of its standard deviation
POSE_SIGMA_M, POSE_SIGMA_DEG = 0.01, 2.0  # standard deviations where nobody tells any
_RIGID = 1e-2  # largest difference of a rotation times its transpose from the identity
_EXACT = 1e-6  # by which the last row may differ from 0 0 0 1
_SURELY = 0.999  # of a limit: within it, whatever the order in which it is computed


@dataclass(frozen=True)
class GivenPose:
    """T_world_camera in metres, row by row, and how unsure it is; the camera looks along z, x is right, y down.

    All poses of a stream have one world. Raises ValueError where it is no rigid motion, or a number is out of bounds.
    """

    T_world_camera: Annotated[tuple[float, ...], msgspec.Meta(min_length=16, max_length=16)]  # row by row, metres
    sigma_m: float = POSE_SIGMA_M  # standard deviation of the position in each direction, metres
    sigma_deg: float = POSE_SIGMA_DEG  # of the orientation about each axis, degrees

    def __post_init__(self) -> None:
        if not (LEAST_SIGMA <= self.sigma_m <= LARGEST_M and LEAST_SIGMA <= self.sigma_deg <= 180):
            raise ValueError(
                f"the sigmas of a given pose must be {LEAST_SIGMA:g} or more, up to {LARGEST_M:g} m and 180 degrees; "
                f"got {self.sigma_m:g} m and {self.sigma_deg:g} degrees"
            )
        if problem := rigid_problem(self.T_world_camera):
            raise ValueError(f"a given pose must be {problem}")

    @property
    def matrix(self) -> npt.NDArray[np.float64]:
        """T_world_camera (4, 4)."""
        return np.array(self.T_world_camera, np.float64).reshape(4, 4)


def rigid_problem(numbers: Sequence[float]) -> str:
    """Returns what 16 numbers, a matrix row by row in metres, must be; empty where they are a rigid motion."""
    if len(numbers) != 16 or not all(map(math.isfinite, numbers)):
        return "a matrix of 16 finite numbers row by row"
    matrix = np.array(numbers, np.float64).reshape(4, 4)
    if np.abs(matrix).max() > LARGEST_M:
        return f"within {LARGEST_M:g} m"
    rotation = matrix[:3, :3]
    turned = np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID or np.linalg.det(rotation) < 0
    if turned or np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > _EXACT:
        return "a rigid motion: a rotation, a translation, and 0 0 0 1"
    return ""


# T_base_camera as records have it: 16 numbers row by row, in metres.
MountNumbers: TypeAlias = Annotated[
    tuple[Annotated[float, msgspec.Meta(ge=-LARGEST_M, le=LARGEST_M)], ...],
    msgspec.Meta(min_length=16, max_length=16),
]


def make_rigid(T: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The rigid motion (4, 4) nearest to one whose rotation is not exact, as people and files round it."""
    left, _, right = np.linalg.svd(T[:3, :3])
    exact = np.eye(4)
    exact[:3, :3], exact[:3, 3] = left @ right, T[:3, 3]
    return exact


def are_rigid(matrices: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """(N,): of which of the (N, 4, 4), metres, `rigid_problem` has surely nothing to say; quickly, of many at once."""
    flat = matrices.reshape(-1, 16)
    within = np.all(np.isfinite(flat) & (np.abs(flat) <= LARGEST_M), axis=1)
    rotations = np.where(within[:, None, None], matrices[:, :3, :3], 0.0)
    off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    in_place = np.abs(matrices[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(1) <= _SURELY * _EXACT
    return within & (off <= _SURELY * _RIGID) & (np.linalg.det(rotations) > 0) & in_place


def make_given_pose(
    T_world_camera: npt.NDArray[np.floating], sigma_m: float = POSE_SIGMA_M, sigma_deg: float = POSE_SIGMA_DEG
) -> GivenPose:
    """The pose of a matrix (4, 4), metres and degrees. Raises ValueError."""
    matrix = np.asarray(T_world_camera, np.float64)
    if matrix.shape != (4, 4):
        raise ValueError(f"a given pose must be T_world_camera (4, 4), got {matrix.shape}")
    return GivenPose(tuple(matrix.ravel().tolist()), float(sigma_m), float(sigma_deg))


Matrix = npt.NDArray[np.float64]

# Standard deviations of a motion where nobody tells any: a share of its length, at least so many metres, and degrees.
MOTION_DRIFT, MOTION_SIGMA_M, MOTION_SIGMA_DEG = 0.02, 0.001, 2.0
_STILL = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Motion:
    """The motions since the chain began, added up, so that frames between two that are looked at may be missing.

    The camera looks along z, x is right, y down. What the steps are unsure adds up by squares: between two frames of a
    chain it is the root of the difference. Raises ValueError where it is no rigid motion, or a number is out of bounds.
    """

    chain: str  # motions of one chain belong together: printable, such as the name of its first frame
    T_start_current: Annotated[tuple[float, ...], msgspec.Meta(min_length=16, max_length=16)] = _STILL  # metres
    sigma_m: float = 0.0  # root of the sum of the squares of the steps' standard deviations, in each direction, metres
    sigma_deg: float = 0.0  # likewise of the turns about each axis, degrees

    def __post_init__(self) -> None:
        if not self.chain or not is_printable(self.chain, LONGEST_NAME):
            raise ValueError(f"the chain of a motion must have a printable name, got {self.chain[:40]!a}")
        if not (0 <= self.sigma_m <= LARGEST_M and 0 <= self.sigma_deg <= 1e6):
            raise ValueError(
                f"the sigmas of a motion must be 0 or more, up to {LARGEST_M:g} m and 1e6 degrees; "
                f"got {self.sigma_m:g} m and {self.sigma_deg:g} degrees"
            )
        if problem := rigid_problem(self.T_start_current):
            raise ValueError(f"a motion must be {problem}")

    @property
    def matrix(self) -> Matrix:
        """T_start_current (4, 4)."""
        return np.array(self.T_start_current, np.float64).reshape(4, 4)

    def append_step(self, T_previous_current: npt.NDArray[np.floating], sigma_m: float, sigma_deg: float) -> Motion:
        """Returns the motion with one more step: T_previous_current (4, 4), metres, and that step's sigmas.

        Raises ValueError where the step is no rigid motion, or a sigma is not above 0.
        """
        step = np.asarray(T_previous_current, np.float64)
        if step.shape != (4, 4) or (problem := rigid_problem(tuple(step.ravel().tolist()))):
            what = f"(4, 4), got {step.shape}" if step.shape != (4, 4) else problem
            raise ValueError(f"T_previous_current must be {what}")
        if not (0 < sigma_m <= LARGEST_M and 0 < sigma_deg <= 180):
            raise ValueError(
                f"the sigmas of a step must be above 0, up to {LARGEST_M:g} m and 180 degrees; "
                f"got {sigma_m:g} m and {sigma_deg:g} degrees"
            )
        whole = self.matrix @ step
        left, _, right = np.linalg.svd(whole[:3, :3])  # what is not quite a rotation would grow step by step
        whole[:3, :3] = left @ right
        sigmas = math.hypot(self.sigma_m, sigma_m), math.hypot(self.sigma_deg, sigma_deg)
        return replace(self, T_start_current=tuple(whole.ravel().tolist()), sigma_m=sigmas[0], sigma_deg=sigmas[1])


# Where an IMU says that down is.

GRAVITY_SIGMA_DEG = 2.0  # standard deviation where nobody tells any
_SHORTEST, _LONGEST = 1e-6, 1e6


@dataclass(frozen=True)
class Gravity:
    """The direction in which things fall, in the camera's frame (x right, y down, z forward), and how unsure it is.

    Its length does not count. Raises ValueError where it is no direction.
    """

    down: tuple[float, float, float]
    sigma_deg: float = GRAVITY_SIGMA_DEG  # standard deviation in each direction, degrees

    def __post_init__(self) -> None:
        length = math.hypot(*self.down)
        if len(self.down) != 3 or not _SHORTEST <= length <= _LONGEST:
            raise ValueError(f"gravity must be a direction of three numbers, not zero; got {list(self.down)[:4]}")
        if not LEAST_SIGMA <= self.sigma_deg <= 90:
            raise ValueError(
                f"the sigma of gravity must be {LEAST_SIGMA:g} or more, up to 90 degrees, got {self.sigma_deg:g}"
            )

    @property
    def direction(self) -> npt.NDArray[np.float64]:
        """(3,) of length 1."""
        down = np.array(self.down, np.float64)
        return down / np.linalg.norm(down)


# What a stereo camera's right half saw at the moment of a frame: the source of metres that a robot carries with it.

LONGEST_M = 100.0  # between two cameras that see one thing
SIGMA_M = 0.0003  # standard deviation of a baseline where nobody tells any


@dataclass(frozen=True)
class Baseline:
    """How far apart the two cameras of a stereo camera are. Raises ValueError for what no stereo camera has."""

    metres: float
    sigma_m: float = SIGMA_M  # standard deviation, metres

    def __post_init__(self) -> None:
        if not (math.isfinite(self.metres) and 0 < self.metres <= LONGEST_M):
            raise ValueError(f"a baseline must be above 0, up to {LONGEST_M:g} m, got {self.metres:g}")
        if not (math.isfinite(self.sigma_m) and 0 <= self.sigma_m < 0.5 * self.metres):
            raise ValueError(
                f"the sigma of a baseline must be at least 0 and less than half of it, got {self.sigma_m:g} m "
                f"for {self.metres:g} m"
            )


@dataclass(frozen=True, eq=False)
class RightImage:
    """The right picture of a rectified pair: its camera has the left one's axes and lens, and stands right of it."""

    image: npt.NDArray[np.uint8]  # (H, W) grey, of the frame's size
    baseline: Baseline

    def __post_init__(self) -> None:
        if self.image.ndim != 2 or self.image.dtype != np.uint8:
            raise ValueError(f"a right image must be (H, W) uint8, got {self.image.shape} {self.image.dtype}")


def partners(lefts: Sequence[str], rights: Sequence[str]) -> dict[str, str]:
    """The name of the right photograph of each left one that has one: both have one name, whatever their suffixes.

    Raises ValueError where none has a partner.
    """
    right_of = {_stem(name): name for name in rights}
    found = {name: right_of[_stem(name)] for name in lefts if _stem(name) in right_of}
    if not found:
        first = sanitize_text(lefts[0] if lefts else "none", 100)
        raise ValueError(f"no right photograph has the name of a left one, such as {first}; name both of a pair alike")
    return found


def _stem(name: str) -> str:
    return name.rpartition(".")[0] or name


def grey(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """(H, W) of an image (H, W, 3) RGB or (H, W), as a RightImage has it."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.uint8, copy=False)


# How a camera says that it exposed a frame: for how long, at which sensitivity, through which aperture.

_TIMES_S = (1e-7, 1e5)  # from the fastest flash to a night's stars
_ISOS = (1.0, 1e7)
_F_NUMBERS = (0.1, 1000.0)  # up to a pinhole's


@dataclass(frozen=True)
class ExposureSettings:
    """A camera's settings of one exposure. Raises ValueError where no camera could have them."""

    time_s: float  # seconds for which light was gathered
    iso: float  # sensitivity, as an ISO speed: 200 is twice as sensitive as 100
    f_number: float | None = None  # focal length over aperture; None: nobody knows, as of a lens without an iris

    def __post_init__(self) -> None:
        for what, number, (least, most), unit in (
            ("time", self.time_s, _TIMES_S, " seconds"),
            ("sensitivity", self.iso, _ISOS, " ISO"),
            ("f-number", self.f_number, _F_NUMBERS, ""),
        ):
            if number is not None and not least <= number <= most:
                raise ValueError(f"the {what} of an exposure must be {least:g} to {most:g}{unit}, got {number:g}")

    @property
    def log_exposure(self) -> float:
        """Natural logarithm of how bright a surface was recorded, against other frames of the same camera."""
        aperture = 1.0 if self.f_number is None else self.f_number
        return math.log(self.time_s * self.iso / 100.0 / aperture**2)


def parse_exposure(time_s: float | None, iso: float | None, f_number: float | None = None) -> ExposureSettings | None:
    """The settings that a camera or a file tells; None where it tells too little, or what cannot be, as 0 often is.

    An f-number that cannot be is left out alone.
    """
    if time_s is None or iso is None:
        return None
    if f_number is not None and not _F_NUMBERS[0] <= f_number <= _F_NUMBERS[1]:
        f_number = None
    try:
        return ExposureSettings(float(time_s), float(iso), f_number)
    except ValueError:  # it is a hint, which a frame may lack
        return None


# When an image was captured: a time, and the clock that it was read from.

LARGEST_NS = 2**62  # 146 years
_NS = 10**9
_READINGS = 5  # of both clocks, of which the one that was disturbed least counts


class Clock(Enum):
    """The clock that a time is read from. Times of two clocks cannot be compared."""

    UTC = "utc"
    LOCAL = "local"
    FILE = "file"
    RECORDING = "recording"

    @property
    def meaning(self) -> str:
        return _MEANINGS[self]


_MEANINGS = {
    Clock.UTC: "since 1970, UTC",
    Clock.LOCAL: "since 1970 by the camera's date and time, whose time zone is not known",
    Clock.FILE: "since 1970, UTC, when the file was last written",
    Clock.RECORDING: "since the recording, or its simulation, began",
}


@dataclass(frozen=True)
class Stamp:
    """A time of capture. Raises ValueError where it is before its clock's zero, or beyond LARGEST_NS."""

    ns: Annotated[int, msgspec.Meta(ge=0, le=LARGEST_NS)]  # nanoseconds
    clock: Clock  # what they are counted from: UTC, LOCAL, FILE or RECORDING

    def __post_init__(self) -> None:
        if not 0 <= self.ns <= LARGEST_NS:
            raise ValueError(f"a time stamp must be 0 to 2**62 ns, got {self.ns}")

    @property
    def seconds(self) -> str:
        """In decimal digits, none of which is lost."""
        return f"{self.ns // _NS}.{self.ns % _NS:09d}"


def nearest_stamp(ns: int, clock: Clock) -> Stamp:
    """The stamp of `ns`, which may be anything: a clock may be set to any year, and a file's time, too."""
    return Stamp(min(max(0, ns), LARGEST_NS), clock)


def wall_clock(mono_ns: int) -> Stamp:
    """Converts a time of this machine's monotonic clock to the wall clock, if nobody has set it since."""
    return nearest_stamp(mono_ns + min(_reading() for _ in range(_READINGS))[1], Clock.UTC)


def _reading() -> tuple[int, int]:
    """How long it took to read both clocks, and how far the wall clock is ahead of the monotonic one, nanoseconds."""
    before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
    return after - before, wall - (before + after) // 2


LARGEST_NUMBER = 2**62  # of ids and stamps
LARGEST_SIDE = 65_535  # pixels, as of a JPEG
LARGEST_IMAGE = 1 << 30  # pixels
COEFFICIENTS = {  # of each lens model: the most that it takes, and what they are
    "opencv": (14, "OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]"),
    "fisheye": (4, "k1 k2 k3 k4 of OpenCV's fisheye"),
}
SOURCES = ("exif", "given", "calibration", "estimated")
_SMALLEST_FOCAL, _LARGEST_LENS = 1e-6, 1e9  # pixels, and the coefficients' size
LARGEST_SKEW = 1.0  # of either sign: columns at 45 degrees


@dataclass(frozen=True)
class Intrinsics:
    """A camera's calibration, in pixels of an image `width` x `height`.

    The centre of the top-left pixel is (0.5, 0.5), as in COLMAP. `distortion` are the coefficients of the lens'
    `model`: "opencv" (radial and tangential, k1 k2 p1 p2 ...; a pinhole where there are none) or "fisheye"
    (equidistant, k1 k2 k3 k4). A picture with `skew` is sheared, as a rolling shutter in a turn or an editor leaves it:
    distorted normalized coordinates (x, y) are seen at u = fx (x + skew y) + cx, v = fy y + cy. `source` tells where
    the numbers come from: "exif" (nominal, a few per cent), "given" or "calibration" (trusted), "estimated" (by the
    reconstruction).
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
    skew: float = 0.0  # how far a row moves across for one down, in normalized coordinates; of a fisheye 0

    def __post_init__(self) -> None:
        lens = (self.fx, self.fy, self.cx, self.cy, self.skew, *self.distortion)
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
        if abs(self.skew) > LARGEST_SKEW:
            raise ValueError(f"the skew of intrinsics must be within {LARGEST_SKEW:g} of 0, got {self.skew:g}")
        if self.skew and self.model == "fisheye":
            raise ValueError(
                f"the skew of intrinsics must be 0 for the model fisheye, which has none, got {self.skew:g}"
            )
        for name in ("width", "height", "fx", "fy", "cx", "cy", "skew"):  # no message takes NumPy's numbers, as of a K
            object.__setattr__(self, name, (int if name in ("width", "height") else float)(getattr(self, name)))
        object.__setattr__(self, "distortion", tuple(map(float, self.distortion)))
        if self.source not in SOURCES:
            raise ValueError(f"the source of intrinsics must be one of {', '.join(SOURCES)}, got {self.source[:40]!a}")

    @property
    def K(self) -> npt.NDArray[np.float64]:  # (3, 3)
        return np.array([[self.fx, self.fx * self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> Intrinsics:
        """The same camera for its image resized to `width` x `height`; the skew, in units of fx, stays as it is."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a stream, within bounds that hold for all that is made of it: `make_frame` where they may not
    hold.
    """

    frame_id: int  # position in its stream, from 0
    name: str  # printable, unique in its stream; for a file, its name as `sanitize_name` writes it
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
    camera: str = ""  # make, model and lens, as EXIF tells: different ones share no lens; empty: unknown
    camera_id: str = ""  # of several cameras, which one: what a robot or a folder calls it; empty: there is one
    depth: DepthImage | None = field(default=None, repr=False)  # of a depth camera beside its camera; None: none
    # T_base_camera of its camera on the robot's base (x forward, y left, z up), metres, row by row; None: nobody knows
    T_base_camera: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for text in ("name", "camera", "camera_id"):
            object.__setattr__(self, text, sanitize_text(getattr(self, text), LONGEST_NAME))
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
        if self.depth is not None:
            self.depth.check_beside(self.width, self.height)
        if self.T_base_camera is not None and (problem := rigid_problem(self.T_base_camera)):
            raise ValueError(f"T_base_camera must be {problem}")
        if not self.name:
            raise ValueError("a frame must have a name")
        for what, number in (("frame_id", self.frame_id), ("stamp_ns", self.stamp_ns)):
            if not 0 <= number <= LARGEST_NUMBER:
                raise ValueError(f"{what} must be 0 to 2**62, got {number}")

    @property
    def mount(self) -> npt.NDArray[np.float64] | None:
        """T_base_camera (4, 4); None where nobody knows it."""
        return None if self.T_base_camera is None else np.array(self.T_base_camera, np.float64).reshape(4, 4)

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
    camera_id: str = "",
    depth: DepthImage | None = None,
    T_base_camera: tuple[float, ...] | None = None,
) -> Frame | DroppedFrame:
    """Makes a Frame of what a camera or a file gave; drops it, with the reason, where it is out of a Frame's bounds."""
    try:
        came = given_pose, motion, gravity, right, exposure, camera, camera_id, depth, T_base_camera
        return Frame(frame_id, name, stamp_ns, image, intrinsics, encoded, captured_at, mask, *came)
    except ValueError as error:
        return DroppedFrame(name, f"it cannot be used: {error}")


def rename_frame(frame: Frame, frame_id: int, name: str, stamp_ns: int) -> Frame | DroppedFrame:
    """The same image as another frame, which may be beyond a Frame's bounds."""
    try:
        return replace(frame, frame_id=frame_id, name=name, stamp_ns=stamp_ns)
    except ValueError as error:
        return DroppedFrame(name, f"it cannot be used: {error}")


# Fields of records that are left out where there is nothing: a reader that does not know them reads the rest.

T = TypeVar("T")


def make_optional_field(value: T | None) -> T | UnsetType:
    """The value as a field; left out where it is None."""
    return UNSET if value is None else value


def read_optional_field(field: T | UnsetType) -> T | None:
    """The value of a field; None where it was left out."""
    return None if isinstance(field, UnsetType) else field


# What a camera that may have no frame for long gives in place of one: it is there, and has nothing new.


@dataclass(frozen=True)
class KeepAlive:
    """A loss is over with it as with a frame. Nobody but the reader gets it (capture/reader.py)."""


# The error that every camera raises when it cannot be used.


class CameraUnavailable(RuntimeError):
    """No camera, or no longer: what was expected, what was found, what to do."""

    exit_code = 69


# FrameMeta: the one schema of what a frame is beside its arrays.

_Name = Annotated[str, msgspec.Meta(min_length=1, max_length=LONGEST_NAME)]
_Count = Annotated[int, msgspec.Meta(ge=0, le=LARGEST_NUMBER)]


class FrameMeta(msgspec.Struct, frozen=True, kw_only=True):
    """Describes a frame beside its arrays, in messages, checkpoints and recordings alike.

    A field with a default is left out where there is nothing to tell: a reader that does not know it takes every
    frame without it.
    """

    name: _Name
    stamp_ns: _Count
    intrinsics: Intrinsics | None
    captured_at: Stamp | None = None
    given_pose: GivenPose | UnsetType = UNSET
    motion: Motion | UnsetType = UNSET
    gravity: Gravity | UnsetType = UNSET
    exposure: ExposureSettings | UnsetType = UNSET
    camera: _Name | UnsetType = UNSET
    camera_id: _Name | UnsetType = UNSET
    T_base_camera: MountNumbers | UnsetType = UNSET


def describe_frame(frame: Frame) -> dict[str, Any]:
    """Returns the fields of FrameMeta by name."""
    return {
        "name": frame.name,
        "stamp_ns": frame.stamp_ns,
        "intrinsics": frame.intrinsics,
        "captured_at": frame.captured_at,
        "given_pose": make_optional_field(frame.given_pose),
        "motion": make_optional_field(frame.motion),
        "gravity": make_optional_field(frame.gravity),
        "exposure": make_optional_field(frame.exposure),
        "camera": frame.camera or UNSET,
        "camera_id": frame.camera_id or UNSET,
        "T_base_camera": make_optional_field(frame.T_base_camera),
    }


def read_frame_fields(meta: FrameMeta) -> dict[str, Any]:
    """Returns what `Frame` takes of `meta` by name, apart from `name` and `stamp_ns`."""
    return {
        "intrinsics": meta.intrinsics,
        "captured_at": meta.captured_at,
        "given_pose": read_optional_field(meta.given_pose),
        "motion": read_optional_field(meta.motion),
        "gravity": read_optional_field(meta.gravity),
        "exposure": read_optional_field(meta.exposure),
        "camera": read_optional_field(meta.camera) or "",
        "camera_id": read_optional_field(meta.camera_id) or "",
        "T_base_camera": read_optional_field(meta.T_base_camera),
    }


# A recording at the pace at which it was taken.

FramesPerSecond = Annotated[float, msgspec.Meta(ge=0.001, le=1000)]
Pace = Literal["recorded", "fastest"]  # by the stamps, or as fast as the consumer reads


def pace_frames(items: Iterable[Frame | DroppedFrame], pace: Pace) -> Iterator[Frame | DroppedFrame]:
    """The items, each frame not before its time after the first one's; the stamps stay as they are."""
    start_s, first_ns = 0.0, None
    for item in items:
        if pace == "recorded" and isinstance(item, Frame):
            if first_ns is None:
                start_s, first_ns = time.monotonic(), item.stamp_ns
            time.sleep(max(0.0, start_s + (item.stamp_ns - first_ns) / 1e9 - time.monotonic()))
        yield item
