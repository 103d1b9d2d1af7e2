"""Local features: SIFT with many keypoints and root-normalised descriptors, also of squeezed images."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from splatnode.recon.frames.keyframe import Features
from splatnode.recon.matching.nearest_neighbours import quantise

Image = npt.NDArray[np.uint8]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    num_features: int = 8000
    contrast: float = 0.01  # SIFT's contrast threshold; low, because with few views every match counts
    longer_side: int = 1600  # pixels; larger images are shrunk before features are found
    shortest_longer_side: int = 1000  # pixels; smaller images are enlarged: a third more matches at 640 x 480
    snap_px: float = 1.5  # a keypoint of a squeezed image this near to one of the plain image is the same point


def extract(image: Image, config: Config) -> Features:
    """Features of `image` (H, W, 3) RGB, strongest first, one descriptor a point."""
    points, descriptors = _detect(image, 1.0, config)
    return Features(points, descriptors, np.arange(len(points)), np.ones(len(points)))


def add_squeezed(features: Features, image: Image, squeezes: Sequence[float], config: Config) -> Features:
    """`features` of `image` with those that are found after its width has been divided by each of `squeezes`.

    A surface seen from the side is the surface seen from the front but narrower: one tilt, along the axis along which
    people walk, of the views that affine SIFT simulates (Morel and Yu, 2009).
    """
    for squeeze in squeezes:
        if (features.squeeze == squeeze).any():
            continue
        points, descriptors = _detect(image, squeeze, config)
        if len(points) == 0:
            continue
        known = np.full(len(points), -1)
        if len(features.points):
            distance, nearest = KDTree(features.points).query(points)
            known = np.where(distance < config.snap_px * max(image.shape) / 1024.0, nearest, -1)
        new = known < 0
        known[new] = len(features.points) + np.arange(new.sum())
        features = Features(
            points=np.concatenate([features.points, points[new]]),
            descriptors=np.concatenate([features.descriptors, descriptors]),
            point_of=np.concatenate([features.point_of, known]),
            squeeze=np.concatenate([features.squeeze, np.full(len(points), squeeze)]),
        )
    return features


def _detect(image: Image, squeeze: float, config: Config) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8]]:
    """Points (M, 2) in pixels of `image`, strongest first, and their descriptors (M, 128)."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    scale = float(np.clip(1.0, config.shortest_longer_side / max(grey.shape), config.longer_side / max(grey.shape)))
    size = max(1, round(width * scale / squeeze)), max(1, round(height * scale))
    if squeeze > 1.0:
        # As if the narrower image had been taken: SIFT expects a blur of 0.5 pixels and more, along both axes.
        grey = cv2.GaussianBlur(grey, (0, 0), sigmaX=0.8 * float(np.sqrt(squeeze**2 - 1)), sigmaY=0.01)
    if size != (width, height):
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC)
    sift = cv2.SIFT.create(
        nfeatures=config.num_features, contrastThreshold=config.contrast, enable_precise_upscale=True
    )
    keypoints, raw = sift.detectAndCompute(grey, None)
    if len(keypoints) == 0:
        return np.zeros((0, 2)), np.zeros((0, 128), np.uint8)
    order = np.argsort([-keypoint.response for keypoint in keypoints], kind="stable")
    points = (np.array([keypoint.pt for keypoint in keypoints])[order] + 0.5) * (width / size[0], height / size[1])
    return points, root_sift(np.asarray(raw, np.float32)[order])


def describe(grey: Image, points: npt.NDArray[np.float64], size: float) -> npt.NDArray[np.uint8]:
    """(M, 128) descriptors of upright patches of the image (H, W), around `points` (M, 2).

    `size` is that of a keypoint, in pixels: its descriptor looks at 6 times as much.
    """
    if not len(points):
        return np.zeros((0, 128), np.uint8)
    keypoints = [cv2.KeyPoint(float(x), float(y), size, 0.0) for x, y in points - 0.5]
    kept, raw = cv2.SIFT.create().compute(grey, keypoints)
    assert len(kept) == len(points)  # SIFT describes whatever it is given
    return root_sift(np.asarray(raw, np.float32))


def root_sift(raw: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """(M, 128) RootSIFT (Arandjelovic and Zisserman, 2012) of SIFT descriptors: L1-normalised, then square-rooted.

    Their dot product is the Bhattacharyya similarity of two gradient histograms.
    """
    return quantise(np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-9)))
