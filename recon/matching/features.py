"""Local features: many SIFT keypoints with RootSIFT descriptors, also of images with a simulated tilt."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from splatnode.capture.process.config import Internal
from splatnode.recon.core import library, pointer
from splatnode.recon.keyframes import PLAIN, REFERENCE_SIDE, Features

# Mutual nearest neighbours with the ratio test (Lowe, 2004), in one native sweep over all descriptor pairs.

Bytes = npt.NDArray[np.uint8]
Index = npt.NDArray[np.int64]
Index32 = npt.NDArray[np.int32]

DESCRIPTOR_SIZE = 128
QUANTISED_NORM = 175.0  # length of a descriptor in bytes: with rounding at most 181, so that products fit 16 bits
_MAX_BYTE = 127  # the core multiplies signed bytes
_TOO_LARGE = "descriptors must have bytes below 128 and norms of at most 181, as `quantise` makes them; some have more"
_MAX_DESCRIPTORS = 65535  # that recon/core/match.cpp is written for
_SCORE_OFFSET = 16320  # `kOffset` of recon/core/match.cpp: keeps scores positive


class NearestNeighbourConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Mutual nearest neighbours with the ratio test (Lowe, 2004), in one native sweep over all descriptor pairs."""

    ratio: float = 0.85  # largest ratio of nearest to second-nearest distance; loose, because geometry decides later


def quantise(descriptors: npt.NDArray[np.float32]) -> Bytes:
    """`descriptors` (M, 128), not negative and of unit length, as bytes below 128; rounding costs 2 % of the length."""
    return np.minimum(np.rint(descriptors * QUANTISED_NORM), _MAX_BYTE).astype(np.uint8)


def match(descriptors1: Bytes, descriptors2: Bytes, config: NearestNeighbourConfig) -> Index:
    """(M, 2) indices into both sets: each is the other's nearest neighbour, and clearly nearer than the second nearest.

    The most distinct match comes first: the one with the lowest ratio of distances. Raises ValueError unless both are
    (*, 128) bytes, as `quantise` makes them, of at most 65535 rows.
    """
    _check(descriptors1, descriptors2)
    count1, count2 = len(descriptors1), len(descriptors2)
    if count1 < 2 or count2 < 2:
        return np.zeros((0, 2), np.int64)
    first, second = np.ascontiguousarray(descriptors1), np.ascontiguousarray(descriptors2)
    nearest, score, second_score = (np.empty(count1, np.int32) for _ in range(3))
    back = np.empty(count2, np.int32)
    problem = library().core_match(
        *(pointer(first), count1, pointer(second), count2),
        *(pointer(nearest), pointer(score), pointer(second_score), pointer(back)),
    )
    if problem:
        raise ValueError(_TOO_LARGE)
    return _distinct(first, nearest, score, second_score, back, config)


def match_near(
    descriptors1: Bytes,
    points1: npt.NDArray[np.float64],  # (M, 2)
    descriptors2: Bytes,
    points2: npt.NDArray[np.float64],  # (N, 2)
    reach: float,
    config: NearestNeighbourConfig,
) -> Index:
    """As `match`, among pairs whose points are nearer than `reach` alone; what has one such neighbour is distinct.

    Points are pixels of one picture, finite; `reach` is positive. Raises ValueError also where they are not.
    """
    _check(descriptors1, descriptors2)
    count1, count2 = len(descriptors1), len(descriptors2)
    places = [np.ascontiguousarray(points, np.float32) for points in (points1, points2)]
    for points, count in zip(places, (count1, count2), strict=True):
        if points.shape != (count, 2) or not np.isfinite(points).all():
            raise ValueError(f"points must be ({count}, 2) and finite, got {points.shape}")
    if not (math.isfinite(reach) and reach > 0):
        raise ValueError(f"reach must be positive, got {reach}")
    first, second = np.ascontiguousarray(descriptors1), np.ascontiguousarray(descriptors2)
    nearest, score, second_score = (np.empty(count1, np.int32) for _ in range(3))
    back = np.empty(count2, np.int32)
    problem = library().core_match_near(
        *(pointer(first), pointer(places[0]), count1, pointer(second), pointer(places[1]), count2),
        *(ctypes.c_float(reach), pointer(nearest), pointer(score), pointer(second_score), pointer(back)),
    )
    if problem:
        raise ValueError(_TOO_LARGE)
    return _distinct(first, nearest, score, second_score, back, config)


def _check(*sets: Bytes) -> None:
    for descriptors in sets:
        if descriptors.dtype != np.uint8 or descriptors.ndim != 2 or descriptors.shape[1] != DESCRIPTOR_SIZE:
            raise ValueError(f"descriptors must be (M, 128) uint8, got {descriptors.shape} {descriptors.dtype}")
        if len(descriptors) > _MAX_DESCRIPTORS:
            raise ValueError(f"at most {_MAX_DESCRIPTORS} descriptors can be matched, got {len(descriptors)}")


def _distinct(
    first: Bytes, nearest: Index32, score: Index32, second_score: Index32, back: Index32, config: NearestNeighbourConfig
) -> Index:
    """The pairs that are each other's nearest and pass the ratio test, the most distinct first."""
    (there,) = np.nonzero(nearest >= 0)
    chosen = there[back[nearest[there]] == there]
    squared_norm = (first[chosen].astype(np.int32) ** 2).sum(1)
    nearest_squared, second_squared = (
        np.maximum(squared_norm + 2 * (_SCORE_OFFSET - value[chosen]), 0) for value in (score, second_score)
    )
    good = nearest_squared < config.ratio**2 * second_squared
    ratios = nearest_squared[good] / np.maximum(second_squared[good], 1)
    chosen = chosen[good][np.argsort(ratios, kind="stable")]
    return np.stack([chosen, nearest[chosen]], 1).astype(np.int64)


# SIFT features (Lowe, 2004) with RootSIFT descriptors (Arandjelovic and Zisserman, 2012), by the native core.


def detect(grey: Bytes, most: int, contrast: float) -> tuple[npt.NDArray[np.float32], Bytes]:
    """The `most` strongest features of `grey` (H, W), the strongest first.

    Their points (M, 2) are pixels whose centres are whole numbers, their descriptors (M, 128) bytes of length
    `QUANTISED_NORM`. The image is enlarged to twice its size first; `contrast` is the least contrast of a feature,
    images being in [0, 1]. Raises ValueError where `grey` is not (H, W) bytes, or is empty.
    """
    if grey.dtype != np.uint8 or grey.ndim != 2 or not grey.size:
        raise ValueError(f"the image must be (H, W) uint8, got {grey.shape} {grey.dtype}")
    grey = np.ascontiguousarray(grey)
    points, descriptors = np.empty((most, 2), np.float32), np.empty((most, DESCRIPTOR_SIZE), np.uint8)
    height, width = grey.shape
    limits = most, ctypes.c_float(contrast), ctypes.c_float(QUANTISED_NORM)
    count = library().core_sift(pointer(grey), width, height, *limits, pointer(points), pointer(descriptors))
    return points[:count].copy(), descriptors[:count].copy()


Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

_TILT_BLUR = 0.8  # sigma over sqrt(tilt^2 - 1), pixels: against aliasing when a side shrinks (Morel and Yu, 2009)
MASK_MARGIN = 0.008  # of the longer side: nearer to what a mask hides, a feature describes its edge
_NO_BLUR = 0.01  # sigma, pixels, along the other side: OpenCV takes 0 for "as along the width"


class FeatureConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Local features: many SIFT keypoints with RootSIFT descriptors, also of images with a simulated tilt."""

    max_num_features: int = 8000  # of an image, at most: the strongest
    contrast: Internal[float] = 0.01  # SIFT's contrast threshold; low, because with few views every match counts
    max_image_size: int = 1600  # larger images are shrunk before features are found, pixels
    min_longer_side: Internal[int] = 1000  # smaller images are enlarged, pixels: a third more matches at 640 x 480
    # Pixels at REFERENCE_SIDE: a keypoint of a tilted image this near to a known point is that point
    snap_px: Internal[float] = 1.5


def extract(image: Image, config: FeatureConfig) -> Features:
    """Features of `image` (H, W, 3) RGB, the strongest first, with one descriptor a point."""
    points, descriptors = _detect(image, 1.0, config)
    return Features(points, descriptors, np.arange(len(points)), np.ones(len(points)))


def apply_mask(features: Features, mask: npt.NDArray[np.bool_] | None, first: int = 0) -> Features:
    """Those that lie well inside of what `mask` (H, W) of their image uses; None: all.

    Points before the `first` stay, hidden or not: matches know them by their numbers.
    """
    if mask is None:
        return features
    inside = well_inside(mask)
    keep = inside[tuple(np.minimum(features.points.astype(np.int64), np.array(mask.shape)[::-1] - 1).T[::-1])]
    keep[:first] = True
    number = np.cumsum(keep) - 1
    described = keep[features.point_of]
    return Features(
        features.points[keep],
        features.descriptors[described],
        number[features.point_of[described]],
        features.tilt[described],
    )


def well_inside(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """(H, W) the pixels farther than the margin from what `mask` hides."""
    side = 2 * max(1, round(MASK_MARGIN * max(mask.shape))) + 1
    return cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def add_affine_features(features: Features, image: Image, tilts: Sequence[float], config: FeatureConfig) -> Features:
    """Adds to the `features` of `image` (H, W, 3) RGB those of the image with its width divided by each of `tilts`.

    Narrowing simulates that a frontal surface is seen from the side; a tilt below 1 multiplies the height instead, as
    if the surface were seen from above or below. These are tilts of affine SIFT (Morel and Yu, 2009) along the image's
    axes. Tilts that `features` has already are left out.
    """
    for tilt in tilts:
        if (features.tilt == tilt).any():
            continue
        points, descriptors = _detect(image, tilt, config)
        if len(points) == 0:
            continue
        point_of = np.full(len(points), -1)
        if len(features.points):
            distance, nearest = KDTree(features.points).query(points)
            point_of = np.where(distance < config.snap_px * max(image.shape) / REFERENCE_SIDE, nearest, -1)
        new = point_of < 0
        point_of[new] = len(features.points) + np.arange(new.sum())
        features = Features(
            points=np.concatenate([features.points, points[new]]),
            descriptors=np.concatenate([features.descriptors, descriptors]),
            point_of=np.concatenate([features.point_of, point_of]),
            tilt=np.concatenate([features.tilt, np.full(len(points), tilt)]),
        )
    return features


def count_search_pixels(image: Image, config: FeatureConfig) -> float:
    """In how many pixels the features of `image` (H, W, 3) are looked for."""
    return image.shape[0] * image.shape[1] * _search_scale(image, config) ** 2


def _search_scale(image: Image, config: FeatureConfig) -> float:
    """Returns the factor by which `image` is resized before its features are detected."""
    longer = max(image.shape[:2])
    return float(np.clip(1.0, config.min_longer_side / longer, config.max_image_size / longer))


def _detect(image: Image, tilt: float, config: FeatureConfig) -> tuple[Array, npt.NDArray[np.uint8]]:
    """Points (M, 2) in pixels of `image`, the strongest first, and their descriptors (M, 128)."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    scale = _search_scale(image, config)
    size = max(1, round(width * scale / max(tilt, 1.0))), max(1, round(height * scale * min(tilt, 1.0)))
    if tilt != 1.0:
        blur = _TILT_BLUR * float(np.sqrt(max(tilt, 1.0 / tilt) ** 2 - 1))
        sigma_x, sigma_y = (blur, _NO_BLUR) if tilt > 1.0 else (_NO_BLUR, blur)
        grey = cv2.GaussianBlur(grey, (0, 0), sigmaX=sigma_x, sigmaY=sigma_y)
    if size != (width, height):
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC)
    points, descriptors = detect(np.asarray(grey, np.uint8), config.max_num_features, config.contrast)
    # The detector's pixel centres are whole numbers; ours are at halves.
    return (points.astype(np.float64) + 0.5) * (width / size[0], height / size[1]), descriptors


def describe(grey: Image, points: Array, size: float) -> npt.NDArray[np.uint8]:
    """(M, 128) RootSIFT descriptors of upright keypoints of the image `grey` (H, W), at its pixels `points` (M, 2).

    `size` is the diameter of a keypoint in pixels; its descriptor covers a square 6 times as wide.
    """
    if not len(points):
        return np.zeros((0, DESCRIPTOR_SIZE), np.uint8)
    keypoints = [cv2.KeyPoint(float(x), float(y), size, 0.0) for x, y in points - 0.5]
    kept, raw = cv2.SIFT.create().compute(grey, keypoints)
    assert len(kept) == len(points)  # SIFT describes every keypoint that it is given
    return root_sift(np.asarray(raw, np.float32))


def root_sift(raw: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """(M, 128) RootSIFT (Arandjelovic and Zisserman, 2012) of SIFT descriptors: L1-normalised, then square-rooted.

    Their dot product is the Bhattacharyya similarity of two gradient histograms.
    """
    return quantise(np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-9)))


# A code of a whole image, made of its features: images of one place have similar codes.
#
# The code is VLAD (Jegou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010)
# without a learned codebook: its words are fixed random directions. Each word's sum of descriptors has unit length
# ("All about VLAD", Arandjelovic and Zisserman, CVPR 2013), and what all descriptors have in common is taken out.

Code = npt.NDArray[np.float32]

_WORDS = 64
_MIN_NORM = 1e-9


def compute_global_descriptor(features: Features) -> Code:
    """(64 * 128,) the code of the plain features, of unit length; zeros where there are none."""
    descriptors = features.select_tilt(PLAIN).descriptors.astype(np.float32) / QUANTISED_NORM
    code = np.zeros((_WORDS, DESCRIPTOR_SIZE), np.float32)
    if not len(descriptors):
        return code.ravel()
    descriptors -= descriptors.mean(0)
    directions = np.random.default_rng(0).normal(size=(DESCRIPTOR_SIZE, _WORDS)).astype(np.float32)
    word = (descriptors @ (directions / np.linalg.norm(directions, axis=0))).argmax(1)
    order = np.argsort(word, kind="stable")
    words, first = np.unique(word[order], return_index=True)
    code[words] = np.add.reduceat(descriptors[order], first, axis=0)
    code /= np.maximum(np.linalg.norm(code, axis=1, keepdims=True), _MIN_NORM)
    return code.ravel() / np.sqrt(np.float32(len(words)))


def similarities(codes: Sequence[Code]) -> npt.NDArray[np.float32]:
    """(N, N) cosines of the codes, once what all of them have in common is taken out."""
    centred = np.stack(codes) - np.mean(codes, axis=0)
    centred /= np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), _MIN_NORM)
    return centred @ centred.T
