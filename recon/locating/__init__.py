"""Where a photograph that was not in the set was taken, in a finished scene; or why that cannot be said."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

NORMAL_95 = 1.96  # standard deviations within which 95 % of a normal distribution lie


class Reason(str, Enum):
    """Why a photograph was not placed."""

    NOT_FOUND = "NOT_FOUND"  # no more agrees with the scene than chance explains
    ONE_PATCH = "ONE_PATCH"  # all that agrees lies in one spot
    ELSEWHERE = "ELSEWHERE"  # another place in the scene explains it nearly as well
    INCONSISTENT = "INCONSISTENT"  # its parts say different things
    MIRRORED = "MIRRORED"  # turned left to right it looks more like the scene
    LENS = "LENS"  # it takes a lens that no camera has
    UNCERTAIN = "UNCERTAIN"  # where it was taken is known too roughly


class LensSource(str, Enum):
    """The lens with which an image was placed."""

    SCENE = "scene"  # one of the lenses of the scene's own images
    GIVEN = "given"  # the lens that was given
    EXIF = "exif"  # the focal length that EXIF or an angle of view states, refined
    FREE = "free"  # its own, estimated from its points: nothing was known, or they contradict what was


@dataclass(frozen=True)
class LocalizationBounds:
    """How wrong a placed camera may be: each bound holds for 95 % of them, in the world of the result."""

    rotation_deg: float  # degrees
    centre: float  # in the unit of the result: metres where it is metric
    centre_percent: float  # the same, of the distance to the scene: the median depth of its points
    focal_percent: float  # of the focal lengths across and down
    principal_percent: float = 0.0  # of the principal point, over the longer side of the image


@dataclass(frozen=True, eq=False)
class Located:
    """The camera of a photograph in the world of a result. The camera's x is right, y down, z forward."""

    T_world_camera: Array  # (4, 4): p_world = T_world_camera @ p_camera
    K: Array  # (3, 3) for the photograph at full size, centre of the top-left pixel at (0.5, 0.5)
    covariance: Array  # (6, 6) of a small motion in the camera's frame: shift (result's unit), then turn (radians)
    claim: LocalizationBounds  # how wrong it may be
    num_points: int  # of the scene that agree with it
    metric: bool  # lengths are metres
    lens: LensSource = LensSource.SCENE  # with which it was placed
    distortion: tuple[float, float] = (0.0, 0.0)  # k1, k2 of that lens; (0, 0): a pinhole

    @property
    def sentence(self) -> str:
        """Returns where the camera is, and how sure that is, in one line."""
        x, y, z = self.T_world_camera[:3, 3]
        unit, claim = " m" if self.metric else "", self.claim
        length = f"{claim.centre:.2g} m" if self.metric else f"{claim.centre_percent:.2g} % of the distance"
        return (
            f"placed at ({x:.4g}, {y:.4g}, {z:.4g}){unit}, known to {claim.rotation_deg:.2g} degrees and {length}; "
            f"{self.num_points} points agree{self._lens_sentence}"
        )

    @property
    def _lens_sentence(self) -> str:
        if self.lens is not LensSource.FREE:
            return ""
        focal, percent = self.K[0, 0], self.claim.focal_percent
        return f"; its lens is its own, no known one: focal length {focal:.4g} pixels, known to {percent:.2g} %"


@dataclass(frozen=True)
class NotLocated:
    """Why a photograph was not placed, and what to do."""

    code: Reason  # NOT_FOUND, ONE_PATCH, ELSEWHERE, INCONSISTENT, MIRRORED, LENS or UNCERTAIN
    message: str  # why, in a sentence
    advice: str  # what to do

    @property
    def sentence(self) -> str:
        return f"refused: {self.code.value}: {self.message} {self.advice}"
