"""Verdicts: a set of frames that cannot be reconstructed is a result with a code, one sentence, and what to do."""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.text import LONGEST_TEXT, sanitize_text

# The frame of reference of a result: what its coordinates count from, and how that is known.
#
# Names in the field's words; those of ROS (REP 105) are taken as aliases. Axes of a robot's frames are REP 103's: x
# forward, y left, z up. That of the first camera is OpenCV's: x right, y down, z forward.

Array = npt.NDArray[np.float64]
Matrix16: TypeAlias = Annotated[tuple[float, ...], msgspec.Meta(min_length=16, max_length=16)]  # (4, 4) row by row
FrameChoice: TypeAlias = Literal["first_camera", "base", "odometry", "upright", "base_link", "odom"]

_ALIASES = {"base_link": "base", "odom": "odometry"}
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
_EXACT = 1e-6  # by which a rigid motion may differ from one


class FrameName(enum.Enum):
    """The frame of reference of a result."""

    FIRST_CAMERA = "first_camera"  # that of the first image
    BASE = "base"  # the robot's base at the first image: x forward, y left, z up
    ODOMETRY = "odometry"  # that of the given poses: odometry, a tracker, an arm
    UPRIGHT = "upright"  # at the first camera: x forward, y left, both level; z against gravity


_AXES = {
    FrameName.FIRST_CAMERA: "the first camera's: x right, y down, z forward",
    FrameName.BASE: "the robot's base at the first image: x forward, y left, z up",
    FrameName.ODOMETRY: "that of the given poses or odometry",
    FrameName.UPRIGHT: "at the first camera: x forward, y left, both level; z up",
}


@dataclass(frozen=True)
class ReferenceFrame:
    """The frame that all coordinates of a result are in."""

    name: FrameName = FrameName.FIRST_CAMERA  # which it is
    source: str | None = None  # how it is known, in words; None: the first camera's needs no word
    sigma_deg: float | None = None  # of an upright one: standard deviation of its z axis in each direction, degrees
    # The first camera's pose in it, in the result's unit: p_frame = T_frame_first_camera @ p_first_camera
    T_frame_first_camera: Matrix16 = _IDENTITY

    @property
    def matrix(self) -> Array:
        """T_frame_first_camera (4, 4)."""
        return np.array(self.T_frame_first_camera, np.float64).reshape(4, 4)

    @property
    def sentence(self) -> str:
        """Says what it is, for a line of a text file."""
        known = f" (known by {self.source}" if self.source else ""
        sure = f", to {self.sigma_deg:.2g} degrees" if self.sigma_deg is not None else ""
        return f"{self.name.value}, {_AXES[self.name]}{known}{sure}{')' if known else ''}"

    def record(self) -> dict[str, Any]:
        """Returns it as JSON files state it."""
        return {
            "frame": self.name.value,
            "frame_source": self.source,
            "frame_sigma_deg": self.sigma_deg,
            "T_frame_first_camera": self.matrix.tolist(),
        }


FIRST_CAMERA = ReferenceFrame()


def parse_frame_name(choice: str) -> FrameName:
    """Returns the frame of a name or of its alias. Raises ValueError."""
    try:
        return FrameName(_ALIASES.get(choice, choice))
    except ValueError:
        known = ", ".join([each.value for each in FrameName] + list(_ALIASES))
        raise ValueError(f"the frame of reference must be one of {known}; got {choice[:40]!a}") from None


def find_frame_problem(T_frame_first_camera: Array) -> str:
    """Describes what is wrong with the matrix of a frame that a stranger wrote; empty where nothing is."""
    if T_frame_first_camera.shape != (4, 4) or not np.isfinite(T_frame_first_camera).all():
        return "T_frame_first_camera must be (4, 4) of finite numbers"
    rotation = T_frame_first_camera[:3, :3]
    turned = np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation) < 0
    if turned or np.abs(T_frame_first_camera[3] - [0.0, 0.0, 0.0, 1.0]).max() > _EXACT:
        return "T_frame_first_camera must be a rigid motion"
    return ""


def encode_matrix(T: Array) -> tuple[float, ...]:
    """(4, 4) as 16 numbers, row by row."""
    return tuple(np.asarray(T, np.float64).ravel().tolist())


# Verdicts: a set of frames that cannot be reconstructed is a result with a code, one sentence, and what to do.


class Code(enum.Enum):
    """The codes of a verdict. `recon/verification/__init__.py` has the sentences and the advice."""

    OK = "OK"
    OK_PARTIAL = "OK_PARTIAL"
    OK_ROUGH = "OK_ROUGH"
    TOO_ROUGH = "TOO_ROUGH"
    TOO_FEW_VIEWS = "TOO_FEW_VIEWS"
    NO_OVERLAP = "NO_OVERLAP"
    LOW_TEXTURE = "LOW_TEXTURE"
    NO_PARALLAX = "NO_PARALLAX"
    PLANAR_ONLY = "PLANAR_ONLY"
    BASELINE_TOO_SMALL = "BASELINE_TOO_SMALL"
    OUTLIER_VIEW = "OUTLIER_VIEW"
    AMBIGUOUS = "AMBIGUOUS"
    BLUR = "BLUR"
    EXPOSURE_SHIFT = "EXPOSURE_SHIFT"
    MOVING_SCENE = "MOVING_SCENE"
    STATIC_CAMERA = "STATIC_CAMERA"
    FOCAL_SUSPECT = "FOCAL_SUSPECT"
    MIXED_CAMERAS = "MIXED_CAMERAS"
    STEREO_IMAGES = "STEREO_IMAGES"
    PANORAMA = "PANORAMA"
    TURNTABLE = "TURNTABLE"
    SPLIT = "SPLIT"
    OVERFIT = "OVERFIT"
    DIVERGED = "DIVERGED"
    UNDETERMINED = "UNDETERMINED"
    FRAME_UNKNOWN = "FRAME_UNKNOWN"
    BUDGET_HIT = "BUDGET_HIT"


SURE = (Code.OK, Code.OK_PARTIAL)  # the scene is known well enough to measure in it, and to map what is free


@dataclass(frozen=True)
class Verdict:
    """The verdict on a set of images, whether there is a scene of them or not."""

    code: Code  # OK, OK_PARTIAL or OK_ROUGH, or why there is no scene: docs/verdicts.md explains each
    message: str  # one sentence
    advice: str  # what to do about it; empty when there is nothing to do
    frames: tuple[str, ...] = ()  # the names that the code is about
    publishable: bool = False  # whether a scene may be shown as a result
    provisional: bool = False  # whether evidence is still to be looked at that may change it


# How wrong an estimated camera may be: bounds on its errors, each of which holds for 95 % of all cameras.
#
# Rotations are counted after the best common rotation, centres after the best similarity: of photographs alone, the
# world's place, direction and scale are not known.

Vector = tuple[float, float, float]
Axes = tuple[Vector, Vector, Vector]

_CHI2_95_OF_3 = 7.815  # 95 % quantile of the chi-squared distribution with 3 degrees of freedom
_NORMAL_95 = 1.645  # 95 % quantile of the standard normal distribution
_NEGLIGIBLE = 1e-6  # standard deviation over bound: below, a covariance is rounding and has no shape


@dataclass(frozen=True)
class Bounds:
    """95 % bounds of one camera's errors."""

    rotation_deg: float  # degrees
    centre: float  # in the unit of the world: metres where it is metric
    centre_percent: float  # the same, of the distance to the scene: the median depth of its points
    focal_percent: float  # of the focal length
    axes: Axes  # of the ellipsoid that holds the centre: semi-axes in the world's frame and unit, the longest first

    def widen(self, factor: float) -> Bounds:
        """Every bound `factor` times as wide."""
        wider = self.rescale(factor)
        return replace(
            wider,
            rotation_deg=factor * self.rotation_deg,
            centre_percent=factor * self.centre_percent,
            focal_percent=factor * self.focal_percent,
        )

    def rescale(self, factor: float) -> Bounds:
        """The same in a world whose unit is `factor` times smaller."""
        return replace(self, centre=self.centre * factor, axes=make_axes(factor * np.array(self.axes)))


def find_widest(bounds: Iterable[Bounds]) -> Bounds | None:
    """The widest bound of each kind, with the ellipsoid of the widest centre; None without any."""
    every = list(bounds)
    if not every:
        return None
    return Bounds(
        rotation_deg=max(each.rotation_deg for each in every),
        centre=max(each.centre for each in every),
        centre_percent=max(each.centre_percent for each in every),
        focal_percent=max(each.focal_percent for each in every),
        axes=max(every, key=lambda each: each.centre).axes,
    )


def make_ball(radius: float) -> Axes:
    """The semi-axes of a ball."""
    return ((radius, 0.0, 0.0), (0.0, radius, 0.0), (0.0, 0.0, radius))


def compute_axes(covariance: Array, centre: float) -> Axes:
    """The semi-axes of the ellipsoid of 95 % for a centre whose errors are shorter than `centre` with 95 %.

    `covariance` (3, 3) gives its shape, `centre` its size: the ellipsoid is that of a normal distribution with a
    multiple of the covariance under which 95 % of the errors are shorter than `centre`. A ball where all directions
    are alike; in a needle's direction it is longer than `centre`, by 1.4 times at most, for an ellipsoid of three
    dimensions must be wider to hold as much. A ball, too, where `covariance` is not finite or has no size.
    """
    if not (np.isfinite(covariance).all() and np.isfinite(centre)):
        return make_ball(centre)
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2.0)
    variances = values[::-1].clip(0.0)
    if variances[0] <= (_NEGLIGIBLE * centre) ** 2:
        return make_ball(centre)
    lengths = centre * np.sqrt(_CHI2_95_OF_3 * variances / _compute_squared_length_95(variances))
    directions = vectors.T[::-1]
    largest = directions[np.arange(3), np.abs(directions).argmax(1)]
    return make_axes(lengths[:, None] * directions * np.sign(largest)[:, None])


def compute_covariance(axes: Axes) -> Array:
    """(3, 3) of the normal distribution whose 95 % ellipsoid has these semi-axes."""
    rows = np.array(axes)
    return rows.T @ rows / _CHI2_95_OF_3


def compute_length_95(covariance: Array) -> float:
    """The length that an error with `covariance` (3, 3) keeps below with 95 %; infinite where that is not finite."""
    if not np.isfinite(covariance).all():
        return math.inf
    variances = np.linalg.eigvalsh((covariance + covariance.T) / 2.0).clip(0.0)
    return math.sqrt(_compute_squared_length_95(variances)) if variances.any() else 0.0


def make_axes(rows: Array) -> Axes:
    """The rows (3, 3) as axes."""
    first, second, third = ((float(x), float(y), float(z)) for x, y, z in rows)
    return first, second, third


def _compute_squared_length_95(variances: Array) -> float:
    """The 95 % quantile of the squared length of a normal vector with `variances` (3,) along its axes.

    As of the scaled chi-squared variable with the same mean and variance (Satterthwaite, 1946), whose quantile is
    Wilson and Hilferty's (1931): within 3 %.
    """
    mean, square = float(variances.sum()), float((variances**2).sum())
    spread = 2.0 * square / (9.0 * mean**2)  # 2 / (9 degrees of freedom)
    return mean * (1.0 - spread + _NORMAL_95 * spread**0.5) ** 3


# The unit of a result's lengths, and the frame of its coordinates, which every file that is written states.

TWO_SIDED_95 = 1.96  # standard deviations to either side that hold 95 % of a normal distribution


@dataclass(frozen=True)
class Scale:
    """Whether lengths are metres, how that is known, and what coordinates count from."""

    metric: bool = False  # lengths are metres
    source: str | None = None  # of the metres, or why there are none although they were asked for
    # Of metres: a true length is at least and at most so many times the stated one, with a probability of 95 %
    interval_95: tuple[float, float] | None = None
    frame: ReferenceFrame = FIRST_CAMERA  # that all coordinates are in

    @property
    def unit(self) -> str:
        return "metres" if self.metric else "relative"

    @property
    def word(self) -> str:
        return "metric" if self.metric else "relative"

    @property
    def sentence(self) -> str:
        meaning = "metres" if self.metric else "no metric unit"
        return f"{self.word} ({meaning}{f': {self.source}' if self.source else ''})"

    def record(self) -> dict[str, object]:
        """As JSON files state it."""
        known = {"scale": self.word, "scale_source": self.source, "scale_interval_95": self.interval_95}
        return {"unit": self.unit, **known, **self.frame.record()}


RELATIVE = Scale()


def join_sentences(said: Sequence[str], longest: int = LONGEST_TEXT) -> str:
    """Joins `said` into one text of at most `longest` characters: what fits, and how many more there are."""
    for kept in range(len(said), 0, -1):
        left_out = [f"and {len(said) - kept} more"] if kept < len(said) else []
        text = "; ".join([*said[:kept], *left_out])
        if len(text) <= longest:
            return text
    return sanitize_text("; ".join(said), longest)


# Where up is in the world of a result, by an IMU.

_UNIT = 1e-3  # by which the length of a direction may differ from 1


@dataclass(frozen=True)
class Up:
    """The direction against gravity. Raises ValueError where it is none."""

    direction: tuple[float, float, float]  # of length 1, in the world
    sigma_deg: float  # standard deviation in each direction
    source: str  # in words

    def __post_init__(self) -> None:
        if not abs(math.hypot(*self.direction) - 1.0) <= _UNIT or not 0 < self.sigma_deg <= 180:
            raise ValueError(f"up must be a direction of length 1 with a sigma in degrees, got {self}")
