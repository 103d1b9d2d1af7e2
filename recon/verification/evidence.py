"""Evidence: numbers that speak for or against a registration, each from a source of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import combinations
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from splatnode.recon.geometry import cross_matrix, epipolar_errors
from splatnode.recon.keyframes import PLAIN, REFERENCE_SIDE, Features, Keyframe, longer_side, principal_point
from splatnode.recon.matching import features as matching_features
from splatnode.recon.matching.pair_matching import TwoView, find_components
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration import multiview_geometry
from splatnode.recon.registration.mapping_problem import compute_pooled_ratio
from splatnode.recon.registration.registration import RegisteredCamera, Registration
from splatnode.recon.threads import BACKGROUND, RunContext, map_parallel_lazily
from splatnode.recon.verification import refit
from splatnode.recon.verification.refit import Distortion, Errors, FreedLens, PoseErrors

# Cycle consistency: relative poses that single pairs find by themselves, against each other and the registration.

Array = npt.NDArray[np.float64]

MIN_INLIER_RATIO = 0.5  # of a relative pose to be believed: most of its matches support it
MIN_LENGTH = 1e-12  # of two directions, multiplied: shorter ones have no angle between them, which counts as 90 degrees
MIN_SIGMA_DEG = 0.3  # of a direction: what lens and shutter do otherwise than the model
MIN_NOISE_PX = 0.2  # of a match, at REFERENCE_SIDE
MEDIAN_OF_NORMAL = 0.6745  # median size of a normal error over its standard deviation
OUTLIER = 4.0  # times the noise, from which on a match says nothing
LEAST_SLOPE = 1e-6  # of an epipolar line, of rays at depth 1
MIN_INFORMATION = 1e-9  # of an eigenvalue, in place of 0
STEP = 1e-5  # of a rotation or a direction, radians, in differences


class CycleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Cycle consistency: relative poses that single pairs find by themselves, against each other and the
    registration."""

    min_matches: int = 40  # least matches of a pair that is used
    partners: int = 3  # of each frame, those with most matches
    max_matches: int = 400  # matches of a pair that are used; more make a relative pose no surer
    max_error_px: float = 2.5  # largest error of a match, pixels at REFERENCE_SIDE


@dataclass(frozen=True)
class CycleConsistency:
    """Triangles of pairs, each with a relative pose of its own (five points, known focal lengths)."""

    triangles: int
    rotation_deg: float  # median angle that is left after going round; 0 without a triangle
    worst_rotation_deg: float
    direction_deg: float  # median angle between the direction in which a pair sees its partner and the registration's
    direction_sigmas: float  # the same over the standard error that the pair's matches leave of it; 0 without a pair


def measure_cycle_consistency(
    keyframes: Sequence[Keyframe],
    registration: Registration,
    pairs: Mapping[tuple[int, int], TwoView],
    config: CycleConfig,
) -> CycleConsistency:
    cameras = {camera.index: camera for camera in registration.cameras}
    rotations: dict[tuple[int, int], Array] = {}
    directions, sigmas = [], []
    for i, j in _select_strongest_pairs(list(cameras), pairs, config):
        scale = max(longer_side(keyframes[k].frame) for k in (i, j)) / REFERENCE_SIDE
        thinned = _thin_matches(pairs[i, j], config.max_matches)
        rays = [
            cameras[k].normalise(points + principal_point(keyframes[k].frame))
            for k, points in ((i, thinned.points1), (j, thinned.points2))
        ]
        focals = [float(np.sqrt(np.prod(cameras[k].focals))) for k in (i, j)]
        straight = replace(thinned, points1=focals[0] * rays[0], points2=focals[1] * rays[1])
        limit = config.max_error_px * scale
        rotation, direction, num_inliers = multiview_geometry.relative_pose(straight, focals[0], focals[1], limit)
        if num_inliers < MIN_INLIER_RATIO * len(thinned.matches):
            continue  # The pair has no rigid answer for these focal lengths; its inlier ratio says so, too.
        rotations[i, j] = rotation
        T_second_first = np.linalg.inv(cameras[j].T_world_camera) @ cameras[i].T_world_camera
        angle = _compute_angle_between(direction, T_second_first[:3, 3])
        directions.append(angle)
        focal = float(np.mean(focals))
        sigma = estimate_direction_sigma_deg(rays[0], rays[1], rotation, direction, MIN_NOISE_PX * scale / focal)
        sigmas.append(angle / float(np.hypot(sigma, MIN_SIGMA_DEG)))
    left = []
    for i, j, k in combinations(sorted(cameras), 3):
        if (i, j) in rotations and (j, k) in rotations and (i, k) in rotations:
            around = rotations[i, k].T @ rotations[j, k] @ rotations[i, j]
            left.append(float(np.degrees(np.arccos(np.clip((np.trace(around) - 1.0) / 2.0, -1.0, 1.0)))))
    return CycleConsistency(
        triangles=len(left),
        rotation_deg=float(np.median(left)) if left else 0.0,
        worst_rotation_deg=float(np.max(left)) if left else 0.0,
        direction_deg=float(np.median(directions)) if directions else 0.0,
        direction_sigmas=float(np.median(sigmas)) if sigmas else 0.0,
    )


def estimate_direction_sigma_deg(
    rays1: Array, rays2: Array, rotation: Array, direction: Array, least_noise: float
) -> float:
    """The standard error of the direction of motion that a pair's matches leave, degrees; 90 where nothing is known.

    `rays1` and `rays2` (M, 2) at depth 1, the pose from the first camera's axes to the second's. By the Sampson errors'
    Jacobian at the pose; their noise is their median size, at least `least_noise`. With little parallax a rotation does
    almost what a motion does, and a pair cannot know its direction well.
    """
    length = max(float(np.linalg.norm(direction)), MIN_LENGTH)
    unit = direction / length
    aside = np.linalg.svd(unit[None])[2][1:]  # two directions across it

    def errors(step: Array) -> Array:
        turned = rotation + cross_matrix(step[None, :3])[0] @ rotation
        moved = unit + step[3] * aside[0] + step[4] * aside[1]
        return epipolar_errors(cross_matrix(moved[None])[0] @ turned, rays1, rays2, LEAST_SLOPE)

    at = errors(np.zeros(5))
    noise = max(float(np.median(np.abs(at))) / MEDIAN_OF_NORMAL, least_noise)
    near = np.abs(at) < OUTLIER * noise
    jacobian = np.stack([(errors(step) - errors(-step)) / (2 * STEP) for step in STEP * np.eye(5)], 1)[near]
    information = jacobian.T @ jacobian / noise**2
    values, vectors = np.linalg.eigh(information)
    covariance = (vectors / np.maximum(values, MIN_INFORMATION)) @ vectors.T
    return float(min(np.degrees(np.sqrt(np.trace(covariance[3:, 3:]))), 90.0))


def _select_strongest_pairs(
    frames: Sequence[int], pairs: Mapping[tuple[int, int], TwoView], config: CycleConfig
) -> list[tuple[int, int]]:
    """Pairs of registered frames that are among the strongest of one of the two."""
    strong = [
        key
        for key, pair in pairs.items()
        if key[0] in frames and key[1] in frames and len(pair.matches) >= config.min_matches
    ]
    strong.sort(key=lambda key: (-len(pairs[key].matches), key))
    chosen: set[tuple[int, int]] = set()
    for frame in frames:
        chosen.update([key for key in strong if frame in key][: config.partners])
    return sorted(chosen)


def _thin_matches(pair: TwoView, count: int) -> TwoView:
    """The pair with about `count` of its matches, spread evenly over their ranks."""
    if len(pair.matches) <= count:
        return pair
    chosen = np.linspace(0, len(pair.matches) - 1, count).astype(int)
    return pair.select(chosen)


def _compute_angle_between(one: Array, other: Array) -> float:
    lengths = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(one @ other / max(lengths, MIN_LENGTH), -1.0, 1.0))))


# Mirror images among the frames: do some look more like the others when they are turned left to right?
#
# Where a place is symmetric, the mirror image of a photograph fits the others as one taken from the other side, to the
# pixel. But it shows the details that are not symmetric, too, the wrong way round: turned back, it matches better.

Bytes = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]


class ReflectionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Mirror images among the frames: do some look more like the others when they are turned left to right."""

    num_features: int = 1500  # of each frame, the strongest
    by_chance: float = 50.0  # matches of frames that have nothing in common, which say nothing
    partners: int = 4  # known frames with which a further one is compared, those that share most points with it
    # Largest gain of a further frame beside them when mirrored; right ones of ten scenes reach 0.08
    max_further_gain: float = 0.1
    nearest_neighbours: matching_features.NearestNeighbourConfig = matching_features.NearestNeighbourConfig()


@dataclass(frozen=True)
class Reflection:
    """The frames that stand out most as mirror images of what the others show."""

    frames: tuple[str, ...]  # at most half of them
    gain: float  # mean logarithm of the matches of mirrored over plain pairs of one of them and one of the others


def measure_reflection(
    keyframes: Sequence[Keyframe], pairs: Collection[tuple[int, int]], config: ReflectionConfig
) -> Reflection:
    """Measures the reflection of two or more frames over `pairs` (i < j) of their positions."""
    plain = [_select_descriptors(keyframe.features, config.num_features) for keyframe in keyframes]
    mirrored = [mirror_descriptors(descriptors) for descriptors in plain]
    gains, compared = np.zeros((len(plain), len(plain))), np.zeros((len(plain), len(plain)))
    ordered = sorted(pairs)
    of_pairs = map_parallel_lazily(
        lambda pair: _compute_gain(plain[pair[0]], mirrored[pair[1]], plain[pair[1]], config), ordered
    )
    for (i, j), gain in zip(ordered, of_pairs, strict=True):
        gains[i, j] = gains[j, i] = gain
        compared[i, j] = compared[j, i] = 1.0
    grown = [_grow_group(gains, compared, first) for first in range(len(plain))]
    group, gain = grown[int(np.argmax([gain for _, gain in grown]))]  # the first NaN, where there is one
    return Reflection(tuple(keyframes[index].name for index in np.flatnonzero(group).tolist()), gain)


def measure_further(further: Keyframe, known: Sequence[Keyframe], config: ReflectionConfig) -> Reflection:
    """Measures the reflection of a further frame beside frames that are the right way round."""
    descriptors = _select_descriptors(further.features, config.num_features)
    mirrored = mirror_descriptors(descriptors)
    others = (_select_descriptors(keyframe.features, config.num_features) for keyframe in known)
    gains = [_compute_gain(other, mirrored, descriptors, config) for other in others]
    return Reflection((further.name,), float(np.mean(gains)))


def select_strongest_reflection(found: Sequence[Reflection]) -> Reflection:
    """The one with the largest gain; the first whose gain is NaN, where there is one."""
    return found[int(np.argmax([each.gain for each in found]))]


def _compute_gain(other: Bytes, mirrored: Bytes, plain: Bytes, config: ReflectionConfig) -> float:
    """The logarithm of the matches that a frame has with another one when it is mirrored, over those as it is."""
    found, expected = (
        len(matching_features.match(other, descriptors, config.nearest_neighbours)) + config.by_chance
        for descriptors in (mirrored, plain)
    )
    return float(np.log(found / expected))


def _select_descriptors(features: Features, count: int) -> Bytes:
    return features.select_tilt(PLAIN).descriptors[:count]


def mirror_descriptors(descriptors: Bytes) -> Bytes:
    """SIFT descriptors (M, 128) as they are in the mirrored image.

    They are histograms of 8 directions in 4 x 4 cells, along and across the direction of the keypoint: mirroring
    reverses the rows of cells across it, and the sense of the directions.
    """
    cells = descriptors.reshape(-1, 4, 4, 8)
    return np.ascontiguousarray(cells[:, ::-1][..., -np.arange(8) % 8].reshape(-1, 128))


def _grow_group(gains: Array, compared: Array, first: int) -> tuple[Flags, float]:
    """The group with the largest mean gain across its border, grown from one frame by the frame that suits best.

    Pairs that are not `compared` (1, else 0) have a gain of 0 and do not count.
    """
    group = np.zeros(len(gains), bool)
    group[first] = True
    total, count = gains[first].sum(), compared[first].sum()
    best = group.copy(), float(_compute_mean(total, count))
    while 2 * (group.sum() + 1) <= len(gains):
        # A frame that joins the group takes its pairs with the group from the border, and adds those with the others.
        totals = total + gains @ ~group - gains @ group
        counts = count + compared @ ~group - compared @ group
        means = np.where(group, -np.inf, _compute_mean(totals, counts))
        other = int(means.argmax())
        group[other], total, count = True, totals[other], counts[other]
        if means[other] > best[1]:
            best = group.copy(), float(means[other])
    return best


def _compute_mean(total: Array, count: Array) -> Any:
    """Minus infinity where nothing was compared."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count > 0, total / count, -np.inf)


# Evidence: numbers that speak for or against a registration, each from a source of its own.

# The weakest link: the last edge of the maximum spanning tree of the cameras, over the points that pairs share.

MIN_CONSISTENT_SHARE = 0.6  # of a pair's matches that the poses explain, for it to connect its frames
MIN_CONSISTENT_MATCHES = 20  # that the poses explain, for a pair to connect its frames


@dataclass(frozen=True)
class WeakestLink:
    """Two places that a few chance matches connect are each right by themselves: only what connects them tells."""

    smaller_part: tuple[str, ...]  # its keyframes, by name
    shared_points: int  # of the pairs of frames across the link, summed
    matches: int  # of the verified pairs across it
    inliers: float  # of these, how many the poses explain

    @property
    def inlier_ratio(self) -> float:
        """Returns the share of the matches across the link that the poses explain; 0 without any."""
        return float(self.inliers / np.maximum(1, self.matches))  # NaN where one of them is


def measure_weakest_link(
    registration: Registration,
    names: Sequence[str],
    pairs: Mapping[tuple[int, int], TwoView],
) -> WeakestLink:
    """Measures the link between the two parts that the last edge of the maximum spanning tree joins.

    `names` are those of all keyframes.
    """
    indices = [camera.index for camera in registration.cameras]
    shared = count_shared_points(registration)
    one, other = _split_at_weakest_link(indices, shared)
    across = [(i, j) for i in one for j in other]
    verified = [key for i, j in across if (key := (min(i, j), max(i, j))) in registration.inlier_ratios]
    return WeakestLink(
        smaller_part=tuple(names[index] for index in sorted(min(one, other, key=len))),
        shared_points=int(sum(shared[pair] for pair in across)),
        matches=sum(len(pairs[key].matches) for key in verified),
        inliers=sum(registration.inlier_ratios[key] * len(pairs[key].matches) for key in verified),
    )


def find_disconnected_frames(registration: Registration, pairs: Mapping[tuple[int, int], TwoView]) -> tuple[int, ...]:
    """Keyframes, by position, outside the largest component of geometrically consistent pairs.

    Frames that pose as others, as mirror images of a symmetric place do, fit well with each other, and with the rest
    only where the place repeats.
    """
    consistent = [
        key
        for key, share in registration.inlier_ratios.items()
        if share >= MIN_CONSISTENT_SHARE and share * len(pairs[key].matches) >= MIN_CONSISTENT_MATCHES
    ]
    _, *rest = find_components([camera.index for camera in registration.cameras], consistent)
    return tuple(sorted(index for part in rest for index in part))


def count_shared_points(registration: Registration) -> npt.NDArray[np.int64]:
    """(M, M) how many points each two frames both observe."""
    size = max(camera.index for camera in registration.cameras) + 1
    seen = np.zeros((size, len(registration.points)), np.int64)
    seen[registration.observed_by, registration.observed_point] = 1
    return seen @ seen.T


def _split_at_weakest_link(indices: list[int], shared: npt.NDArray[np.int64]) -> tuple[list[int], list[int]]:
    """The parts without the edge that Kruskal's algorithm adds last, most shared points first: the larger, the rest."""
    links = sorted(
        ((i, j) for place, i in enumerate(indices) for j in indices[:place]),
        key=lambda pair: (-shared[pair], pair),
    )
    taken: list[tuple[int, int]] = []
    for link in links:
        parts = find_components(indices, [*taken, link])
        if len(parts) == 1:
            break
        taken.append(link)
    first, *rest = find_components(indices, taken)
    return first, [index for part in rest for index in part]


@dataclass(frozen=True)
class CameraEvidence:
    """The evidence for the pose of one camera."""

    name: str
    inlier_ratio: float  # of its matches, in all verified pairs: those that the poses explain
    confirmed: int  # points of it that at least two other cameras see
    coverage: float  # share of its picture that its points fill: of a box around nearly all of them
    flat_share: float  # of the matches of its flattest pair: those that one homography explains
    gain: float  # of its exposure, over that of most cameras
    errors: PoseErrors
    focal: Errors  # of the logarithm of its focal length
    own_lens: bool  # its lens is not what it was taken for: it refutes the one that it shares, or that was given
    # Its focal length over the one that a calibration gives, where it refutes that; 1: it does not; 0: there is none
    refuted_focal: float = 0.0
    inset: bool = False  # what it shares with the others fills a small part of it, through an unusual lens of its own


@dataclass(frozen=True)
class Evidence:
    """The evidence for or against a registration."""

    cameras: tuple[CameraEvidence, ...]
    inlier_ratio: float  # of all matches of verified pairs: those that the poses explain
    weakest_link: WeakestLink
    disconnected: tuple[str, ...]  # frames outside the largest component of geometrically consistent pairs
    reflection: Reflection  # the frames that stand out most as mirror images
    flatness: float  # share of the points on one plane
    mirrored_cost: float  # of the mirrored answer over that of this one
    cycles: CycleConsistency
    median_angle_deg: float
    rms_px: float
    focal: Errors  # of the logarithm of the least certain focal length
    travel: float  # RMS distance of the centres from their mean; the distance to the scene is 1
    freed: tuple[FreedLens, ...]  # lenses that came with the frames
    distortion: Distortion
    unknown_lenses: int = 0  # lenses of which nothing but the images tells
    own_lens_cost: float = 1.0  # robust cost with a lens for each camera, over that with the lenses that were found
    shifted_share: float = 0.0  # least share of two cameras' points that moved in a few pieces, as wholes


# Pieces that were moved as wholes, as those of a montage: two of them, shifted by different lengths, look like two
# walls that face the camera, and a camera beside it fits. Among three images, a principal point or a focal length that
# nobody knows takes up what does not.

MAX_PIECES = 6
PIECE_PX = 0.5  # largest difference of a piece's shifts, pixels at REFERENCE_SIDE
PIECES_APART_PX = 4.0  # least difference of two pieces' shifts: those of a camera that turned change little by little
FEWEST_SHARED = 40  # points of two cameras that are asked
PERSPECTIVE_SHARE = 0.5  # of the points of two cameras: as few in pieces are no montage, and no other pair is asked


def measure_shifted_share(keyframes: Sequence[Keyframe], registration: Registration) -> float:
    """Measures the share of two cameras' points that at most MAX_PIECES shifts explain: the least of all pairs.

    It is 0 where one shift explains each pair, as of a camera that did not move. Perspective changes shifts from point
    to point: of 251 pairs of photographs .26 is the largest share.
    """
    seen = [_list_observed(registration, c.index, keyframes[c.index]) for c in registration.cameras]
    least, montage = 1.0, False
    for (points, pixels), (others, other_pixels) in combinations(seen, 2):
        _, at, other_at = np.intersect1d(points, others, return_indices=True)
        if len(at) < FEWEST_SHARED:
            continue
        pieces = _count_pieces(other_pixels[other_at] - pixels[at])
        least, montage = min(least, sum(pieces) / len(at)), montage or len(pieces) > 1
        if least < PERSPECTIVE_SHARE:
            break
    return least if montage else 0.0


def _list_observed(
    registration: Registration, index: int, keyframe: Keyframe
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Lists the points that a camera observes, and their pixels at REFERENCE_SIDE."""
    (mine,) = np.nonzero(registration.observed_by == index)
    scale = longer_side(keyframe.frame) / REFERENCE_SIDE
    return registration.observed_point[mine], registration.observed_pixels[mine] / scale


def _count_pieces(shifts: npt.NDArray[np.float64]) -> list[int]:
    """Counts the points of each piece, of the largest number of points that one shift explains on."""
    pieces: list[int] = []
    left = shifts
    while len(left) and len(pieces) < MAX_PIECES:
        near = KDTree(left).query_ball_point(left, PIECE_PX, return_length=True)
        apart = np.linalg.norm(left - left[int(np.argmax(near))], axis=1)
        pieces.append(int((apart <= PIECE_PX).sum()))
        left = left[apart > PIECES_APART_PX]
    return pieces


# How differently the frames are exposed: the brightness of the same points in all of them.

DARK, BRIGHT = 12.0, 243.0  # grey levels of 255; what is near black or white says nothing about a gain
ROUNDS = 3  # each compares a frame with the mean of the others as it is known so far


def estimate_gains(
    greys: Mapping[int, npt.NDArray[np.float32]], registration: Registration, scales: Mapping[int, tuple[float, float]]
) -> dict[int, float]:
    """Each frame's gain: its points' grey levels over those of the same points in the other frames, 1 on average.

    `greys` are the pictures at modelled size by frame, `scales` their size over the frame's.
    """
    values = np.full(len(registration.observed_by), np.nan)
    for index, grey in greys.items():
        mine = registration.observed_by == index
        at = (registration.observed_pixels[mine] * scales[index]).astype(int)
        values[mine] = grey[np.clip(at[:, 1], 0, grey.shape[0] - 1), np.clip(at[:, 0], 0, grey.shape[1] - 1)]
    logs = np.where((values > DARK) & (values < BRIGHT), np.log(np.maximum(values, 1.0)), np.nan)
    found = dict.fromkeys(greys, 0.0)
    for _ in range(ROUNDS):
        corrected = logs - np.array([found.get(int(index), 0.0) for index in registration.observed_by])
        known = np.isfinite(corrected)
        total = np.bincount(registration.observed_point[known], corrected[known], minlength=len(registration.points))
        count = np.bincount(registration.observed_point[known], minlength=len(registration.points))
        mean = (total / np.maximum(count, 1))[registration.observed_point]
        found = {
            index: found[index] + _median((corrected - mean)[known & (registration.observed_by == index)])
            for index in greys
        }
    middle = _median(np.array(list(found.values())))
    return {index: float(np.exp(value - middle)) for index, value in found.items()}


def _median(values: npt.NDArray[np.float64]) -> float:
    return float(np.median(values)) if len(values) else 0.0


# Which numbers could not be computed: NaN and infinity in a record, found by walking all of its fields.


def find_non_finite(record: object, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The path of every number in `record` that is NaN or infinite: field names, positions and keys, outermost first.

    Walks dataclasses, mappings, tuples, lists and numeric arrays; an array counts as one number. A field that is added
    to a record is walked without a change here.
    """
    if is_dataclass(record) and not isinstance(record, type):
        parts = ((field.name, getattr(record, field.name)) for field in fields(record))
    elif isinstance(record, Mapping):
        parts = ((str(key), value) for key, value in record.items())
    elif isinstance(record, tuple | list):
        parts = ((str(position), value) for position, value in enumerate(record))
    else:
        if isinstance(record, int | float | np.number | np.ndarray) and not np.isfinite(record).all():
            yield path
        return
    for name, value in parts:
        yield from find_non_finite(value, (*path, name))


# Is all that was reconstructed one plane? Then a flat thing that moves may have been taken for the scene.


NEAR = 0.01  # distance from a plane that counts as on it, in median depths
_SAMPLE = 400  # points that are looked at: the share is known to 2.5 % (one standard error)
_PLANES = 300  # tried, each through three of them
_SLIVER = 1e-4  # twice the area of a triangle that defines no plane


def compute_share_on_plane(points: Array, seed: int = 0) -> float:
    """The largest share of `points` (P, 3), whose median depth is 1, that lies on one plane (RANSAC); 0 without any.

    NaN where a point is not finite."""
    if not np.isfinite(points).all():
        return np.nan
    if len(points) < 3:
        return 0.0
    rng = np.random.default_rng(seed)
    sample = points[rng.permutation(len(points))[:_SAMPLE]]
    corners = sample[np.stack([rng.permutation(len(sample))[:3] for _ in range(_PLANES)])]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    wide = lengths > _SLIVER
    if not wide.any():
        return 0.0
    normals = normals[wide] / lengths[wide, None]
    offsets = (normals * corners[wide, 0]).sum(1)
    return float((np.abs(sample @ normals.T - offsets) < NEAR).mean(0).max())


# The verification of a registration: evidence from sources that the fit did not use, or used otherwise.


OUTSIDE = 0.03  # share of a camera's points on each side that the box of its coverage leaves out: wrong matches
MIN_MATCHES = 60  # of a pair whose homography says something: fewer are explained by chance


class VerificationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The verification of a registration: evidence from sources that the fit did not use, or used otherwise."""

    tracks_per_camera: int = 300  # tracks of a camera in the bundle that is adjusted again
    cycles: CycleConfig = CycleConfig()
    reflection: ReflectionConfig = ReflectionConfig()


def verify(
    graph: ViewGraph,
    registration: Registration | None,
    config: VerificationConfig,
    run: RunContext = BACKGROUND,
) -> Evidence | None:
    """Numbers for and against `registration`; None where it has fewer than two cameras.

    It pauses between the sources of evidence, which may raise to abandon the work.
    """
    if registration is None or len(registration.cameras) < 2:
        return None
    fit = refit.build_fit(graph.keyframes, registration, config.tracks_per_camera)
    sizes = refit.measure_errors(fit, registration)
    run.pause()
    cameras = _collect_camera_evidence(graph, registration, sizes.cameras, sizes.focals)
    run.pause()
    return Evidence(
        cameras=cameras,
        inlier_ratio=compute_inlier_ratio(graph, registration, None),
        weakest_link=measure_weakest_link(registration, graph.names, graph.pairs),
        disconnected=_name_disconnected_frames(graph, registration),
        reflection=_measure_reflection(graph, registration, config.reflection),
        flatness=compute_share_on_plane(registration.points),
        mirrored_cost=refit.compute_reversal_cost_ratio(fit),
        cycles=measure_cycle_consistency(graph.keyframes, registration, graph.pairs, config.cycles),
        median_angle_deg=registration.median_angle_deg,
        rms_px=registration.rms_px,
        focal=sizes.focal,
        travel=refit.compute_travel(registration),
        freed=refit.free_lenses(fit),
        distortion=refit.measure_distortion(fit),
        unknown_lenses=int(np.isnan(fit.given_focals).sum()),
        own_lens_cost=refit.compute_own_lens_cost(fit),
        shifted_share=measure_shifted_share(graph.keyframes, registration),
    )


def verify_further(
    graph: ViewGraph, registration: Registration, known: Evidence, config: VerificationConfig
) -> Evidence | None:
    """Evidence for `registration`, which continues the one that `known` is about: provisional, and quick.

    None where a further photograph may be mirrored: a few partners cannot tell that for certain, all evidence must.

    Measured anew: the cameras that `known` does not have, with their exposure and whether their photographs are
    mirrored; and of all cameras the matches, the weakest link, the plane, angles, errors and the focal length, of which
    the larger uncertainty counts. Reused from `known`, because it says little about one camera more: the known cameras'
    exposures and that they are not mirrored, the jackknife, the scene mirrored in depth, cycles, freed lenses and
    distortion. The pose sigmas of a continuation, which aligns no patches, are too large: they are reduced by as much
    as those of the known cameras are.
    """
    before = {camera.name: camera for camera in known.cameras}
    names = {camera.index: graph.keyframes[camera.index].name for camera in registration.cameras}
    further = {index for index, name in names.items() if name not in before}
    reflections = _measure_further_reflections(graph, registration, names.keys() - further, further, config.reflection)
    if not all(each.gain <= config.reflection.max_further_gain for each in reflections):
        return None
    known_errors = {index: before[name].errors for index, name in names.items() if name in before}
    sizes = refit.extrapolate_pose_errors(registration, known_errors)
    known_focals = {index: before[name].focal for index, name in names.items() if name in before}
    focals = refit.extrapolate_focal_errors(registration, known_focals)
    of_further = {index: sizes[index] for index in further}
    measured = {camera.name: camera for camera in _collect_camera_evidence(graph, registration, of_further, focals)}
    return replace(
        known,
        cameras=tuple(
            replace(
                measured.get(names[camera.index]) or before[names[camera.index]],
                inlier_ratio=compute_inlier_ratio(graph, registration, camera.index),
                errors=sizes[camera.index],
                focal=focals[camera.index],
            )
            for camera in registration.cameras
        ),
        inlier_ratio=compute_inlier_ratio(graph, registration, None),
        weakest_link=measure_weakest_link(registration, graph.names, graph.pairs),
        disconnected=_name_disconnected_frames(graph, registration),
        reflection=select_strongest_reflection([known.reflection, *reflections]),
        flatness=compute_share_on_plane(registration.points),
        median_angle_deg=registration.median_angle_deg,
        rms_px=registration.rms_px,
        focal=refit.combine_worst(focals.values()),
        travel=refit.compute_travel(registration),
        shifted_share=measure_shifted_share(graph.keyframes, registration),
    )


def _collect_camera_evidence(
    graph: ViewGraph,
    registration: Registration,
    sizes: Mapping[int, PoseErrors],
    focals: Mapping[int, Errors],
) -> tuple[CameraEvidence, ...]:
    """Collects the evidence of the cameras that `sizes` has, by keyframe."""
    by = registration.observed_by
    times_seen = np.bincount(registration.observed_point, minlength=len(registration.points))
    by_third = times_seen[registration.observed_point] >= 3
    confirmed = np.bincount(registration.observed_by[by_third], minlength=len(graph.keyframes))
    keyframes = {camera.index: graph.keyframes[camera.index] for camera in registration.cameras}
    greys = {index: cv2.cvtColor(keyframe.image, cv2.COLOR_RGB2GRAY) for index, keyframe in keyframes.items()}
    gains = estimate_gains(
        {index: grey.astype(np.float32) for index, grey in greys.items()},
        registration,
        {index: keyframe.scale for index, keyframe in keyframes.items()},
    )
    return tuple(
        CameraEvidence(
            name=keyframes[camera.index].name,
            inlier_ratio=compute_inlier_ratio(graph, registration, camera.index),
            confirmed=int(confirmed[camera.index]),
            coverage=compute_coverage(keyframes[camera.index], registration.observed_pixels[by == camera.index]),
            flat_share=compute_flat_share(graph, camera.index),
            gain=gains[camera.index],
            errors=sizes[camera.index],
            focal=focals[camera.index],
            own_lens=camera.own_lens or camera.displaced or abs(camera.aspect - 1.0) > refit.SQUARE,
            refuted_focal=_compute_refuted_focal(camera, keyframes[camera.index]),
            inset=_is_inset(camera, keyframes[camera.index], registration),
        )
        for camera in registration.cameras
        if camera.index in sizes
    )


_MAX_INSET = 0.3  # of a picture, that a picture in it fills; a photograph among shorter lenses' fills less of theirs
_DISPLACED = 0.05  # of the longer side: a principal point that is so far from the middle is that of a part
_USUAL = 0.5, 2.5  # focal lengths over the longer side, of nearly all cameras


def _is_inset(camera: RegisteredCamera, keyframe: Keyframe, registration: Registration) -> bool:
    """Whether a camera may see a picture in its picture, as a poster of the place: that has another lens.

    Its points lie in a small box, through a lens that no other camera has, and that is displaced, or very long or
    short. A picture in a picture whose lens is held to the middle comes out as very long.
    """
    shared = Counter(each.lens for each in registration.cameras)
    if shared[camera.lens] > 1 or max(shared.values()) == 1:
        return False
    frame, side = keyframe.frame, longer_side(keyframe.frame)
    shown = 1.0 if frame.mask is None else _compute_box_share(frame.mask)
    pixels = registration.observed_pixels[registration.observed_by == camera.index]
    if compute_coverage(keyframe, pixels) >= _MAX_INSET * shown:
        return False
    displaced = float(np.abs(camera.principal - principal_point(frame)).max()) / side
    return displaced > _DISPLACED or not _USUAL[0] <= camera.focal / side <= _USUAL[1]


def _compute_box_share(mask: npt.NDArray[np.bool_]) -> float:
    """The share of the picture in the box around what a mask (H, W) shows, as between black bars."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return float(np.ptp(rows) + 1) * float(np.ptp(columns) + 1) / mask.size if len(rows) else 1.0


def _compute_refuted_focal(camera: RegisteredCamera, keyframe: Keyframe) -> float:
    given = keyframe.frame.intrinsics
    if given is None or given.source not in ("given", "calibration"):
        return 0.0
    return camera.focal / given.fx if camera.own_lens else 1.0


def compute_coverage(keyframe: Keyframe, pixels: Array) -> float:
    """The share of the picture in the box that holds all of `pixels` (M, 2), but for a few on each side."""
    if len(pixels) == 0:
        return 0.0
    least, most = np.quantile(pixels, (OUTSIDE, 1.0 - OUTSIDE), axis=0)
    return float(np.prod((most - least) / (keyframe.frame.width, keyframe.frame.height)))


def compute_flat_share(graph: ViewGraph, index: int) -> float:
    """The largest share of a pair's matches that one homography explains, of the pairs of the keyframe `index`."""
    of_camera = (pair for key, pair in graph.pairs.items() if index in key and len(pair.matches) >= MIN_MATCHES)
    return max((pair.num_homography / len(pair.matches) for pair in of_camera), default=0.0)


def _measure_reflection(graph: ViewGraph, registration: Registration, config: ReflectionConfig) -> Reflection:
    """Measures the registered pairs that are worth matching: each keyframe has enough of them."""
    place = {camera.index: position for position, camera in enumerate(registration.cameras)}
    worth = {(place[i], place[j]) for i, j in graph.select_pairs_worth_matching() if i in place and j in place}
    pairs = {(min(pair), max(pair)) for pair in worth}
    return measure_reflection([graph.keyframes[index] for index in place], pairs, config)


def _measure_further_reflections(
    graph: ViewGraph,
    registration: Registration,
    known: Collection[int],
    further: Collection[int],
    config: ReflectionConfig,
) -> list[Reflection]:
    """Measures each further camera beside the known ones that share most points with it."""
    found = []
    for index in sorted(further):
        others = find_partners(index, known, registration, config.partners)
        beside = [graph.keyframes[other] for other in others]
        found.append(measure_further(graph.keyframes[index], beside, config))
    return found


def _name_disconnected_frames(graph: ViewGraph, registration: Registration) -> tuple[str, ...]:
    return tuple(graph.keyframes[index].name for index in find_disconnected_frames(registration, graph.pairs))


def compute_inlier_ratio(graph: ViewGraph, registration: Registration, index: int | None) -> float:
    """The share of matches that the cameras explain, of all verified pairs or of those of the keyframe `index`."""
    return compute_pooled_ratio(registration.inlier_ratios, graph.pairs, index)


def find_partners(index: int, among: Collection[int], registration: Registration, count: int) -> list[int]:
    """The `count` views of `among` that share most points with the view `index`."""
    mine = registration.observed_point[registration.observed_by == index]
    shared = np.bincount(registration.observed_by[np.isin(registration.observed_point, mine)], minlength=max(among) + 1)
    return sorted((other for other in among if other != index), key=lambda other: (-shared[other], other))[:count]
