"""Local features: SIFT with many keypoints and root-normalised descriptors."""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from recon.keyframe import Features


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    num_features: int = 8000
    contrast: float = 0.01  # SIFT's contrast threshold; low, because with few views every match counts
    longer_side: int = 1600  # pixels; larger images are shrunk before features are found


def extract(image: npt.NDArray[np.uint8], config: Config) -> Features:
    """Features of `image` (H, W, 3) RGB, strongest first.

    Descriptors are RootSIFT (Arandjelovic and Zisserman, 2012): L1-normalised, then square-rooted, so that their dot
    product is the Bhattacharyya similarity of two gradient histograms.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = min(1.0, config.longer_side / max(grey.shape))
    if scale < 1.0:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    keypoints, raw = cv2.SIFT.create(nfeatures=config.num_features, contrastThreshold=config.contrast).detectAndCompute(
        grey, None
    )
    if len(keypoints) == 0:
        return Features(points=np.zeros((0, 2)), descriptors=np.zeros((0, 128), np.float32))
    order = np.argsort([-keypoint.response for keypoint in keypoints], kind="stable")
    points = (np.array([keypoint.pt for keypoint in keypoints])[order] + 0.5) / scale
    descriptors = np.sqrt(raw[order] / np.maximum(raw[order].sum(1, keepdims=True), 1e-9)).astype(np.float32)
    return Features(points=points, descriptors=descriptors)
