"""The frame of reference of a result: what its coordinates count from, and how that is known.

Names in the field's words; those of ROS (REP 105) are taken as aliases. Axes of a robot's frames are REP 103's: x
forward, y left, z up. That of the first camera is OpenCV's: x right, y down, z forward.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

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
