"""Where a photograph that was not in the set was taken, in a finished scene; or why that cannot be said."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import LARGEST_SIDE, Intrinsics
from splatnode.capture.messaging.messages import (
    Amount,
    Finite,
    Limits,
    Message,
    Name,
    Sequential,
    SessionId,
    Text,
    WireError,
    decode_jpeg,
)
from splatnode.capture.process.text import guard_untrusted, sanitize_text
from splatnode.recon.result.message import Matrix3, Matrix4
from splatnode.recon.result.snapshot import find_camera_problem

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
    # Pixels across for one down from the middle, by which the photograph is sheared, as by a rolling shutter while the
    # camera turns; all else is of the photograph without it
    shear: float = 0.0

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
        if self.shear:
            shear = f"{100 * abs(self.shear):.1f} %, as by a rolling shutter while the camera turns"
            return f"; it is sheared by {shear}, which is taken out; focal length {focal:.4g} pixels"
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


# Where an image was taken, asked of a running node: the request with its image, and the answer.

QUERY_BYTES = 16 << 20  # of an image
QUERY_LIMITS = Limits(header_bytes=64 << 10, arrays=1, dimensions=1, total_bytes=QUERY_BYTES)
Shear = Annotated[float, msgspec.Meta(ge=-1, le=1)]
Covariance = Annotated[tuple[Finite, ...], msgspec.Meta(min_length=36, max_length=36)]


class LocateRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="locate"):
    """Asks where an image was taken; its array is the image as the bytes of a JPEG file."""

    number: Sequential  # the answer has it
    intrinsics: Intrinsics | None = None  # None: the lenses of the scene's images are tried, then any
    follows: bool = False  # the last image of this connection, near to which it was taken: it is looked for there first


class LocationRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A Located."""

    T_world_camera: Matrix4  # row by row
    K: Matrix3  # row by row
    covariance: Covariance  # row by row
    rotation_deg: Amount
    centre: Amount
    centre_percent: Amount
    focal_percent: Amount
    principal_percent: Amount
    num_points: Sequential
    metric: bool
    lens_source: LensSource
    radial: tuple[Finite, Finite]
    shear: Shear = 0.0  # pixels across for one down, which is taken out

    def __post_init__(self) -> None:
        """Raises ValueError, of which msgspec makes its own error, where nothing can be seen through it."""
        T, K = np.array(self.T_world_camera).reshape(4, 4), np.array(self.K).reshape(3, 3)
        if why := find_camera_problem(T, K, LARGEST_SIDE, LARGEST_SIDE):
            raise ValueError(why)


class RefusalRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A NotLocated."""

    code: Reason
    message: Text
    advice: Text


class LocateAnswer(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="location"):
    """The place where the image was taken, in which world, and whether that may still change."""

    number: Sequential  # of the request
    scene_id: Name  # `none` where there is no scene
    session: SessionId  # of recon.scene, and
    scene_sequence: Sequential  # the number of its message that shows the scene
    revision: Sequential  # of the scene's world: withdrawn once the heartbeat tells another one
    provisional: bool  # the scene grows: its bounds are wider, and it will be made afresh
    why: Text = ""  # there is neither of the next two
    location: LocationRecord | None = None
    refusal: RefusalRecord | None = None


def decode_query_image(message: Message[LocateRequest]) -> npt.NDArray[np.uint8]:
    """(H, W, 3) RGB. Raises WireError where the message has no JPEG."""
    with guard_untrusted(WireError, "a query image"):
        if len(message.arrays) != 1:
            raise WireError(f"a request has one array, the bytes of a JPEG file; got {len(message.arrays)}")
        return decode_jpeg(message.arrays[0], LARGEST_SIDE)


def make_outcome_records(found: Located | NotLocated) -> dict[str, LocationRecord | RefusalRecord]:
    """The fields of an answer that hold what was found."""
    if isinstance(found, NotLocated):
        return {"refusal": RefusalRecord(found.code, sanitize_text(found.message), sanitize_text(found.advice))}
    claim = found.claim
    return {
        "location": LocationRecord(
            T_world_camera=tuple(found.T_world_camera.ravel().tolist()),
            K=tuple(found.K.ravel().tolist()),
            covariance=tuple(found.covariance.ravel().tolist()),
            rotation_deg=float(claim.rotation_deg),
            centre=float(claim.centre),
            centre_percent=float(claim.centre_percent),
            focal_percent=float(claim.focal_percent),
            principal_percent=float(claim.principal_percent),
            num_points=found.num_points,
            metric=found.metric,
            lens_source=found.lens,
            radial=(float(found.distortion[0]), float(found.distortion[1])),
            shear=float(found.shear),
        )
    }


def parse_outcome(answer: LocateAnswer) -> Located | NotLocated | None:
    """Returns what was found; None where the answer says why nothing was looked for."""
    if answer.refusal is not None:
        return NotLocated(answer.refusal.code, answer.refusal.message, answer.refusal.advice)
    if (record := answer.location) is None:
        return None
    claim = LocalizationBounds(
        record.rotation_deg, record.centre, record.centre_percent, record.focal_percent, record.principal_percent
    )
    return Located(
        np.array(record.T_world_camera).reshape(4, 4),
        np.array(record.K).reshape(3, 3),
        np.array(record.covariance).reshape(6, 6),
        claim,
        record.num_points,
        record.metric,
        record.lens_source,
        record.radial,
        record.shear,
    )
