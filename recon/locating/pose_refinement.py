"""The pose and the lens that fit correspondences best, and how well these determine them.

Poses are sought with the lenses that a query image may have been taken with: what is known or assumed of each, and any
other lens.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics
from splatnode.recon import poselib
from splatnode.recon.geometry import cross_matrix, distortion
from splatnode.recon.geometry import undistort_rays as straight
from splatnode.recon.keyframes import PLAIN, Features
from splatnode.recon.locating import NORMAL_95, LensSource, Located
from splatnode.recon.matching import features as matching_features
from splatnode.recon.registration import bundle_adjustment, multiview_geometry
from splatnode.recon.result.snapshot import KnownLenses, Landmarks
from splatnode.recon.verification.evidence import ReflectionConfig, mirror_descriptors

# A camera with an uncertain lens: where it sees points, and how that changes with its pose and its lens.

Array = npt.NDArray[np.float64]

# A small turn (3) and move (3) of the world in the camera, log focal, first radial, shift (2), log aspect.
NUM_PARAMETERS = 11
POSE = 6  # of them, the pose's
PINHOLE = 0.0, 0.0  # its radial coefficients


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens with what is known of it: standard deviations; 0 where a number is certain."""

    focal: float  # pixels, the geometric mean of those across and down
    radial: tuple[
        float, float
    ]  # radial coefficients, as recon/registration/bundle_adjustment.py has them; the second is held
    shift: Array  # (2,) of the principal point, pixels
    log_focal_sigma: float
    radial_sigma: float  # of the first
    shift_sigma: float  # pixels
    log_aspect: float = 0.0  # logarithm of the focal length across over that down
    log_aspect_sigma: float = 0.0

    @property
    def values(self) -> Array:
        """(5,) as parameters."""
        return np.array([np.log(self.focal), self.radial[0], *self.shift, self.log_aspect])

    @property
    def sigmas(self) -> Array:
        """(5,)"""
        return np.array(
            [self.log_focal_sigma, self.radial_sigma, self.shift_sigma, self.shift_sigma, self.log_aspect_sigma]
        )

    @property
    def focals(self) -> Array:
        """(2,) focal lengths across and down, pixels."""
        half = 0.5 * self.log_aspect
        return self.focal * np.exp([half, -half])

    def copy_shape(self, other: Lens) -> Lens:
        """This lens with the radial coefficients and the aspect of `other`, known as well as these are."""
        return replace(
            self,
            radial=other.radial,
            radial_sigma=other.radial_sigma,
            log_aspect=other.log_aspect,
            log_aspect_sigma=other.log_aspect_sigma,
        )

    def copy_sigmas(self, other: Lens) -> Lens:
        """This lens, known as well as `other`."""
        return replace(
            self,
            log_focal_sigma=other.log_focal_sigma,
            radial_sigma=other.radial_sigma,
            shift_sigma=other.shift_sigma,
            log_aspect_sigma=other.log_aspect_sigma,
        )


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A pose, world to camera, and a lens."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,)
    lens: Lens

    def apply_step(self, step: Array) -> CameraModel:
        """Returns the camera with its parameters changed by `step` (NUM_PARAMETERS,)."""
        lens = self.lens
        return CameraModel(
            np.asarray(cv2.Rodrigues(step[:3])[0]) @ self.rotation,
            self.translation + step[3:POSE],
            replace(
                lens,
                focal=lens.focal * float(np.exp(step[6])),
                radial=(lens.radial[0] + float(step[7]), lens.radial[1]),
                shift=lens.shift + step[8:10],
                log_aspect=lens.log_aspect + float(step[10]),
            ),
        )

    @property
    def T_world_camera(self) -> Array:
        """(4, 4)"""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.rotation.T, -self.rotation.T @ self.translation
        return T

    def errors(self, points: Array, pixels: Array) -> Array:
        """(M,) reprojection errors of points (M, 3), pixels; infinite behind the camera."""
        seen, depth = self.project(points)
        return np.where(depth > 0, np.linalg.norm(seen - pixels, axis=1), np.inf)

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels (M, 2) of world points (M, 3), relative to the nominal principal point, and depths (M,)."""
        in_camera = points @ self.rotation.T + self.translation
        rays = in_camera[:, :2] / bundle_adjustment.avoid_zero_depth(in_camera[:, 2])[:, None]
        bent = distortion((rays**2).sum(1), np.array(self.lens.radial))
        return self.lens.focals * bent[:, None] * rays + self.lens.shift, in_camera[:, 2]

    def derivatives(self, points: Array) -> tuple[Array, Array]:
        """Differentiates pixels of points (M, 3): (M, 2, NUM_PARAMETERS) by parameters, (M, 2, 3) by points."""
        # A row of memory is a derivative of all points: so NumPy's loops are long ones.
        turned = np.ascontiguousarray((points @ self.rotation.T).T)
        z = bundle_adjustment.avoid_zero_depth(turned[2] + self.translation[2])
        x, y = (turned[0] + self.translation[0]) / z, (turned[1] + self.translation[1]) / z
        (across, down), (first, second), squared = self.lens.focals, self.lens.radial, x * x + y * y
        bent = distortion(squared, np.array(self.lens.radial))
        twice = 2.0 * (first + 2.0 * second * squared)
        # By the ray (x, y), which is the point over its depth; then by the point in the camera.
        xx, yy = across * (bent + twice * x * x), down * (bent + twice * y * y)
        xy, yx = across * twice * x * y, down * twice * x * y
        by_camera = np.stack([[xx, xy, -(xx * x + xy * y)], [yx, yy, -(yx * x + yy * y)]]) / z  # (2, 3, M)
        by_parameters = np.zeros((2, NUM_PARAMETERS, len(points)))
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # turned x by_camera
            by_parameters[:, i] = turned[j] * by_camera[:, k] - turned[k] * by_camera[:, j]
        by_parameters[:, 3:POSE] = by_camera
        by_parameters[:, 6] = across * bent * x, down * bent * y
        by_parameters[:, 7] = across * squared * x, down * squared * y
        by_parameters[0, 8] = by_parameters[1, 9] = 1.0
        by_parameters[:, 10] = 0.5 * by_parameters[0, 6], -0.5 * by_parameters[1, 6]
        return by_parameters.transpose(2, 0, 1), (self.rotation.T @ by_camera).transpose(2, 0, 1)


def undistort_pixels(pixels: Array, lens: Lens) -> Array:
    """(M, 2) where a pinhole of the same focal length sees what `lens` sees at `pixels` (M, 2)."""
    distorted = (pixels - lens.shift) / lens.focals
    return lens.focal * straight(distorted, np.array(lens.radial))


# Which pixels of a photograph may show which landmarks: its features matched with those of each known photograph.

Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

LEAST_COSINE = 0.5  # between two directions from which a feature looks alike: 60 degrees are beyond SIFT's reach
_NEAREST = 4  # photographs of the scene that one is compared with whose camera is nearly known
_MARGIN = 0.15  # of the longer side, around the picture: what is there may be in it
_REACH_SIGMAS = 2.0  # of where a camera sees a landmark, which its reach must hold
_MIN_LENGTH = 1e-12


@dataclass(frozen=True, eq=False)
class Correspondences:
    """M pixels of a photograph with the landmarks that they may show. A pixel may have several of them."""

    pixels: Array  # (M, 2) relative to the nominal principal point
    feature_of: Index  # (M,) the photograph's feature
    points: Array  # (M, 3) world
    covariances: Array  # (M, 3, 3) of the points
    landmark_of: Index  # (M,)
    photograph_of: Index  # (M,) a known photograph that says so
    seen_along: Array  # (M, 3) the mean direction in which those that say so see the landmark, of unit length, world

    def __len__(self) -> int:
        return len(self.pixels)

    def select(self, chosen: Flags | Index) -> Correspondences:
        """The chosen ones."""
        return Correspondences(
            *(getattr(self, name)[chosen] for name in Correspondences.__dataclass_fields__),
        )


@dataclass(frozen=True, eq=False)
class PosePrior:
    """A prior on the camera's pose."""

    camera: CameraModel
    size: tuple[int, int]  # (width, height) of its picture, pixels
    reach_px: float | None = None  # a landmark is at most so far from where the camera sees it; None: anywhere
    # (NUM_PARAMETERS, NUM_PARAMETERS) of the camera: what it leaves open by more than the reach is not looked for.
    # Else what agrees with it by chance is found, and nothing that speaks against it. None: it is exact
    covariance: Array | None = None


def match_landmarks(
    features: Features,
    principal: Array,
    landmarks: Landmarks,
    config: matching_features.NearestNeighbourConfig,
    near: PosePrior | None = None,
) -> Correspondences:
    """The matches of the plain `features` with the descriptors of each known photograph by itself.

    In the photographs together a landmark is its own second-nearest neighbour, and the ratio test would fail. Where the
    camera is nearly known, the photographs are those that look most alike, and the landmarks those that it sees, from
    nearly the same side.
    """
    count = len(landmarks.Ts_world_camera)
    photographs = range(count) if near is None else _nearest(landmarks, near.camera.T_world_camera)
    in_view, shown = (None, None) if near is None else _find_visible(landmarks, principal, near)
    at = features.points[features.point_of]
    ours, theirs = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for photograph in photographs:
        (own,) = np.nonzero(landmarks.photograph_of == photograph)
        if near is not None and in_view is not None:
            own = own[in_view[own]]
        described = landmarks.descriptors[own]
        if near is None or near.reach_px is None or shown is None:
            matches = matching_features.match(features.descriptors, described, config)
        else:
            there = shown[landmarks.point_of[own]]
            matches = matching_features.match_near(features.descriptors, at, described, there, near.reach_px, config)
        ours.append(features.point_of[matches[:, 0]])
        theirs.append(own[matches[:, 1]])
    return _each_once(np.concatenate(ours), np.concatenate(theirs), features.points - principal, landmarks)


def measure_mirror_gain(features: Features, landmarks: Landmarks, config: ReflectionConfig) -> float:
    """How much better the plain `features` match the scene when the image is turned left to right.

    It is the logarithm of the matches mirrored over those as it is (recon/verification/evidence.py), each with those
    images of the scene with which it has most. In a symmetric place these are not the same.
    """
    plain = features.select_tilt(PLAIN).descriptors[: config.num_features]
    counts = np.zeros((len(landmarks.names), 2))  # as it is, and mirrored
    for photograph in range(len(counts)):
        theirs = landmarks.descriptors[landmarks.photograph_of == photograph]
        for way, ours in enumerate((plain, mirror_descriptors(plain))):
            counts[photograph, way] = len(matching_features.match(theirs, ours, config.nearest_neighbours))
    as_it_is, mirrored = np.sort(counts, axis=0)[-config.partners :].mean(0) + config.by_chance
    return float(np.log(mirrored / as_it_is))


def _find_visible(landmarks: Landmarks, principal: Array, near: PosePrior) -> tuple[Flags, Array]:
    """(D,) which descriptors are of points that the camera sees as they were seen; (P, 2) where it sees each point."""
    shown, depth = near.camera.project(landmarks.points)
    shown, margin = shown + principal, near.reach_px or _MARGIN * max(near.size)
    inside = (depth > 0) & (shown > -margin).all(1) & (shown < np.array(near.size) + margin).all(1)
    if near.covariance is not None and near.reach_px is not None:
        inside &= _REACH_SIGMAS * _predict_sigmas(near.camera, near.covariance, landmarks.points) <= near.reach_px
    points = landmarks.points[landmarks.point_of]
    before = _directions(points - landmarks.Ts_world_camera[landmarks.photograph_of, :3, 3])
    now = _directions(points - near.camera.T_world_camera[:3, 3])
    return inside[landmarks.point_of] & ((before * now).sum(1) > LEAST_COSINE), shown


def _predict_sigmas(camera: CameraModel, covariance: Array, points: Array) -> Array:
    """(P,) standard deviations of where the camera sees points, pixels; infinite where nothing is known of it."""
    by_parameters, _ = camera.derivatives(points)
    variances = np.einsum("pij,jk,pik->p", by_parameters, covariance, by_parameters)
    return np.where(np.isfinite(variances), np.sqrt(np.maximum(variances, 0.0)), np.inf)


def _nearest(landmarks: Landmarks, T_world_camera: Array) -> Index:
    """The photographs of the scene that look most alike: a radian counts as much as the distance to the scene."""
    Ts = landmarks.Ts_world_camera
    turn = np.arccos(np.clip(Ts[:, :3, 2] @ T_world_camera[:3, 2], -1.0, 1.0))
    apart = np.linalg.norm(Ts[:, :3, 3] - T_world_camera[:3, 3], axis=1) / landmarks.unit
    return np.argsort(turn + apart, kind="stable")[:_NEAREST]


def _each_once(feature_of: Index, descriptor_of: Index, pixels: Array, landmarks: Landmarks) -> Correspondences:
    """Each feature, which lies at `pixels`, with each landmark that it may show, once."""
    photograph_of = landmarks.photograph_of[descriptor_of]
    both = np.column_stack([feature_of, landmarks.point_of[descriptor_of]])
    pairs, first, pair_of = np.unique(both, axis=0, return_index=True, return_inverse=True)
    feature_of, landmark_of = pairs.T
    along = _directions(landmarks.points[both[:, 1]] - landmarks.Ts_world_camera[photograph_of, :3, 3])
    seen_along = np.zeros((len(pairs), 3))
    np.add.at(seen_along, pair_of.ravel(), along)
    return Correspondences(
        pixels=pixels[feature_of],
        feature_of=feature_of,
        points=landmarks.points[landmark_of],
        covariances=landmarks.covariances[landmark_of],
        landmark_of=landmark_of,
        photograph_of=photograph_of[first],
        seen_along=_directions(seen_along),
    )


def _directions(vectors: Array) -> Array:
    """The vectors (M, 3) in unit length."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), _MIN_LENGTH)


# Observations that tell as much as one with an error of its own: what lens, shutter and scene do otherwise than the
# model moves whole regions alike. Registration takes 100 (recon/registration/incremental_mapper.py); the landmarks
# have been through the same lenses and keep a part of it: with 30, 98 % of the turns are within their 95 % bounds
# (tests/bench).
CORRELATED = 30.0
_ROBUST = 3.0  # scale of the Cauchy loss, in standard deviations
_STEPS = 12  # Gauss-Newton converges in a few
_CONVERGED = 1e-6  # largest change of a parameter over its standard deviation, squared
_RAYLEIGH_MEDIAN = 1.1774  # median length of a 2D error whose components have sigma 1: sqrt(2 log 2)
_FIXED = 1e-9  # stands for a sigma of 0


@dataclass(frozen=True, eq=False)
class CameraFit:
    """A camera with what its correspondences say of it."""

    camera: CameraModel
    covariance: Array  # (NUM_PARAMETERS, NUM_PARAMETERS) of `CameraModel.moved`'s step; NaN where it is not finite
    spread: float  # of the residuals, over what is expected of them: 1 where all is as it should be


def optimize_camera(camera: CameraModel, prior: Lens, known: Correspondences, noise_px: float) -> CameraFit:
    """The camera with the least robust cost, from `camera` on.

    `noise_px` is the standard deviation of a pixel's coordinate; the points' own uncertainty counts beside it. The
    lens is held near `prior`, by its sigmas.
    """
    information_of_prior = 1.0 / np.maximum(prior.sigmas, _FIXED) ** 2
    spread = 1.0
    covariance = np.full((NUM_PARAMETERS, NUM_PARAMETERS), np.nan)
    covariances = np.ascontiguousarray(known.covariances.transpose(1, 2, 0))
    for _ in range(_STEPS):
        rows, residuals = _whiten_residuals(camera, known, covariances, noise_px)
        lengths = np.hypot(*residuals)
        spread = max(_median(lengths) / _RAYLEIGH_MEDIAN, 1.0)
        weights = 1.0 / (1.0 + (lengths / (_ROBUST * spread)) ** 2) / spread**2
        across, down = weights * rows
        information = across @ rows[0].T + down @ rows[1].T
        gradient = across @ residuals[0] + down @ residuals[1]
        # The prior is one observation, and so are CORRELATED correspondences.
        lens = slice(POSE, NUM_PARAMETERS)
        information[lens, lens] += CORRELATED * np.diag(information_of_prior)
        gradient[lens] += CORRELATED * information_of_prior * (prior.values - camera.lens.values)
        inverse = _inverse(information)
        if inverse is None:
            return CameraFit(camera, np.full_like(covariance, np.nan), spread)
        step = inverse @ gradient
        if not np.isfinite(step).all():
            return CameraFit(camera, np.full_like(covariance, np.nan), spread)
        camera, covariance = camera.apply_step(step), CORRELATED * inverse
        if step @ information @ step < _CONVERGED:
            break
    return CameraFit(camera, covariance, spread)


def _whiten_residuals(
    camera: CameraModel,
    known: Correspondences,
    covariances: Array,  # (3, 3, M) of the points
    noise_px: float,
) -> tuple[Array, Array]:
    """Derivatives (2, NUM_PARAMETERS, M) and residuals (2, M), observed less predicted, in standard deviations."""
    by_parameters, by_point = (each.transpose(1, 2, 0) for each in camera.derivatives(known.points))
    residuals = (known.pixels - camera.project(known.points)[0]).T
    # The Cholesky factor of each pixel's covariance (2, 2).
    of_first, of_second = ((covariances * each[:, None]).sum(0) for each in by_point)
    top = np.sqrt((of_first * by_point[0]).sum(0) + noise_px**2)
    aside = (of_first * by_point[1]).sum(0) / top
    bottom = np.sqrt((of_second * by_point[1]).sum(0) + noise_px**2 - aside**2)
    rows, errors = np.empty_like(by_parameters), np.empty((2, len(known)))
    for whitened, given in ((rows, by_parameters), (errors, residuals)):
        whitened[0] = given[0] / top
        whitened[1] = (given[1] - aside * whitened[0]) / bottom
    return rows, errors


def compute_whitened_errors(camera: CameraModel, known: Correspondences, noise_px: float) -> Array:
    """(M,) the reprojection errors in their own standard deviations."""
    covariances = np.ascontiguousarray(known.covariances.transpose(1, 2, 0))
    return np.hypot(*_whiten_residuals(camera, known, covariances, noise_px)[1])


def _median(values: Array) -> float:
    """As NumPy's of (M,), in a fraction of its time for few."""
    middle = (len(values) - 1) // 2, len(values) // 2
    return float(np.partition(values, middle)[list(middle)].mean())


def _inverse(information: Array) -> Array | None:
    """(N, N) inverse of the normal matrix; None where it is not finite or no information at all."""
    unit = np.sqrt(np.diag(information))
    if not (np.isfinite(information).all() and (unit > 0).all()):
        return None
    try:
        return np.linalg.inv(information / unit[:, None] / unit) / unit[:, None] / unit
    except np.linalg.LinAlgError:
        return None


def pose_covariance(camera: CameraModel, covariance: Array) -> Array:
    """(6, 6) of a small motion in the camera's frame: translation (3), then rotation vector (3), radians.

    `covariance` (POSE, POSE or more) is of a step of `CameraModel.moved`.
    """
    change = np.zeros((POSE, POSE))
    change[:3, :3] = -cross_matrix(camera.translation[None])[0]
    change[:3, 3:] = -np.eye(3)
    change[3:, :3] = -np.eye(3)
    return change @ covariance[:POSE, :POSE] @ change.T


# What is not known of a lens, as in recon/registration (self_calibration.py, incremental_mapper.py); lengths over the
# longer side.
_EXIF_SIGMA, _RADIAL_SIGMA, _SHIFT_SIGMA, _ASPECT_SIGMA = 0.05, 0.02, 0.004, 0.001
_SAME_LENS_SIGMA, _SAME_RADIAL_SIGMA = 0.01, 0.005  # focusing changes the lens of one camera
# A calibration is right to these; with them an image is asked whether it is of that lens.
_GIVEN_SIGMA, _GIVEN_RADIAL_SIGMA, _GIVEN_SHIFT_SIGMA = 0.003, 0.005, 0.002
# Of a lens of which nothing is known: log focal, first radial coefficient, principal point, log aspect. An image that
# was cropped has its principal point anywhere, one of pixels that are not square any aspect.
_FREE_SIGMA, _FREE_RADIAL_SIGMA, _FREE_SHIFT_SIGMA, _FREE_ASPECT_SIGMA = 0.3, 0.1, 0.2, 0.15
_FOCALS = np.geomspace(0.45, 4.1, 10)  # over the longer side, 96 to 14 degrees of view: steps of 28 %
# Up to 9 : 16 and 16 : 9: as where a recording's pixels are taken for square, or a photograph was made square (3 : 2)
_LOG_ASPECTS = -0.575, -0.405, -0.29, -0.14, 0.14, 0.29, 0.405, 0.575
_SAME_SHAPE = 0.01  # largest difference of two images' height over width
_SAME_FOCAL = 0.15  # of log focals: an EXIF focal length that may be of the result's own lens
_DISTINCT_FOCAL = 0.002  # least difference of the log focals of a result's lenses that are tried one by one


@dataclass(frozen=True, eq=False)
class LensAssumption:
    """A lens that an image is assumed to have, until its points say otherwise."""

    lens: Lens  # with the sigmas by which the assumption is tested
    source: LensSource

    @property
    def exact(self) -> bool:
        """Whether the lens stays as it is, where the image does not contradict it."""
        return self.source is LensSource.GIVEN


def make_trusted_lens(intrinsics: Intrinsics) -> Lens | None:
    """The lens of an image without distortion that came with trusted intrinsics; None where they are not."""
    return Lens(intrinsics.fx, PINHOLE, np.zeros(2), 0.0, 0.0, 0.0) if intrinsics.source != "exif" else None


def assume_lenses(lenses: KnownLenses, width: int, height: int, intrinsics: Intrinsics | None) -> list[LensAssumption]:
    """Returns the lenses that may be assumed of an image, the surest first; none where nothing is known.

    A lens that is given is all that is assumed. Otherwise the result's own lenses come first, then what EXIF states.
    """
    side = max(width, height)
    if intrinsics is not None and (certain := make_trusted_lens(intrinsics)) is not None:
        sigmas = _GIVEN_SIGMA, _GIVEN_RADIAL_SIGMA, _GIVEN_SHIFT_SIGMA * side
        tested = Lens(certain.focal, PINHOLE, np.zeros(2), *sigmas, log_aspect_sigma=_ASPECT_SIGMA)
        return [LensAssumption(tested, LensSource.GIVEN)]
    found = [LensAssumption(lens, LensSource.SCENE) for lens in find_scene_lenses(lenses, width, height, intrinsics)]
    stated = [] if intrinsics is None else [LensAssumption(make_exif_lens(intrinsics, side), LensSource.EXIF)]
    return found + stated


def find_scene_lenses(lenses: KnownLenses, width: int, height: int, intrinsics: Intrinsics | None) -> list[Lens]:
    """Those of the result's own lenses that took images of this shape, upright or not."""
    side, found = max(width, height), list[Lens]()
    shape = height / width
    for focal, radial, shift, known in zip(lenses.focals, lenses.radials, lenses.shifts, lenses.shapes, strict=True):
        upright = abs(shape - known) <= _SAME_SHAPE
        if not upright and abs(1.0 / shape - known) > _SAME_SHAPE:
            continue
        if intrinsics is not None and abs(np.log(intrinsics.fx / side / focal)) > _SAME_FOCAL:
            continue
        if any(abs(np.log(lens.focal / side / focal)) < _DISTINCT_FOCAL for lens in found):
            continue
        moved = shift * side if upright else np.zeros(2)
        sigmas = _SAME_LENS_SIGMA, _SAME_RADIAL_SIGMA, _SHIFT_SIGMA * side
        found.append(
            Lens(float(focal) * side, (float(radial[0]), float(radial[1])), moved, *sigmas, 0.0, _ASPECT_SIGMA)
        )
    return found


def carry_over(before: Located, principal: Array, side: int) -> LensAssumption:
    """The lens that was found of the image before, of the same camera and size; `principal` is the nominal one."""
    focals = np.diag(before.K)[:2]
    log_sigma = math.log1p(before.claim.focal_percent / 100.0) / NORMAL_95
    lens = Lens(
        float(np.sqrt(focals.prod())),
        before.distortion,
        before.K[:2, 2] - principal,
        max(log_sigma, _SAME_LENS_SIGMA),
        _SAME_RADIAL_SIGMA,
        _SHIFT_SIGMA * side,
        float(np.log(focals[0] / focals[1])),
        _ASPECT_SIGMA,
    )
    return LensAssumption(lens, before.lens)


def make_exif_lens(intrinsics: Intrinsics, side: int) -> Lens:
    """The lens that EXIF tells, which is right to a few per cent."""
    sigmas = _EXIF_SIGMA, _RADIAL_SIGMA, _SHIFT_SIGMA * side
    return Lens(intrinsics.fx, PINHOLE, np.zeros(2), *sigmas, 0.0, _ASPECT_SIGMA)


def make_typical_lens(lens: Lens, side: int) -> Lens:
    """A lens of any focal length near that of `lens` with what most lenses have: little of all else."""
    sigmas = _FREE_SIGMA, _RADIAL_SIGMA, _SHIFT_SIGMA * side
    return Lens(lens.focal, PINHOLE, np.zeros(2), *sigmas, 0.0, _ASPECT_SIGMA)


def make_lens_grid(side: int, assumed: Sequence[LensAssumption]) -> list[Lens]:
    """Lenses from wide to long, each with what lies between it and the next, bent as the first that is assumed."""
    radial = assumed[0].lens.radial if assumed else PINHOLE
    return [free_lens(Lens(float(focal), radial, np.zeros(2), 0.0, 0.0, 0.0), side) for focal in side * _FOCALS]


def make_non_square_lenses(side: int) -> list[Lens]:
    """As `make_lens_grid`, of images whose pixels are not square."""
    return [replace(lens, log_aspect=log_aspect) for log_aspect in _LOG_ASPECTS for lens in make_lens_grid(side, ())]


def free_lens(lens: Lens, side: int) -> Lens:
    """Any lens near this one, of an image that may be a part of what the camera saw, or stretched."""
    return replace(
        lens,
        log_focal_sigma=_FREE_SIGMA,
        radial_sigma=_FREE_RADIAL_SIGMA,
        shift_sigma=_FREE_SHIFT_SIGMA * side,
        log_aspect_sigma=_FREE_ASPECT_SIGMA,
    )


def select_distinct_focals(assumed: Sequence[LensAssumption], least: float) -> list[Lens]:
    """Those of the lenses whose focal lengths differ by more than `least`, in logarithms."""
    found = list[Lens]()
    for each in assumed:
        if all(abs(np.log(each.lens.focal / lens.focal)) > least for lens in found):
            found.append(each.lens)
    return found


# The pose on which most correspondences agree, for a lens that is known or has to be tried.


_SAMPLE = 3  # correspondences that define a pose
_ITERATIONS_OF_MANY = 3_000  # of RANSAC, where lenses are tried: they do for 13 % inliers


class PoseSearchConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The pose on which most correspondences agree, for a lens that is known or has to be tried."""

    search_px: float = 6.0  # reprojection error of an inlier while the lens is not exact, pixels at REFERENCE_SIDE
    max_error_px: float = 3.0  # of an inlier in the end
    iterations: int = 10_000  # of RANSAC, at most: they do for 9 % inliers
    rounds: int = 4  # of inliers and refinement; they have settled by then


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A camera, and the correspondences that agree with it."""

    fit: CameraFit
    prior: Lens  # that it was refined with
    agreeing: Flags  # (M,) of those that were given; at most one of a pixel, and of a landmark


def estimate_pose(
    known: Correspondences, lenses: Sequence[Lens], scale: float, noise_px: float, config: PoseSearchConfig
) -> PoseEstimate | None:
    """The camera that most correspondences agree with, of one of the `lenses`, refined; None where not a sample does.

    `scale` is pixels of the photograph for one at REFERENCE_SIDE; `noise_px` is of an observation, in its pixels.
    """
    most = config.iterations if len(lenses) == 1 else min(config.iterations, _ITERATIONS_OF_MANY)
    found = [(camera, lens) for lens in lenses if (camera := search_pose(known, lens, scale, config, most)) is not None]
    if not found:
        return None
    limit_px = config.search_px * scale
    camera, lens = max(found, key=lambda each: int(agreement(each[0], known, limit_px).sum()))
    return refine_pose(camera, known, lens, scale, noise_px, config)


def search_pose(
    known: Correspondences, lens: Lens, scale: float, config: PoseSearchConfig, most_iterations: int | None = None
) -> CameraModel | None:
    """The camera by random samples, with the lens as it is given; None where there are too few correspondences."""
    if len(known) <= _SAMPLE:
        return None
    pose, info = poselib.estimate_absolute_pose(
        undistort_pixels(known.pixels, lens),
        known.points,
        multiview_geometry.pinhole(lens.focal),
        {
            "max_reproj_error": config.search_px * scale,
            "min_iterations": 500,
            "max_iterations": most_iterations or config.iterations,
            "seed": 0,
        },
    )
    if sum(info["inliers"]) <= _SAMPLE:
        return None
    return CameraModel(np.asarray(pose.R), np.asarray(pose.t), lens)


def refine_pose(
    camera: CameraModel, known: Correspondences, lens: Lens, scale: float, noise_px: float, config: PoseSearchConfig
) -> PoseEstimate | None:
    """The camera refined by its inliers, which are found again, until both have settled."""
    fit, agreeing = None, np.zeros(len(known), bool)
    for limit_px in np.linspace(config.search_px, config.max_error_px, config.rounds):
        agreeing = agreement(camera, known, limit_px * scale)
        if agreeing.sum() <= _SAMPLE:
            return None
        fit = optimize_camera(
            replace(camera, lens=camera.lens.copy_sigmas(lens)), lens, known.select(agreeing), noise_px
        )
        camera = fit.camera
    assert fit is not None
    return PoseEstimate(fit, lens, agreement(camera, known, config.max_error_px * scale))


def agreement(camera: CameraModel, known: Correspondences, limit_px: float) -> Flags:
    """(M,) which correspondences the camera explains: of a pixel the best one alone, and of a landmark.

    None is explained that the camera sees from elsewhere than the photographs that it was matched with: a feature does
    not look alike from the side, and from behind, as where a pattern was mirrored, it is not seen.
    """
    errors = camera.errors(known.points, known.pixels)
    along = known.points - camera.T_world_camera[:3, 3]
    cosine = (along * known.seen_along).sum(1) / np.maximum(np.linalg.norm(along, axis=1), _MIN_LENGTH)
    agreeing = (errors < limit_px) & (cosine > LEAST_COSINE)
    for kind in (known.feature_of, known.landmark_of):
        order = np.lexsort((errors, ~agreeing, kind))
        first = np.ones(len(order), bool)
        first[1:] = kind[order[1:]] != kind[order[:-1]]
        best = np.zeros(len(order), bool)
        best[order[first]] = True
        agreeing &= best
    return agreeing
