"""Mutual nearest-neighbour matches with the ratio test."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt
import torch

from recon.keyframe import Features


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    ratio: float = 0.85  # nearest over second-nearest distance; looser than usual, geometry decides later


def match(features1: Features, features2: Features, config: Config) -> npt.NDArray[np.int64]:
    """(M, 2) indices into both feature sets: each is the other's nearest neighbour and clearly nearer than the next."""
    descriptors1, descriptors2 = torch.from_numpy(features1.descriptors), torch.from_numpy(features2.descriptors)
    if len(descriptors1) < 2 or len(descriptors2) < 2:
        return np.zeros((0, 2), np.int64)
    similarity, neighbour = (descriptors1 @ descriptors2.T).topk(2, dim=1)
    distance = (2.0 - 2.0 * similarity).clamp_min(0.0).sqrt()  # of unit vectors
    distinct = (distance[:, 0] < config.ratio * distance[:, 1]).nonzero()[:, 0]
    candidates = neighbour[distinct, 0]
    # Only the few candidates are matched back, which costs a tenth of the full second direction.
    back = (descriptors2[candidates] @ descriptors1.T).argmax(1)
    mutual = back == distinct
    return torch.stack([distinct[mutual], candidates[mutual]], 1).numpy()
