"""Appearance check of matches that a prior proposes: the matched points must look alike.

A network may invent matches between unrelated images whose geometry is consistent. Invented matches look no more alike
than points 16 px away from them.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching.features import describe

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

# Lengths are in pixels of the image at modelled size.
_KEYPOINT_PX = 4.0  # size of the keypoints that are described
_RADIUS_PX = 12.0  # of the patch that a descriptor of that size covers
_OFFSET_PX = 16.0  # from a match to the points that it is compared with: more than a patch's radius
_MAX_MATCHES = 500  # that are examined: more take time and change no decision
_MIN_MATCHES = 9  # with fewer, the mean gain is too uncertain to say anything
_MIN_SIGMAS = 8.0  # of the mean gain above 0, in standard errors; patches of neighbours overlap, so errors are larger
_MIN_GAIN = 0.05  # mean gain in similarity, of 1: corners look a little more alike than what is beside them


def matches_look_alike(keyframe1: Keyframe, keyframe2: Keyframe, matches: Index) -> bool:
    """Whether the points of `matches` (M, 2) look more alike than the first point and points beside the second.

    False for too few matches, and for patches that look alike wherever they lie, as those of sky do.
    """
    chosen = matches[:: max(1, len(matches) // _MAX_MATCHES)]
    points1, points2 = (
        keyframe.features.points[points] * keyframe.scale
        for keyframe, points in ((keyframe1, chosen[:, 0]), (keyframe2, chosen[:, 1]))
    )
    inside = _inside(keyframe1, points1, _RADIUS_PX) & _inside(keyframe2, points2, _RADIUS_PX + _OFFSET_PX)
    points1, points2 = points1[inside], points2[inside]
    if len(points1) < _MIN_MATCHES:
        return False
    angles = np.random.default_rng(0).uniform(0, 2 * np.pi, len(points1))
    offset = _OFFSET_PX * np.stack([np.cos(angles), np.sin(angles)], 1)
    described1 = _describe(keyframe1, points1)
    at_match = (described1 * _describe(keyframe2, points2)).sum(1)
    beside = [(described1 * _describe(keyframe2, points2 + sign * offset)).sum(1) for sign in (-1, 1)]
    gain = at_match - np.mean(beside, axis=0)
    return float(gain.mean()) > max(_MIN_GAIN, _MIN_SIGMAS * float(gain.std()) / np.sqrt(len(points1)))


def _inside(keyframe: Keyframe, points: Array, margin: float) -> npt.NDArray[np.bool_]:
    """(M,) whether `points` (M, 2) are at least `margin` pixels from the border: patches cut off there look alike."""
    height, width = keyframe.image.shape[:2]
    return np.asarray(((points > margin) & (points < [width - margin, height - margin])).all(1))


def _describe(keyframe: Keyframe, points: Array) -> Array:
    """(M, 128) descriptors of unit length of the image at modelled size, upright, at its pixels `points` (M, 2)."""
    grey = np.asarray(cv2.cvtColor(keyframe.image, cv2.COLOR_RGB2GRAY), np.uint8)
    described = describe(grey, points, _KEYPOINT_PX).astype(np.float64)
    return described / np.maximum(np.linalg.norm(described, axis=1, keepdims=True), 1e-9)
