"""What the reconstruction tells the world: plain NumPy, so that viewers and exporters need no torch."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Annotated, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame, Intrinsics, Stamp
from splatnode.capture.messaging.messages import LARGEST, Finite
from splatnode.capture.process.text import LONGEST_NAME, LONGEST_TEXT, sanitize_text
from splatnode.recon.result.verdict import RELATIVE, Bounds, Scale, Up, Verdict, find_widest

# What the images say of depth images that came with them: that they fit, or what is wrong with them.

_LONGEST_SENTENCE = 10_000  # characters, of a report; in a message LONGEST_TEXT


class DepthCode(Enum):
    """FITS alone lets depth images count for depth; their unit counts where no other source contradicts it."""

    FITS = "FITS"
    UNTESTED = "DEPTH_UNTESTED"  # too few points of the images have a depth, or the cameras are too rough
    SHIFTED = "DEPTH_SHIFTED"  # not aligned with the images
    CONTRADICTS = "DEPTH_CONTRADICTS"  # other depths than the images tell
    SCALE = "DEPTH_SCALE"  # another unit than all other sources of metres give


@dataclass(frozen=True)
class DepthCheck:
    """The judgement on the depth images of one camera."""

    code: DepthCode  # FITS, or what is wrong
    message: str  # one sentence
    camera_id: str = ""  # empty: there is one camera
    num_points: int = 0  # of the images, that were compared
    shift_px: tuple[float, float] | None = None  # across and down, where it is why; pixels of 640 across
    shift_is_least: bool = False  # whether the search ended at `shift_px`: it is so much or more, or no shift at all
    scale_error: float | None = None  # by which depths are too large, as a share, where it is why

    def record(self) -> dict[str, object]:
        """As the report states it."""
        return {
            "code": self.code.value,
            "message": self.message,
            "camera": self.camera_id,
            "points": self.num_points,
            "shift_px": None if self.shift_px is None else list(self.shift_px),
            "shift_is_least": self.shift_is_least,
            "scale_error": self.scale_error,
        }


class StoredDepthCheck(msgspec.Struct, frozen=True):
    """A DepthCheck as the report and messages have it."""

    code: DepthCode
    message: Annotated[str, msgspec.Meta(max_length=_LONGEST_SENTENCE)]
    camera: Annotated[str, msgspec.Meta(max_length=LONGEST_NAME)] = ""
    points: Annotated[int, msgspec.Meta(ge=0, le=LARGEST)] = 0
    shift_px: tuple[Finite, Finite] | None = None
    shift_is_least: bool = False
    scale_error: Finite | None = None

    def restore(self) -> DepthCheck:
        """The judgement that it was made of."""
        return DepthCheck(
            self.code,
            self.message,
            self.camera,
            self.points,
            self.shift_px,
            shift_is_least=self.shift_is_least,
            scale_error=self.scale_error,
        )


class DepthCheckRecord(StoredDepthCheck, frozen=True, forbid_unknown_fields=True):
    """A DepthCheck in a message."""


def make_depth_check_record(check: DepthCheck) -> DepthCheckRecord:
    """The check as a message has it."""
    return DepthCheckRecord(
        check.code,
        sanitize_text(check.message, LONGEST_TEXT),
        sanitize_text(check.camera_id, LONGEST_NAME),
        check.num_points,
        check.shift_px,
        check.shift_is_least,
        check.scale_error,
    )


# What the reconstruction tells the world: plain NumPy, so that viewers and exporters need no torch.

# Landmarks: the points of a scene by which a photograph that was not in the set is placed in it.
#
# They are the points on which verified cameras agree, each with the descriptors of its features and its uncertainty,
# and what is known of the cameras that saw them.

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class KnownLenses:
    """The lenses of C cameras. Lengths in the picture count over its longer side."""

    focals: Array  # (C,)
    radials: Array  # (C, 2) radial coefficients, as recon/registration/bundle_adjustment.py has them
    shifts: Array  # (C, 2) of the principal point from the middle of the picture
    shapes: Array  # (C,) height over width


@dataclass(frozen=True, eq=False)
class Landmarks:
    """P points of a scene with D descriptors in C photographs. Lengths are in the unit of the result."""

    points: Array  # (P, 3) world
    covariances: Array  # (P, 3, 3) of the points' errors, the cameras taken as exact
    descriptors: npt.NDArray[np.uint8]  # (D, 128) as matching/features.py quantises them
    point_of: Index  # (D,) the point that a descriptor is of
    photograph_of: Index  # (D,) the photograph that it is from
    names: tuple[str, ...]  # of the C photographs
    Ts_world_camera: Array  # (C, 4, 4)
    lenses: KnownLenses
    rotation_bounds: Array  # (C,) 95 % bounds of the cameras' errors, degrees
    centre_bounds: Array  # (C,) likewise of their centres
    noise_px: float  # standard deviation of an observation's error, pixels at REFERENCE_SIDE
    unit: float = 1.0  # the median depth of the scene's points: metres where the result is metric
    metric: bool = False  # lengths are metres
    focal_bounds: Array | None = None  # (C,) 95 % bounds of the focal lengths, percent; None: an earlier file has none

    def transform(self, scale: float, rotation: Array, translation: Array, *, metric: bool = False) -> Landmarks:
        """The same in the world to which x -> scale * rotation @ x + translation leads.

        `metric` says whether its unit is the metre.
        """
        Ts_world_camera = np.tile(np.eye(4), (len(self.names), 1, 1))
        Ts_world_camera[:, :3, :3] = rotation @ self.Ts_world_camera[:, :3, :3]
        Ts_world_camera[:, :3, 3] = scale * self.Ts_world_camera[:, :3, 3] @ rotation.T + translation
        return replace(
            self,
            points=scale * self.points @ rotation.T + translation,
            covariances=scale**2 * rotation @ self.covariances @ rotation.T,
            Ts_world_camera=Ts_world_camera,
            centre_bounds=scale * self.centre_bounds,
            unit=scale * self.unit,
            metric=metric,
        )


Array32 = npt.NDArray[np.float32]
Array64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GivenCameraPose:
    """The pose that others gave for a camera, in the world of the scene, which is in metres then."""

    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    sigma_m: float  # standard deviation of its position in each direction
    sigma_deg: float  # of its orientation about each axis


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """An estimated camera, for its image at modelled size (`width` x `height`)."""

    name: str
    frame_id: int
    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    K: npt.NDArray[np.float64]  # (3, 3), centre of the top-left pixel at (0.5, 0.5)
    width: int
    height: int
    bounds: Bounds | None = None  # of its errors; None: not estimated
    captured_at: Stamp | None = None  # of its photograph; None: nobody knows
    # Estimated, of the photograph in full size: its distortion was taken out of the image, whose pinhole is K. None: K
    # is estimated of the photograph as it came, or without the distortion that was given
    lens: Intrinsics | None = None
    # Share of its pixels, 0 to 1, whose depth is multi-view consistent: a point of another view has it, too. None: not
    # known, as of a coarse preview
    consistent_depth: float | None = None
    camera_id: str = ""  # of several cameras, which one; empty: there is one
    frame_set: int | None = None  # which images were taken together with it: all that have its number. None: none
    given: GivenCameraPose | None = None  # None: no pose was given, or nothing tells where its world lies
    # As it was given, of the photograph in full size, whose distortion and other pixels than square ones were taken out
    # of the image. None: none was given, or one of a pinhole with fx = fy
    given_lens: Intrinsics | None = None

    @property
    def pose_residual(self) -> tuple[float, float] | None:
        """How far the given pose is from the estimated one, metres and degrees; None where none was given."""
        if self.given is None:
            return None
        between = np.linalg.inv(self.T_world_camera) @ self.given.T_world_camera
        cosine = np.clip((np.trace(between[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)
        return float(np.linalg.norm(between[:3, 3])), float(np.degrees(np.arccos(cosine)))

    @property
    def K_photographed(self) -> npt.NDArray[np.float64]:
        """(3, 3) of the photograph at `width` x `height` before an estimated distortion was taken out of it."""
        return self.K if self.lens is None else self.lens.resized(self.width, self.height).K


@dataclass(frozen=True, eq=False)
class GaussianArrays:
    """N Gaussians, activated: scales are lengths, opacities are in (0, 1), quats (wxyz) have unit length."""

    means: Array32  # (N, 3)
    quats: Array32  # (N, 4)
    scales: Array32  # (N, 3)
    opacities: Array32  # (N,)
    sh: Array32  # (N, B, 3)
    source_frame: npt.NDArray[np.int32]  # (N,)

    def __len__(self) -> int:
        return self.means.shape[0]

    @classmethod
    def empty(cls) -> GaussianArrays:
        """No Gaussians."""

        def zeros(*shape: int) -> Array32:
            return np.zeros(shape, np.float32)

        return cls(zeros(0, 3), zeros(0, 4), zeros(0, 3), zeros(0), zeros(0, 1, 3), np.zeros(0, np.int32))


@dataclass(frozen=True, eq=False)
class InGivenWorld:
    """How a scene lies in the world of the given poses that held its cameras: scale * rotation @ p + translation."""

    scale: float  # metres per unit
    rotation: Array64  # (3, 3)
    translation: Array64  # (3,) metres
    scale_sigma: float  # standard deviation of the logarithm of the scale
    num_poses: int  # that hold it
    from_depth: bool = False  # whether depth images gave the poses, and nobody told them


@dataclass(frozen=True, eq=False)
class OnRig:
    """The rig that a scene's cameras are on. Lengths are in the scene's unit."""

    # Camera id, T_rig_camera (4, 4), and standard deviations of its centre and of its orientation, degrees
    mounts: tuple[tuple[str, Array64, float, float], ...]
    metres_per_unit: float | None  # by a given rig; None: none tells it
    scale_sigma: float  # standard deviation of its logarithm
    num_given: int = 0  # cameras of the given rig that tell it, which have images and are believed

    def rescale(self, factor: float) -> OnRig:
        """Returns it in a world whose unit is `factor` times smaller."""
        mounts = []
        for name, T, sigma, sigma_deg in self.mounts:
            moved = T.copy()
            moved[:3, 3] *= factor
            mounts.append((name, moved, sigma * factor, sigma_deg))
        return replace(self, mounts=tuple(mounts), metres_per_unit=None)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The scene after a step of the reconstruction. The world is the first camera's frame, or that of given poses."""

    sequence: int
    verdict: Verdict
    cameras: tuple[CameraEstimate, ...]
    gaussians: GaussianArrays
    images: dict[str, npt.NDArray[np.uint8]]  # (H, W, 3) RGB by camera name, as modelled
    dropped: tuple[DroppedFrame, ...]
    iterations: int
    seconds: dict[str, float] = field(default_factory=dict)  # by stage
    budget: tuple[Mapping[str, object], ...] = ()  # modelling.BudgetHit.record of each limit that bound the final scene
    final: bool = False
    served_by: Mapping[str, str] = field(default_factory=dict)  # network or measure, by regularisation that was used
    evidence: Mapping[str, object] | None = None  # error_model.make_evidence_record; None: nothing to verify
    scale: Scale = RELATIVE  # the unit of all lengths
    given: InGivenWorld | None = None  # how it lies in the world of given poses; None: that is not known, or it does
    up: Up | None = None  # in the world; None: no IMU tells it
    rig: OnRig | None = None  # that the cameras are on; None: they are on none
    landmarks: Landmarks | None = None  # by which further photographs are placed; None: they were not gathered
    # By camera (h, w), one value for 2 x 2 pixels: z where a second photograph confirms it, else 0. Empty: not gathered
    depths: Mapping[str, npt.NDArray[np.float16]] = field(default_factory=dict)
    masked: Mapping[str, float] = field(default_factory=dict)  # share that a mask hides, by photograph that has one
    moving: Mapping[str, float] = field(default_factory=dict)  # share left out because it moved, by photograph
    gains: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # taken out of photographs: red, green, blue
    gain_sigmas: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # of their logarithms, where known
    falloffs: Mapping[str, float] = field(default_factory=dict)  # of lenses that dim their corners, by photograph
    depth_checks: tuple[
        DepthCheck, ...
    ] = ()  # what the images say of depth images, a camera each; none: there were none
    scenes: tuple[str, ...] = ()  # that it was merged of, by scene_id, where it was read from a result

    @property
    def consistent_depth(self) -> float | None:
        """The share of all cameras' pixels whose depth is multi-view consistent, 0 to 1: the mean over the cameras.

        None where it is not known of every camera.
        """
        shares = [camera.consistent_depth for camera in self.cameras]
        known = [share for share in shares if share is not None]
        return sum(known) / len(known) if known and len(known) == len(shares) else None


# Bounds as a person reads them. Numbers are rounded up, because a bound that was rounded down would not hold.

_DIGITS = 2  # significant ones
_LEAST, _MOST = 1e-9, 1e9  # numbers beyond these are told as bounds: nobody's cameras are so exact, or so wrong
_ROUNDING = 1e-9  # relative: a number that is over its digits by less is not rounded up
_LENGTHS = ((1.0, "m"), (0.01, "cm"), (0.001, "mm"))  # metres of a unit and its sign, the largest first


def format_camera_bounds(bounds: Bounds, scale: Scale) -> str:
    """The bounds of one camera, with its position in metres where `scale` is metric."""
    return _format_bounds("direction", "position", bounds, scale)


def format_widest_bounds(cameras: Sequence[CameraEstimate], scale: Scale) -> str:
    """The widest bounds of the cameras; empty where no camera has bounds."""
    worst = find_widest(camera.bounds for camera in cameras if camera.bounds is not None)
    return "" if worst is None else _format_bounds("directions", "positions", worst, scale)


def _format_bounds(direction: str, position: str, bounds: Bounds, scale: Scale) -> str:
    length = f" ({_format_length(bounds.centre)})" if scale.metric else ""
    return (
        f"{direction} to {format_rounded_up(bounds.rotation_deg)} degrees, "
        f"{position} to {format_rounded_up(bounds.centre_percent)} % of the distance to the scene{length}, "
        f"focal length to {format_rounded_up(bounds.focal_percent)} % (95 % bounds)"
    )


def _format_length(metres: float) -> str:
    unit, sign = next((each for each in _LENGTHS if metres >= each[0]), _LENGTHS[-1])
    return f"{format_rounded_up(metres / unit)} {sign}"


def format_rounded_up(value: float) -> str:
    """Returns the smallest number with two significant digits that is not below `value`; no exponent. Never raises."""
    if not (math.isfinite(value) and value > 0):
        return "0" if value == 0 else "an unknown number of"
    if value > _MOST:
        return f"more than {_MOST:.0f}"
    value = max(value, _LEAST)
    decimals = _DIGITS - 1 - math.floor(math.log10(value))
    rounded = math.ceil(value * 10.0**decimals * (1.0 - _ROUNDING)) / 10.0**decimals
    text = f"{rounded:.{max(decimals, 0)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


# What a camera must be that a stranger wrote: a rigid motion and a pinhole, in numbers that can be computed with.


MAX_COORDINATE = 1e9  # of a camera's centre, in its file's unit, and of what K holds, in pixels
MAX_SIDE = 65_535  # pixels of an image
SHORTEST_FOCAL = 1e-3  # pixels
_RIGID = 1e-2  # largest difference of a rotation times its transpose from the identity
_EXACT = 1e-6  # by which what is 0 or 1 in every such matrix may differ from it


def find_camera_problem(T_world_camera: Array, K: Array, width: int, height: int) -> str:
    """Describes what is wrong with the camera; empty where nothing is."""
    if T_world_camera.shape != (4, 4) or K.shape != (3, 3):
        return f"T_world_camera must be 4x4 and K 3x3, got {T_world_camera.shape} and {K.shape}"
    if (
        not (np.abs(T_world_camera.astype(np.float64)) <= MAX_COORDINATE).all()
        or not (np.abs(K.astype(np.float64)) <= MAX_COORDINATE).all()
    ):
        return f"T_world_camera and K must be finite, within ±{MAX_COORDINATE:g}"
    rotation = T_world_camera[:3, :3]
    turned = np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID or np.linalg.det(rotation) < 0
    if turned or not np.allclose(T_world_camera[3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=_EXACT):
        return "T_world_camera must be a rigid motion"
    if min(K[0, 0], K[1, 1]) < SHORTEST_FOCAL or not np.allclose(K[2], [0.0, 0.0, 1.0], rtol=0.0, atol=_EXACT):
        return f"K must have focal lengths of {SHORTEST_FOCAL:g} pixels or more, and 0 0 1 as its last row"
    if not np.allclose([K[0, 1], K[1, 0]], 0.0, rtol=0.0, atol=_EXACT):
        return "K must have no skew"
    if not 1 <= min(width, height) <= max(width, height) <= MAX_SIDE:
        return f"width and height must be 1 to {MAX_SIDE} pixels, got {width} x {height}"
    return ""


# What moved between the photographs, in a sentence.

LEAST = 0.03  # share of a photograph: less is in the report alone


def describe_moving(shares: Mapping[str, float]) -> str:
    """The photographs of which so much was left out that their user should know; empty where there is none."""
    large_shares = [share for share in shares.values() if share >= LEAST]
    if not large_shares:
        return ""
    least, most = f"{min(large_shares):.0%}", f"{max(large_shares):.0%}"
    each = least if least == most else f"{least} to {most}"
    of = f"{len(large_shares)} photographs" if len(large_shares) > 1 else "a photograph"
    return f"left out of {of}: what moved between them, {each} of each (report.json names them)"


# Where a Gaussian comes from, in one number, and which Gaussians two photographs have seen.
#
# Its `source_frame` is the frame_id of the keyframe whose pixels seeded it, where another keyframe confirms their
# depth; `filled(frame_id)` where none does; and SHELL for the far shell, which no frame's pixels seeded.

SHELL = -1

Source = TypeVar("Source")


def encode_unconfirmed(frame_id: int) -> int:
    """The source frame of Gaussians that this frame's pixels seeded at a depth that no other frame confirms."""
    return -2 - frame_id


def decode_frame_id(source_frame: Source) -> Source:
    """The frame_id (N,) of the keyframe that seeded each Gaussian, confirmed or not; SHELL for the far shell.

    Arrays and tensors alike.
    """
    return abs(source_frame + 1) - 1  # pyright: ignore


def find_confirmed(source_frame: npt.NDArray[np.int32]) -> npt.NDArray[np.bool_]:
    """(N,) which Gaussians began at a depth that two photographs confirm."""
    return source_frame >= 0
