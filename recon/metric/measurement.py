"""What single sources say of a scene's unit, and what they say together.

An error of a length is a factor, so that sources are compared and averaged by the logarithms of what they say.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.aruco import DICTIONARIES
from splatnode.capture.frame import MOTION_DRIFT, MOTION_SIGMA_DEG, Gravity
from splatnode.recon.geometry import distortion, undistort_rays
from splatnode.recon.registration.registration import radial_of
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.verdict import TWO_SIDED_95, FrameChoice

MAX_DEVIATION = 3.0  # standard deviations by which two sources may differ


@dataclass(frozen=True)
class Measurement:
    """The unit by one source."""

    metres_per_unit: float
    sigma: float  # standard deviation of its logarithm
    source: str

    @property
    def interval_95(self) -> tuple[float, float]:
        """The 95 % interval of the factor from a stated length in metres to the true one."""
        return math.exp(-TWO_SIDED_95 * self.sigma), math.exp(TWO_SIDED_95 * self.sigma)


def combine_measurements(measurements: Sequence[Measurement]) -> Measurement | str:
    """The mean of logarithms, each weighed by the inverse of its variance; of one source, that source.

    Where two sources contradict each other there is no mean, but a sentence that names the two that do most. Which of
    them is wrong cannot be known. Raises ValueError for no source.
    """
    if not measurements:
        raise ValueError("the unit must have a source, got none")
    if len(measurements) == 1:
        return measurements[0]
    first, second = max(combinations(measurements, 2), key=lambda pair: _compute_deviation(*pair))
    if _compute_deviation(first, second) > MAX_DEVIATION:
        ratio = max(first.metres_per_unit, second.metres_per_unit) / min(first.metres_per_unit, second.metres_per_unit)
        return (
            f"{first.source}, contradicts {second.source}: the scales differ by {100 * (ratio - 1):.2g} %, which is "
            f"{_compute_deviation(first, second):.2g} standard deviations; measure both again"
        )
    weights = [each.sigma**-2 for each in measurements]
    logs = [math.log(each.metres_per_unit) for each in measurements]
    mean = sum(weight * log for weight, log in zip(weights, logs, strict=True)) / sum(weights)
    return Measurement(math.exp(mean), sum(weights) ** -0.5, "; ".join(each.source for each in measurements))


def _compute_deviation(first: Measurement, second: Measurement) -> float:
    """How many standard deviations of their difference two sources are apart."""
    difference = math.log(first.metres_per_unit) - math.log(second.metres_per_unit)
    return abs(difference) / math.hypot(first.sigma, second.sigma)


# What is known of a scene's size in metres, as it is configured.

_MAX_METRES = 1_000_000  # of a baseline
_LARGEST_MARKER = 100.0  # metres


class Baseline(NamedTuple):
    """A measured distance between two cameras."""

    first: str  # photograph
    second: str
    metres: float


class MetricConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The size of a scene in metres and its frame of reference, as they are configured."""

    # Of all coordinates of results: first_camera, base (the robot's, at the first image; needs T_base_camera and
    # metres), odometry (that of given poses or motions), upright (at the first camera, z up by gravity or the floor).
    # Nothing: the first camera's, or that of given poses. base_link and odom mean the same. --frame sets it
    frame: FrameChoice | None = None
    # Down in the first image's camera: x right, y down, z forward; nothing: images or the floor tell. --gravity sets it
    gravity: tuple[float, float, float] | None = None
    baseline: Baseline | None = None  # two photographs and the metres between their cameras
    further_baselines: tuple[Baseline, ...] = ()  # more of them: they make the scale surer, and check one another
    # Standard deviation of each measured distance, as a share of it
    baseline_sigma: Annotated[float, msgspec.Meta(gt=0, le=0.5)] = 0.01
    # Side of the black square of printed markers in the scene, metres; nothing: none are looked for. --marker sets it
    marker_size_m: Annotated[float, msgspec.Meta(gt=0, le=_LARGEST_MARKER)] | None = None
    # Standard deviation of that side as it was measured, metres: what a ruler can tell
    marker_size_sigma_m: Annotated[float, msgspec.Meta(ge=0, le=_LARGEST_MARKER)] = 0.0005
    marker_dictionary: str = "4X4_50"  # of OpenCV's ArUco dictionaries, as `splatnode marker` prints, or APRILTAG_36h11
    # Standard deviation of given poses that come without: of each position in each direction, metres
    poses_sigma_m: Annotated[float, msgspec.Meta(gt=0, le=_MAX_METRES)] = 0.01
    poses_sigma_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = 2.0  # and of each orientation about each axis
    # Standard deviation of how far given poses have drifted at the end of the way, as a share of it; 0: not at all
    poses_drift: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.02
    # Standard deviation of the error that all motions share, as a share of their length, as of the wheels' radius
    odometry_scale_sigma: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.01
    # Standard deviation of a motion that comes without one: in each direction, as a share of its length
    odometry_drift: Annotated[float, msgspec.Meta(gt=0, le=0.5)] = MOTION_DRIFT
    odometry_sigma_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = MOTION_SIGMA_DEG  # and about each axis, degrees
    # Metres between the cameras of given stereo pairs; nothing: none are given
    stereo_baseline_m: Annotated[float, msgspec.Meta(gt=0, le=_MAX_METRES)] | None = None
    # Standard deviation of that distance, metres
    stereo_baseline_sigma_m: Annotated[float, msgspec.Meta(ge=0, le=_MAX_METRES)] = 0.0003
    depth_network: bool = False  # ask Depth Anything V2 Metric Indoor Small, where its weights are
    # Standard deviation of the network's error in a place, all views alike, as a share
    depth_network_sigma: Annotated[float, msgspec.Meta(gt=0, le=0.5)] = 0.15

    @property
    def poses_sigmas(self) -> tuple[float, float]:
        """Metres and degrees."""
        return self.poses_sigma_m, self.poses_sigma_deg

    @property
    def baselines(self) -> tuple[Baseline, ...]:
        return (*(() if self.baseline is None else (self.baseline,)), *self.further_baselines)

    def __post_init__(self) -> None:
        if self.gravity is not None:
            Gravity(self.gravity)  # raises ValueError where it is no direction
        if self.marker_dictionary not in DICTIONARIES:
            raise ValueError(
                f"a marker's dictionary must be one of {', '.join(DICTIONARIES)}; got {self.marker_dictionary[:40]!a}"
            )
        if self.marker_size_m is not None and self.marker_size_sigma_m >= 0.5 * self.marker_size_m:
            raise ValueError(
                f"a marker's side must be known to less than half of itself, got {self.marker_size_m:g} m with a "
                f"standard deviation of {self.marker_size_sigma_m:g} m"
            )
        for baseline in self.baselines:
            if not 1 / _MAX_METRES <= baseline.metres <= _MAX_METRES or baseline.first == baseline.second:
                raise ValueError(
                    "a baseline must be two different photographs and a positive distance in metres, up to "
                    f"{_MAX_METRES}, got {', '.join(map(str, baseline))}"
                )


# The cameras of a scene as single measurements see through them: the registered ones with their lens, where known.

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MetricView:
    """A camera. Lengths in its picture count over the picture's longer side."""

    T_world_camera: Array  # (4, 4)
    focal: float
    radial: Array  # (2,) radial coefficients, as recon/registration/bundle_adjustment.py has them
    shift: Array  # (2,) of the principal point from the middle of the picture
    bound: float  # 95 % bound of the centre's error, in the scene's unit; 0 where none is known

    @property
    def centre(self) -> Array:
        return self.T_world_camera[:3, 3]

    def unproject(self, pixels: Array, width: int, height: int) -> Array:
        """(M, 2) at depth 1 of pixels (M, 2) in a picture of this size."""
        side = max(width, height)
        distorted = ((pixels - np.array([width, height]) / 2.0) / side - self.shift) / self.focal
        return undistort_rays(distorted, self.radial)

    def project(self, points: Array, width: int, height: int) -> Array:
        """(M, 2) in a picture of this size of world points (M, 3); not a number behind the camera."""
        in_camera = (points - self.centre) @ self.T_world_camera[:3, :3]
        depth = np.where(in_camera[:, 2] > 0, in_camera[:, 2], np.nan)
        rays = in_camera[:, :2] / depth[:, None]
        distorted = self.focal * distortion((rays**2).sum(1), self.radial)[:, None] * rays + self.shift
        return max(width, height) * distorted + np.array([width, height]) / 2.0


def make_metric_views(snapshot: Snapshot) -> Mapping[str, MetricView]:
    """Makes the views by image name, in their order: as registered where that is known, else as published."""
    bounds = {camera.name: camera.bounds.centre if camera.bounds else 0.0 for camera in snapshot.cameras}
    found = {}
    for camera in sorted(snapshot.cameras, key=lambda camera: camera.frame_id):
        side, size = max(camera.width, camera.height), np.array([camera.width, camera.height])
        K = camera.K_photographed
        shift = (K[:2, 2] - size / 2.0) / side
        radial = np.array(radial_of(camera.lens))
        found[camera.name] = MetricView(
            camera.T_world_camera, float(K[0, 0]) / side, radial, shift, bounds[camera.name]
        )
    landmarks = snapshot.landmarks
    if landmarks is None:
        return found
    lenses = landmarks.lenses
    for index, name in enumerate(landmarks.names):
        if name in found:
            lens = float(lenses.focals[index]), lenses.radials[index], lenses.shifts[index]
            found[name] = MetricView(landmarks.Ts_world_camera[index], *lens, bounds[name])
    return found


def compute_scale_sigma(views: Sequence[MetricView]) -> float:
    """Standard deviation of log length that the cameras' bounds allow, by the two that are farthest apart; 0 of one."""
    if len(views) < 2:
        return 0.0
    first, second = max(combinations(views, 2), key=lambda pair: float(np.linalg.norm(pair[0].centre - pair[1].centre)))
    apart = float(np.linalg.norm(first.centre - second.centre))
    return math.hypot(first.bound, second.bound) / TWO_SIDED_95 / max(apart, 1e-12)


# The unit by the measured distance of two cameras.


def estimate_scale_from_distance(
    cameras: Sequence[CameraEstimate], baseline: Baseline, sigma: float
) -> Measurement | str:
    """The unit, or a sentence why these cameras do not give it.

    `sigma` is the standard deviation of the measured distance, as a share of it. To its error comes that of the
    cameras' distance in the scene, by their bounds.
    """
    known = {camera.name: camera for camera in cameras}
    missing = [name for name in baseline[:2] if name not in known]
    if missing:
        return f"the baseline's photograph {missing[0]} is not among the cameras of the scene"
    first, second = (known[name] for name in baseline[:2])
    distance = float(np.linalg.norm(first.T_world_camera[:3, 3] - second.T_world_camera[:3, 3]))
    source = f"{baseline.metres:g} m between {baseline.first} and {baseline.second}"
    bound = math.hypot(*(camera.bounds.centre if camera.bounds else 0.0 for camera in (first, second)))
    if distance <= bound:
        return f"{source} were given, but the photographs do not tell these two cameras apart"
    of_scene = bound / TWO_SIDED_95 / distance
    return Measurement(baseline.metres / distance, math.hypot(sigma, of_scene), source)
