"""What single sources say of a scene's unit, and what they say together.

An error of a length is a factor, so that sources are compared and averaged by the logarithms of what they say.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Annotated, NamedTuple

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from splatnode.capture.aruco import DICTIONARIES
from splatnode.capture.frame import MOTION_DRIFT, MOTION_SIGMA_DEG, DroppedFrame, Frame, Gravity
from splatnode.capture.lenses import undistort_frame
from splatnode.capture.process.text import format_length
from splatnode.recon.geometry import distortion, undistort_rays
from splatnode.recon.keyframes import REFERENCE_SIDE
from splatnode.recon.registration.multiview_geometry import largest_angles, triangulate
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
    # Standard deviation of a motion that comes without one, as in Python's Session (a Publisher sends one with each):
    # in each direction, as a share of its length
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
    bound_deg: float = 0.0  # and of the orientation's, degrees
    skew: float = 0.0  # how far a row moves across for one down, at depth 1

    @property
    def centre(self) -> Array:
        return self.T_world_camera[:3, 3]

    def unproject(self, pixels: Array, width: int, height: int) -> Array:
        """(M, 2) at depth 1 of pixels (M, 2) in a picture of this size."""
        side = max(width, height)
        distorted = ((pixels - np.array([width, height]) / 2.0) / side - self.shift) / self.focal
        distorted = distorted - np.outer(distorted[:, 1], [self.skew, 0.0])
        return undistort_rays(distorted, self.radial)

    def project(self, points: Array, width: int, height: int) -> Array:
        """(M, 2) in a picture of this size of world points (M, 3); not a number behind the camera."""
        in_camera = (points - self.centre) @ self.T_world_camera[:3, :3]
        depth = np.where(in_camera[:, 2] > 0, in_camera[:, 2], np.nan)
        rays = in_camera[:, :2] / depth[:, None]
        distorted = distortion((rays**2).sum(1), self.radial)[:, None] * rays
        sheared = distorted + np.outer(distorted[:, 1], [self.skew, 0.0])
        return max(width, height) * (self.focal * sheared + self.shift) + np.array([width, height]) / 2.0


def make_metric_views(snapshot: Snapshot) -> Mapping[str, MetricView]:
    """Makes the views by image name, in their order: as registered where that is known, else as published."""
    bounds = {
        camera.name: (camera.bounds.centre, camera.bounds.rotation_deg) if camera.bounds else (0.0, 0.0)
        for camera in snapshot.cameras
    }
    found = {}
    for camera in sorted(snapshot.cameras, key=lambda camera: camera.frame_id):
        side, size = max(camera.width, camera.height), np.array([camera.width, camera.height])
        K = camera.K_photographed
        shift = (K[:2, 2] - size / 2.0) / side
        radial = np.array(radial_of(camera.lens))
        found[camera.name] = MetricView(
            camera.T_world_camera, float(K[0, 0]) / side, radial, shift, *bounds[camera.name], float(K[0, 1] / K[0, 0])
        )
    landmarks = snapshot.landmarks
    if landmarks is None:
        return found
    lenses = landmarks.lenses
    for index, name in enumerate(landmarks.names):
        if name in found:
            lens = float(lenses.focals[index]), lenses.radials[index], lenses.shifts[index]
            found[name] = MetricView(landmarks.Ts_world_camera[index], *lens, *bounds[name], found[name].skew)
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


# The unit by printed markers of known size: a square that several cameras see is so large in the scene.

# Where the corners of a printed marker are, to hundredths of a pixel: the marker as it must look is fitted to it.
#
# All edges of all its bits are used. The fit has the corners, the blur, and how grey levels mix at an edge (a camera's
# gamma and a printer's ink make black fields look smaller or larger than they are); black, white and a slope of the
# light are solved for at each step.

Grey = npt.NDArray[np.float32]  # (H, W)

_AS_FITTED_PX = 64.0  # longest side of a marker: larger ones are shrunk, and known well enough
_MARGIN = 0.5  # of a bit: the white around the marker that is compared
_FINE = 4  # samples a pixel, across and down
_STEPS, _HALVINGS, _SETTLED_PX = 12, 4, 2e-3
_BLURS_PX = (0.25, 2.5)  # least and most standard deviation
_LOG_SIGMA = 0.7  # of the prior of blur and mixing
_FIRST_BLUR_PX = 0.6
_NUDGES = np.full(10, 0.05)  # of the parameters, for derivatives: pixels, and logarithms
_NUM_PARAMETERS = 14  # with the light's four
_FLOOR_PX = 0.03  # standard deviation of a corner that is added: paper is not quite flat, a lens not quite known


@dataclass(frozen=True, eq=False)
class Corners:
    """The corners of a marker's black square: left upper, right upper, right lower, left lower, as it is printed."""

    pixels: Array  # (4, 2), top-left pixel centre at (0.5, 0.5)
    covariance: Array  # (8, 8) of pixels.ravel()
    correlation: float  # of the picture with the marker as it must look, -1 to 1


def refine_corners(picture: Grey, bits: npt.NDArray[np.bool_], corners: Array) -> Corners | None:
    """The corners near `corners` (4, 2); None where the marker or the white around it is partly outside the picture.

    `bits` (B, B) are True where the marker is white, its black border included.
    """
    sides = np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1)
    shrink = max(1, round(float(sides.max()) / _AS_FITTED_PX))
    window = _window(corners, float(sides.max()) * (0.5 + _MARGIN) / len(bits), shrink, picture.shape)
    if window is None:
        return None
    left, top, width, height = window
    patch = picture[top : top + height * shrink, left : left + width * shrink]
    patch = np.asarray(cv2.resize(patch, (width, height), interpolation=cv2.INTER_AREA), np.float32)
    within = (corners - (left, top)) / shrink
    moved, covariance, correlation = _fit_corners(patch, bits, within)
    return Corners(shrink * moved + (left, top), shrink**2 * covariance, correlation)


def _window(corners: Array, around: float, shrink: int, shape: tuple[int, ...]) -> tuple[int, int, int, int] | None:
    """Left, top, and width and height over `shrink`, of the pixels around the corners; None beyond the picture."""
    least, most = np.floor(corners.min(0) - around), np.ceil(corners.max(0) + around)
    size = np.ceil((most - least) / shrink).astype(int)
    if (least < 0).any() or (least + size * shrink > (shape[1], shape[0])).any():
        return None
    return int(least[0]), int(least[1]), int(size[0]), int(size[1])


def _fit_corners(patch: Grey, bits: npt.NDArray[np.bool_], start: Array) -> tuple[Array, Array, float]:
    """Corners (4, 2), their covariance (8, 8), and the correlation: Gauss-Newton with halved steps."""
    texture, per_bit = _texture(bits, start)
    used = _mask_used_pixels(start, len(bits), patch.shape)
    before: Array = np.array([*start.ravel(), np.log(_FIRST_BLUR_PX), 0.0])
    held = np.array([*[0.0] * 8, 1.0, 1.0]) / _LOG_SIGMA  # blur and mixing, by their prior

    def differences(values: Array) -> Array:
        return _differences(patch, used, texture, per_bit, values)

    def derivatives(values: Array, now: Array) -> Array:
        nudged = [differences(values + nudge) - now for nudge in np.diag(_NUDGES)]
        return np.stack(nudged, 1) / _NUDGES

    def cost(values: Array, now: Array, noise: float) -> float:
        return float((now**2).sum() / noise**2 + ((held * (values - before)) ** 2).sum())

    values, now = before, differences(before)
    for _ in range(_STEPS):
        noise = _noise(now)
        rows = np.vstack([derivatives(values, now) / noise, np.diag(held)])
        residuals = np.concatenate([now / noise, held * (values - before)])
        step = -np.asarray(np.linalg.lstsq(rows, residuals, rcond=None)[0], np.float64)
        step[:8] = np.clip(step[:8], -1.0, 1.0)
        for _ in range(_HALVINGS):
            later = values + step
            later[8] = np.clip(later[8], *np.log(_BLURS_PX))
            then = differences(later)
            if cost(later, then, noise) <= cost(values, now, noise):
                values, now = later, then
                break
            step = 0.5 * step
        if np.abs(step[:8]).max() < _SETTLED_PX:
            break
    jacobian = derivatives(values, now)
    information = jacobian.T @ jacobian / _noise(now) ** 2 + np.diag(held**2)
    covariance = np.linalg.pinv(information)[:8, :8] + _FLOOR_PX**2 * np.eye(8)
    explained = 1.0 - float((now**2).mean()) / max(float(np.var(patch[used])), 1e-9)
    return values[:8].reshape(4, 2), np.asarray(covariance, np.float64), max(0.0, explained) ** 0.5


def _noise(differences: Array) -> float:
    """Standard deviation of a pixel, grey levels; never 0."""
    return float(np.sqrt((differences**2).sum() / max(len(differences) - _NUM_PARAMETERS, 1))) + 1e-3


def _texture(bits: npt.NDArray[np.bool_], corners: Array) -> tuple[Grey, int]:
    """The marker with a white bit around it, about as fine as the samples, and its texels a bit."""
    side = np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).mean()
    per_bit = int(np.clip(round(side / len(bits) * _FINE), 4, 64))
    return np.kron(np.pad(bits, 1, constant_values=True), np.ones((per_bit, per_bit))).astype(np.float32), per_bit


def _mask_used_pixels(corners: Array, bits: int, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    """(h, w) the pixels in the marker and in the white around it."""
    grown = corners.mean(0) + (corners - corners.mean(0)) * (1.0 + 2.0 * _MARGIN / bits)
    inside = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(inside, np.rint(grown - 0.5).astype(np.int32), 1)
    return inside > 0


def _differences(patch: Grey, used: npt.NDArray[np.bool_], texture: Grey, per_bit: int, values: Array) -> Array:
    """(M,) model less picture at the pixels that are used, black, white and the light's slope solved for."""
    corners, blur, mixing = values[:8].reshape(4, 2), float(np.exp(values[8])), float(np.exp(values[9]))
    size = texture.shape[0]
    square = np.array([[1, 1], [size // per_bit - 1, 1], [size // per_bit - 1] * 2, [1, size // per_bit - 1]]) * per_bit
    # cv2 has the centre of the top-left pixel at (0, 0)
    to_fine = cv2.getPerspectiveTransform((square - 0.5).astype(np.float32), (_FINE * corners - 0.5).astype(np.float32))
    shape = _FINE * patch.shape[1], _FINE * patch.shape[0]
    fine = cv2.warpPerspective(texture, to_fine, shape, flags=cv2.INTER_LINEAR, borderValue=1.0)
    fine = cv2.GaussianBlur(fine, (0, 0), _FINE * blur)
    white = cv2.resize(fine, (patch.shape[1], patch.shape[0]), interpolation=cv2.INTER_AREA)[used]
    white = np.clip(white.astype(np.float64), 0.0, 1.0) ** mixing
    rows, columns = np.nonzero(used)
    slopes = columns / patch.shape[1] - 0.5, rows / patch.shape[0] - 0.5
    light = np.stack([np.ones_like(white), white, white * slopes[0], white * slopes[1]], 1)
    seen = patch[used].astype(np.float64)
    found, *_ = np.linalg.lstsq(light, seen, rcond=None)
    return np.asarray(light @ found - seen if found[1] > 0.0 else seen.mean() - seen, np.float64)  # never a negative


# Printed markers in photographs: which, and where their corners are.

_LEAST_SIDE_PX = 12.0  # of a marker: two pixels a bit
_LEAST_CORRELATION = 0.9  # of a marker with its picture: what looks like one by chance has less


@dataclass(frozen=True, eq=False)
class MarkerDetection:
    """A marker in a photograph. Pixels are those of the photograph without its lens' distortion."""

    photograph: str
    width: int
    height: int
    marker: int  # its number
    corners: Corners


def detect_markers(frames: Iterable[Frame | DroppedFrame], dictionary: str) -> list[MarkerDetection]:
    """Every marker of the dictionary in every frame; a number that a frame shows twice is none of it.

    Raises ValueError where the intrinsics of a frame cannot be used.
    """
    definition = cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary])
    detector = cv2.aruco.ArucoDetector(definition)
    found = list[MarkerDetection]()
    for frame in frames:
        if isinstance(frame, Frame):
            found += _detect_in_frame(undistort_frame(frame), detector, definition)
    return found


def _detect_in_frame(
    frame: Frame, detector: cv2.aruco.ArucoDetector, definition: cv2.aruco.Dictionary
) -> list[MarkerDetection]:
    grey = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), np.uint8)
    found = [
        MarkerDetection(frame.name, frame.width, frame.height, marker, corners)
        for marker, start in _detect_quads(grey, detector)
        if (corners := refine_corners(grey.astype(np.float32), _render_bits(definition, marker), start)) is not None
        and corners.correlation >= _LEAST_CORRELATION
    ]
    times = Counter(each.marker for each in found)
    return [each for each in found if times[each.marker] == 1]


def _detect_quads(
    grey: npt.NDArray[np.uint8], detector: cv2.aruco.ArucoDetector
) -> Iterator[tuple[int, npt.NDArray[np.float64]]]:
    """The number and the corners (4, 2) of each marker, to about a pixel."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.minMarkerPerimeterRate = min(0.03, 4.0 * _LEAST_SIDE_PX / max(grey.shape))
    detector.setDetectorParameters(parameters)
    quads, numbers, _ = detector.detectMarkers(grey)
    for quad, number in zip(quads, () if numbers is None else numbers.ravel(), strict=True):
        yield int(number), np.asarray(quad, np.float64).reshape(4, 2) + 0.5


def _render_bits(definition: cv2.aruco.Dictionary, marker: int) -> npt.NDArray[np.bool_]:
    """(B, B) True where the marker is white, its black border included."""
    picture = cv2.aruco.generateImageMarker(definition, marker, definition.markerSize + 2)
    return np.asarray(picture) > 0


_SQUARE = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])  # as corners are named
_LEAST_PARALLAX_DEG = 1.0  # between the cameras, seen from the marker
_CAMERA_PX = 0.3  # standard deviation, at REFERENCE_SIDE, of where a registered camera sees a known point
_MOST_PX = 4.0  # of the corners' error at REFERENCE_SIDE: beyond, the marker was moved, or is another one


@dataclass(frozen=True, eq=False)
class _MarkerView:
    """A marker in the photograph of a camera."""

    view: MetricView
    rays: Array  # (4, 2) at depth 1
    whitening: Array  # (8, 8): times the rays' error, independent errors of standard deviation 1
    px: float  # of the reference size, in rays


def estimate_scale_from_markers(
    views: Mapping[str, MetricView], sightings: Sequence[MarkerDetection], side_m: float, sigma_m: float
) -> list[Measurement | str]:
    """The unit by all markers together, and a sentence for each that says nothing.

    `side_m` is the side of the black square and `sigma_m` its standard deviation, metres: all markers have both alike.
    Where two markers contradict each other, each is a measurement of its own, as sure as it is but for the side: an
    error that all of them share cannot explain what they differ by. Raises ValueError for a side of 0.
    """
    if side_m <= 0:
        raise ValueError(f"the side of a marker must be above 0, got {side_m}")
    if not sightings:
        return [f"no marker of {format_length(side_m)} was found in the photographs"]
    numbers = sorted({each.marker for each in sightings})
    results = [
        _estimate_scale_from_marker(number, views, [each for each in sightings if each.marker == number], side_m)
        for number in numbers
    ]
    single = [each for each in results if isinstance(each, Measurement)]
    silent = [each for each in results if isinstance(each, str)]
    agreed = combine_measurements(single) if single else ""
    if not isinstance(agreed, Measurement):
        return [*single, *silent]
    return [replace(agreed, sigma=math.hypot(agreed.sigma, sigma_m / side_m)), *silent]


def _estimate_scale_from_marker(
    number: int, views: Mapping[str, MetricView], sightings: Sequence[MarkerDetection], side_m: float
) -> Measurement | str:
    seen = [_make_marker_view(views[each.photograph], each) for each in sightings if each.photograph in views]
    name = f"marker {number} of {format_length(side_m)}"
    if not seen:
        return f"{name} is in no photograph that has a camera in the scene"
    if len(seen) == 1:
        where = next(each.photograph for each in sightings if each.photograph in views)
        return f"{name} is in one photograph of the scene alone, {where}; two are needed"
    found = _fit_square(seen)
    if found is None:
        return f"{name} is in {len(seen)} photographs, from one and the same side; step to the side between them"
    side, sigma, error_px = found
    if error_px > _MOST_PX:
        return f"{name} does not lie still, or there are two of it: its corners are off by {error_px:.1f} pixels"
    source = f"{name} in {len(seen)} photographs"
    return Measurement(side_m / side, math.hypot(sigma, compute_scale_sigma([each.view for each in seen])), source)


def _make_marker_view(view: MetricView, sighting: MarkerDetection) -> _MarkerView:
    """Makes the view of a marker; its corners have errors of their own, and share the camera's error."""
    pixels, size = sighting.corners.pixels, (sighting.width, sighting.height)
    px = max(size) / REFERENCE_SIDE
    alike = np.kron(np.ones((4, 4)), np.eye(2))
    per_ray = 1.0 / (view.focal * max(size))  # rays a pixel; what the lens bends of it is no matter
    covariance = (sighting.corners.covariance + (_CAMERA_PX * px) ** 2 * alike) * per_ray**2
    whitening = np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), np.float64)
    return _MarkerView(view, view.unproject(pixels, *size), whitening, px * per_ray)


def _fit_square(seen: Sequence[_MarkerView]) -> tuple[float, float, float] | None:
    """Side in the scene's unit, standard deviation of its logarithm, and the corners' rms error in reference pixels.

    The pose and the side of a square whose corners are seen where they are. None without parallax.
    """
    count = len(seen)
    matrices = np.asarray([np.linalg.inv(each.view.T_world_camera)[:3] for each in seen], np.float64)
    cameras, rays = np.repeat(np.arange(count), 4), np.concatenate([each.rays for each in seen])
    corners = triangulate(matrices, rays, cameras, np.tile(np.arange(4), count), 4)
    middle = corners.mean(0)
    centres = np.stack([each.view.centre for each in seen])
    if not np.isfinite(corners).all() or _parallax_deg(middle, centres) < _LEAST_PARALLAX_DEG:
        return None
    side = float(np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).mean())
    u, _, vt = np.linalg.svd((corners - middle).T @ _SQUARE)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    unit = float(np.median([np.linalg.norm(middle - each.view.centre) for each in seen]))

    def errors(values: Array) -> Array:
        square = _move_square(values, turn, middle, side, unit)
        return np.concatenate([each.whitening @ _compute_ray_errors(each, square) for each in seen])

    found = least_squares(errors, np.zeros(7), method="lm", x_scale=np.full(7, 0.01))
    square = _move_square(found.x, turn, middle, side, unit)
    per_px = np.concatenate([_compute_ray_errors(each, square) / each.px for each in seen])
    covariance = np.linalg.pinv(found.jac.T @ found.jac)
    freedom = 8 * len(seen) - 7
    wider = max(1.0, math.sqrt(2.0 * found.cost / freedom))  # where the errors are larger than they should be
    return side * math.exp(found.x[6]), wider * math.sqrt(covariance[6, 6]), float(np.sqrt((per_px**2).mean() * 2.0))


def _move_square(values: Array, turn: Array, middle: Array, side: float, unit: float) -> Array:
    """(4, 3) corners of the square after a small turn (3), a move (3) in `unit`, and a change of its log side."""
    rotation = Rotation.from_rotvec(values[:3]).as_matrix() @ turn
    return side * math.exp(values[6]) * _SQUARE @ rotation.T + middle + unit * values[3:6]


def _compute_ray_errors(seen: _MarkerView, corners: Array) -> Array:
    """(8,) rays at which the corners (4, 3) are seen, less those at which they should be."""
    in_camera = (corners - seen.view.centre) @ seen.view.T_world_camera[:3, :3]
    depth = np.where(np.abs(in_camera[:, 2:]) < 1e-9, 1e-9, in_camera[:, 2:])
    return (in_camera[:, :2] / depth - seen.rays).ravel()


def _parallax_deg(point: Array, centres: Array) -> float:
    """The largest angle between two of the cameras at `centres` (C, 3), seen from the point."""
    cameras = np.arange(len(centres))
    return float(largest_angles(centres, point[None], cameras, np.zeros_like(cameras))[0])
