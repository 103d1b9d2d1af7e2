"""Local features: many SIFT keypoints with RootSIFT descriptors, also of images with a simulated tilt."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from splatnode.recon.frames.keyframe import REFERENCE_SIDE, Features
from splatnode.recon.matching import sift
from splatnode.recon.matching.nearest_neighbours import DESCRIPTOR_SIZE, quantise

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

_TILT_BLUR = 0.8  # sigma over sqrt(tilt^2 - 1), pixels: against aliasing when a side shrinks (Morel and Yu, 2009)
MASK_MARGIN = 0.008  # of the longer side: nearer to what a mask hides, a feature describes its edge
_NO_BLUR = 0.01  # sigma, pixels, along the other side: OpenCV takes 0 for "as along the width"


class FeatureConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    num_features: int = 8000  # of an image, at most: the strongest
    contrast: float = 0.01  # SIFT's contrast threshold; low, because with few views every match counts
    max_longer_side: int = 1600  # larger images are shrunk before features are found, pixels
    min_longer_side: int = 1000  # smaller images are enlarged, pixels: a third more matches at 640 x 480
    # Pixels at REFERENCE_SIDE: a keypoint of a tilted image this near to a known point is that point
    snap_px: float = 1.5


def extract(image: Image, config: FeatureConfig) -> Features:
    """Features of `image` (H, W, 3) RGB, the strongest first, with one descriptor a point."""
    points, descriptors = _detect(image, 1.0, config)
    return Features(points, descriptors, np.arange(len(points)), np.ones(len(points)))


def apply_mask(features: Features, mask: npt.NDArray[np.bool_] | None) -> Features:
    """Those that lie well inside of what `mask` (H, W) of their image uses; None: all."""
    if mask is None:
        return features
    inside = well_inside(mask)
    keep = inside[tuple(np.minimum(features.points.astype(np.int64), np.array(mask.shape)[::-1] - 1).T[::-1])]
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
    return float(np.clip(1.0, config.min_longer_side / longer, config.max_longer_side / longer))


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
    points, descriptors = sift.detect(np.asarray(grey, np.uint8), config.num_features, config.contrast)
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
