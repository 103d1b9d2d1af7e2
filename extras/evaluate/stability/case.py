"""What a row of the matrix gives for one seed: photographs, what is true about them, and what is asked."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.extras.evaluate.dataset import TrueCamera
from splatnode.extras.evaluate.protocol import CameraErrors, compare_cameras
from splatnode.extras.evaluate.stability.perturbations import Sampler, TrialImage
from splatnode.recon.config import PREVIEW, ReconstructionConfig
from splatnode.recon.geometry import Similarity, align_cameras, angles_deg, compute_rms_radius, umeyama
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.verdict import Bounds, Code

Source = Callable[[], Iterable[Frame | DroppedFrame]]
World = Mapping[str, TrueCamera]  # by the name of the frame

# The verdict stands before the first step of the optimiser, so that few steps at a small size ask the same question.
# They leave the cameras as they were judged: a handful of steps would move them without improving them.
_STILL = replace(PREVIEW, checkpoints=(), refine_poses=False)
LIGHT = ReconstructionConfig(size=320, preview=replace(_STILL, iterations=2), optimize=replace(_STILL, iterations=6))


_WHOLE = (Code.OK, Code.EXPOSURE_SHIFT)  # a scene of all frames: recorded photographs differ in exposure too


class Demand(enum.Enum):
    ACCEPT = "accept"  # a refusal is a false refusal
    REFUSE = "refuse"
    EITHER = "either"  # nobody could tell in advance: a refusal is as good as a right answer


@dataclass(frozen=True)
class ProbeResult:
    """The measurements of a row besides the verdict; `held` tells whether they are within its limits."""

    values: Mapping[str, float]
    held: bool


Probe = Callable[[Snapshot, ReconstructionConfig], ProbeResult]


@dataclass(frozen=True, eq=False)
class TrialCase:
    """`source`, `config` and `probe` are sent to another process, so they hold nothing but data and module functions.

    `worlds` are the true cameras of frames that belong together: a published scene is right if all its cameras are of
    one world and agree with it. Frames in no world may be in no scene.
    """

    note: str  # made by `describe_case`
    source: Source
    demand: Demand
    codes: frozenset[Code]  # verdicts that describe these frames
    worlds: tuple[World, ...] = ()
    config: ReconstructionConfig = LIGHT
    probe: Probe | None = None  # runs where splatnode has published a scene
    stream: bool = False  # the frames come one at a time


@dataclass(frozen=True)
class MatrixRow:
    """`number` is that of the matrix in the project's notes; several rows may share one."""

    number: int
    name: str
    make: Callable[[Sampler], TrialCase]


def row(number: int, name: str) -> Callable[[Callable[[Sampler], TrialCase]], MatrixRow]:
    """Makes the decorated function a row of the matrix."""
    return partial(MatrixRow, number, name)


def make_frames(photos: Sequence[TrialImage]) -> tuple[Frame, ...]:
    """Makes what a reconstruction gets. Raises ValueError where two images have one name."""
    names = [photo.name for photo in photos]
    if len(set(names)) < len(names):
        raise ValueError(f"photographs must have different names, got {', '.join(names)}")
    return tuple(Frame(i, photo.name, i, photo.image, photo.intrinsics) for i, photo in enumerate(photos))


def make_batch_source(photos: Sequence[TrialImage]) -> Source:
    return partial(list, make_frames(photos))


def make_stream_source(photos: Sequence[TrialImage]) -> Source:
    return partial(iter, make_frames(photos))


def make_world(photos: Sequence[TrialImage]) -> World:
    """The true cameras of `photos` as one world."""
    return {photo.name: photo.camera for photo in photos if photo.camera is not None}


def describe_case(photos: Sequence[TrialImage], note: str) -> str:
    """The note of a case: the places, the number of frames, and what was done to them."""
    places = " and ".join(dict.fromkeys(photo.place for photo in photos if photo.place)) or "made up"
    return f"{places}, {len(photos)} frames" + (f": {note}" if note else "")


def make_accept_case(photos: Sequence[TrialImage], note: str, *codes: Code, probe: Probe | None = None) -> TrialCase:
    """Photographs that are enough for a scene. Besides `codes`, OK is always fitting, and so is a change of light."""
    fitting = frozenset((*_WHOLE, *codes))
    return TrialCase(
        describe_case(photos, note),
        make_batch_source(photos),
        Demand.ACCEPT,
        fitting,
        (make_world(photos),),
        probe=probe,
    )


def make_refuse_case(photos: Sequence[TrialImage], note: str, *codes: Code) -> TrialCase:
    """Photographs that are not enough: a refusal is right, and a scene that is published is compared with the truth."""
    return TrialCase(
        describe_case(photos, note), make_batch_source(photos), Demand.REFUSE, frozenset(codes), (make_world(photos),)
    )


def make_either_case(photos: Sequence[TrialImage], note: str, *codes: Code) -> TrialCase:
    """Photographs that may or may not be enough."""
    fitting = frozenset((*_WHOLE, Code.OK_PARTIAL, *codes))
    return TrialCase(
        describe_case(photos, note), make_batch_source(photos), Demand.EITHER, fitting, (make_world(photos),)
    )


# How wrong each camera is, and whether that is within what was claimed of it.

Array = npt.NDArray[np.float64]

RIGHT_ROTATION_DEG, RIGHT_SPREAD_PCT = 2.0, 5.0
BOUNDS_WIDENED = 2.5  # times a 95 % bound: beyond, the claim was false
GROSS_ROTATION_DEG, GROSS_CENTRE_PCT = 5.0, 10.0
ROUGH = "OK_ROUGH"  # the verdict that says that the cameras are known roughly
_HUGE = 1e9  # stands for what is not finite: JSON has no infinity
_ROUNDING = 1e-6  # degrees and percent: cameras that are given exactly are found with this error


@dataclass(frozen=True)
class FiniteBounds:
    """The 95 % bounds of a camera, as recon/result/verdict.py has them; what is not finite is very large."""

    rotation_deg: float
    centre_percent: float  # of the distance to the scene
    focal_percent: float


def make_finite_bounds(bounds: Bounds) -> FiniteBounds:
    values = bounds.rotation_deg, bounds.centre_percent, bounds.focal_percent
    return FiniteBounds(*(value if math.isfinite(value) else _HUGE for value in values))


@dataclass(frozen=True)
class CameraError:
    """The errors of one camera after alignment. Centres are None where no true camera moves."""

    name: str
    rotation_deg: float  # after the best common rotation
    centre_pct: float | None  # of the distance to the scene, which is the unit of the estimated world
    spread_pct: float | None  # of the true centres' RMS distance from their mean
    focal_pct: float
    bounds: FiniteBounds | None = None  # what was claimed; None: nothing

    @property
    def right(self) -> bool:
        return (
            self.rotation_deg < RIGHT_ROTATION_DEG
            and self.spread_pct is not None
            and self.spread_pct < RIGHT_SPREAD_PCT
        )

    @property
    def is_far(self) -> bool:
        """Beyond 5 degrees or 10 % of the distance."""
        return self.rotation_deg > GROSS_ROTATION_DEG or (self.centre_pct or 0.0) > GROSS_CENTRE_PCT

    def is_wrong(self, rough: bool) -> bool:
        """Beyond 2.5 times a bound; or beyond 5 degrees or 10 % of the distance without a word that it is rough.

        A camera of which nothing was claimed is wrong beyond 5 degrees or 10 % of the centres' spread.
        """
        if self.centre_pct is None or self.spread_pct is None:
            return True
        if self.bounds is None:
            return self.rotation_deg > GROSS_ROTATION_DEG or self.spread_pct > GROSS_CENTRE_PCT
        if not rough and self.is_far:
            return True
        return any(error > BOUNDS_WIDENED * bound + _ROUNDING for error, bound in self.pair_with_bounds().values())

    def pair_with_bounds(self) -> dict[str, tuple[float, float]]:
        """Error and 95 % bound of the rotation (degrees), the centre and the focal length (%), where claimed."""
        if self.bounds is None or self.centre_pct is None:
            return {}
        return {
            "rotation": (self.rotation_deg, self.bounds.rotation_deg),
            "centre": (self.centre_pct, self.bounds.centre_percent),
            "focal": (self.focal_pct, self.bounds.focal_percent),
        }


def has_only_right_cameras(errors: Sequence[CameraError]) -> bool:
    """Whether there are at least two cameras, and each is within 2 degrees and 5 % of the centres' spread."""
    return len(errors) >= 2 and all(error.right for error in errors)


def measure_camera_errors(
    cameras: Sequence[CameraEstimate], truth: Mapping[str, TrueCamera]
) -> tuple[CameraError, ...]:
    """The errors of cameras that all have a true one; none for fewer than two, which nothing can be aligned by.

    Rotations are compared after the best common rotation, centres after Umeyama's similarity. Of two cameras the
    centres always fit that, so they are compared after the similarity that turns the cameras onto each other. Where
    one camera is not finite, nothing can be aligned, and all errors are as large as can be.
    """
    if len(cameras) < 2:
        return ()
    if not _is_finite(cameras):
        return tuple(CameraError(camera.name, 180.0, _HUGE, _HUGE, _HUGE) for camera in cameras)
    true = [truth[camera.name] for camera in cameras]
    Ts = np.stack([camera.T_world_camera for camera in cameras])
    Ts_true = np.stack([camera.T_world_camera for camera in true])
    turned = align_cameras(Ts, Ts_true)
    rotations = angles_deg(turned.rotation @ Ts[:, :3, :3], Ts_true[:, :3, :3])
    apart = compute_rms_radius(Ts_true[:, :3, 3])
    moves = apart > 1e-9 * (1.0 + float(np.abs(Ts_true[:, :3, 3]).max()))
    common = turned if len(cameras) == 2 or not moves else umeyama(Ts[:, :3, 3], Ts_true[:, :3, 3])
    distances = np.linalg.norm(common(Ts[:, :3, 3]) - Ts_true[:, :3, 3], axis=1)
    return tuple(
        CameraError(
            name=camera.name,
            rotation_deg=float(rotation),
            centre_pct=_compute_percent_of_distance(float(distance), common) if moves else None,
            spread_pct=100.0 * float(distance) / apart if moves else None,
            focal_pct=_compute_focal_pct(camera, one),
            bounds=None if camera.bounds is None else make_finite_bounds(camera.bounds),
        )
        for camera, one, rotation, distance in zip(cameras, true, rotations, distances, strict=True)
    )


def measure_set_errors(cameras: Sequence[CameraEstimate], truth: Mapping[str, TrueCamera]) -> CameraErrors:
    """The errors of all cameras together, each of which has a true one; None each where a camera is not finite."""
    if not _is_finite(cameras):
        return CameraErrors(None, None, None, None, None)
    true = [truth[camera.name] for camera in cameras]
    Ks = [each.K_for(camera.width, camera.height) for each, camera in zip(true, cameras, strict=True)]
    return compare_cameras(
        np.array([camera.T_world_camera for camera in cameras]).reshape(-1, 4, 4),
        np.array([each.T_world_camera for each in true]).reshape(-1, 4, 4),
        np.array([camera.K_photographed for camera in cameras]).reshape(-1, 3, 3),
        np.array(Ks).reshape(-1, 3, 3),
    )


def _is_finite(cameras: Sequence[CameraEstimate]) -> bool:
    return all(np.isfinite(camera.T_world_camera).all() and np.isfinite(camera.K).all() for camera in cameras)


def _compute_percent_of_distance(distance: float, similarity: Similarity) -> float:
    """A distance in the true world, in percent of the unit of the estimated one."""
    return min(100.0 * distance / similarity.scale, _HUGE) if similarity.scale > 0 else _HUGE


def _compute_focal_pct(camera: CameraEstimate, true: TrueCamera) -> float:
    K, K_true = camera.K_photographed, true.K_for(camera.width, camera.height)
    return 100.0 * abs(math.sqrt(K[0, 0] * K[1, 1] / (K_true[0, 0] * K_true[1, 1])) - 1.0)


# Whether an answer was right: the published cameras against the truth, and the verdict against what was asked.


class Outcome(enum.Enum):
    ACCEPTED = "accepted"  # published, and right
    FALSE_ACCEPT = "false_accept"  # published, and wrong
    REFUSED = "refused"  # for a reason that fits
    REFUSED_OTHERWISE = "refused_otherwise"  # for another reason
    FALSE_REFUSE = "false_refuse"  # though the photographs are enough
    FAILED = "failed"  # no answer: an exception, a crash, or out of time

    @property
    def right(self) -> bool:
        return self in (Outcome.ACCEPTED, Outcome.REFUSED, Outcome.REFUSED_OTHERWISE)


@dataclass(frozen=True)
class Score:
    """How cameras compare with the truth; errors are None where the truth does not tell."""

    right: bool  # of one world, and none of them wrong
    rotation_error_deg: float | None  # the largest of any relative rotation
    centre_error_pct: float | None  # RMS, of the true centres' spread
    exact: bool = False  # of one world, and each camera within 2 degrees and 5 % of the spread
    errors: tuple[CameraError, ...] = ()  # of the cameras of the world that has most of them


def score_cameras(cameras: Sequence[CameraEstimate], worlds: Sequence[World], rough: bool = False) -> Score:
    """Right if all `cameras` are of one world, at least two of them apart, and none is wrong.

    Wrong is a camera beyond 2.5 times one of its 95 % bounds; or, unless the verdict says that the cameras are known
    roughly (`rough`), one beyond 5 degrees or 10 % of the distance to the scene. Other methods claim nothing: there a
    camera is wrong beyond 5 degrees or 10 % of the centres' spread, which is more lenient than 2 degrees and 1.5 %,
    by which all methods were judged as long as a verdict had limits instead of bounds.
    """
    here = max(worlds, key=lambda w: sum(c.name in w for c in cameras), default={})
    known = [camera for camera in cameras if camera.name in here]
    if len(known) < 2:
        return Score(False, None, None)
    whole, errors = measure_set_errors(known, here), measure_camera_errors(known, here)
    together = len(known) == len(cameras)
    right = together and not any(error.is_wrong(rough) for error in errors)
    return Score(right, whole.rotation_pair_deg, whole.centre_pct, together and has_only_right_cameras(errors), errors)


def classify_outcome(demand: Demand, published: bool, published_right: bool, code_fits: bool) -> Outcome:
    """A wrong scene that is published is a false accept whatever was asked."""
    if published:
        return Outcome.ACCEPTED if published_right else Outcome.FALSE_ACCEPT
    if demand is Demand.ACCEPT:
        return Outcome.FALSE_REFUSE
    return Outcome.REFUSED if code_fits else Outcome.REFUSED_OTHERWISE
