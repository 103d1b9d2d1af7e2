"""Keypoints of a map of scores, between its pixels (Zhao et al. 2022, ALIKE, section III-B)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from splatnode.recon.priors.aliked.deformable import make_window

_REACH = 2  # pixels: no two keypoints are as close, and the place of one is measured within it
_MIN_SCORE = 0.2  # of a keypoint, in [0, 1], as published
_TEMPERATURE = 0.1  # of scores, as in training


def detect_keypoints(scores: Tensor, count: int) -> Tensor:
    """(M, 2) x and y of the `count` best maxima of scores (H, W), from the first pixel's centre, the best first.

    A maximum lies at the mean place of the pixels around it, weighed by their scores.
    """
    size = 2 * _REACH + 1
    highest = F.max_pool2d(scores[None, None], size, stride=1, padding=_REACH)[0, 0]
    inner = (slice(_REACH, -_REACH),) * 2  # where all of the window is in the image
    row, column = ((scores == highest) & (scores > _MIN_SCORE))[inner].nonzero(as_tuple=True)
    best = scores[inner][row, column].argsort(descending=True, stable=True)[:count]
    peaks = torch.stack([column[best], row[best]], -1) + _REACH
    around = make_window(size)
    x, y = (peaks[:, None] + around).unbind(-1)
    weights = torch.softmax(scores[y, x] / _TEMPERATURE, dim=1)
    return peaks + weights @ around.to(weights)
