"""Whether matches that a prior proposes look alike: its word alone, however consistent, is no evidence."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching.features import describe

Index = npt.NDArray[np.int64]

_MOST = 500  # matches that are looked at
_FEWEST = 9
_PATCH_SIZE = 4.0  # of a keypoint, modelled pixels
_ASIDE = 16.0  # modelled pixels
_REACH = 12.0  # of a patch, modelled pixels
_SIGMAS = 8.0  # above what points aside of the matched ones would reach; patches of neighbours overlap
_LEAST = 0.05  # of the likeness, in [0, 1]: corners look a little more alike than what is beside them


def alike(keyframe1: Keyframe, keyframe2: Keyframe, matches: Index) -> bool:
    """Whether the points of `matches` (M, 2) look more alike than each first one and points aside of the second.

    Noise, other places and other parts of a pattern do not, wherever an invented geometry has put their points; that
    sky looks like sky, at both, says nothing. Few matches cannot show it.
    """
    chosen = matches[:: max(1, len(matches) // _MOST)]
    first, second = (
        keyframe.features.points[points] * keyframe.scale
        for keyframe, points in ((keyframe1, chosen[:, 0]), (keyframe2, chosen[:, 1]))
    )
    inside = _inside(keyframe1, first, _REACH) & _inside(keyframe2, second, _REACH + _ASIDE)
    first, second = first[inside], second[inside]
    if len(first) < _FEWEST:
        return False
    angles = np.random.default_rng(0).uniform(0, 2 * np.pi, len(first))
    aside = _ASIDE * np.stack([np.cos(angles), np.sin(angles)], 1)
    described = _described(keyframe1, first)
    at_match = (described * _described(keyframe2, second)).sum(1)
    beside = [(described * _described(keyframe2, second + sign * aside)).sum(1) for sign in (-1, 1)]
    gain = at_match - np.mean(beside, axis=0)
    return float(gain.mean()) > max(_LEAST, _SIGMAS * float(gain.std()) / np.sqrt(len(first)))


def _inside(keyframe: Keyframe, points: npt.NDArray[np.float64], margin: float) -> npt.NDArray[np.bool_]:
    """(M,): whether each of `points` (M, 2) is that far from the border; patches that are cut off look alike."""
    height, width = keyframe.image.shape[:2]
    return np.asarray(((points > margin) & (points < [width - margin, height - margin])).all(1))


def _described(keyframe: Keyframe, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(M, 128) of unit length: upright patches of the keyframe's image at modelled size, around `points` (M, 2)."""
    grey = np.asarray(cv2.cvtColor(keyframe.image, cv2.COLOR_RGB2GRAY), np.uint8)
    described = describe(grey, points, _PATCH_SIZE).astype(np.float64)
    return described / np.maximum(np.linalg.norm(described, axis=1, keepdims=True), 1e-9)
