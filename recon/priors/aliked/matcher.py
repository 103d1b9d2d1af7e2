"""ALIKED's matches: its keypoints are added to a keyframe's points, which its matches then name."""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.capture.frame import Frame
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.networks.crop import crop, cropped
from splatnode.recon.priors.aliked.network import STRIDE, Aliked, Found


class AlikedMatcher:
    """A `recon.matching.view_graph.Matcher`. The keypoints of a keyframe are its last points."""

    def __init__(self, network: Aliked, longer_side: int, num_keypoints: int) -> None:
        self._network, self._longer_side, self._count = network, longer_side, num_keypoints
        self._found: WeakKeyDictionary[Frame, Found] = WeakKeyDictionary()

    def with_points(self, keyframe: Keyframe) -> Keyframe:
        features, mine = keyframe.features, self._keypoints(keyframe).points.numpy()
        if len(mine) == 0 or np.array_equal(features.points[-len(mine) :], mine):
            return keyframe
        return replace(keyframe, features=replace(features, points=np.concatenate([features.points, mine])))

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> npt.NDArray[np.int64]:
        first, second = self._keypoints(keyframe1), self._keypoints(keyframe2)
        added = [
            len(keyframe.features.points) - len(found.points)
            for keyframe, found in ((keyframe1, first), (keyframe2, second))
        ]
        return mutual(first.descriptors, second.descriptors).numpy() + np.array(added)

    def _keypoints(self, keyframe: Keyframe) -> Found:
        frame = keyframe.frame
        if frame not in self._found:
            self._found[frame] = self._extracted(frame.image)
        return self._found[frame]

    @torch.inference_mode()
    def _extracted(self, image: npt.NDArray[np.uint8]) -> Found:
        """In pixels of an image (H, W, 3)."""
        height, width = image.shape[:2]
        to = crop(width, height, min(self._longer_side, max(width, height)), STRIDE)
        found = self._network(cropped(image, to).permute(2, 0, 1), self._count)
        return replace(found, points=torch.from_numpy(to.to_photograph(found.points.double().numpy())))


def mutual(descriptors1: Tensor, descriptors2: Tensor) -> Tensor:
    """(M, 2) indices of descriptors (*, C) of unit length that are each other's nearest, the most distinct first.

    A match is the more distinct the nearer it is compared with the second-nearest.
    """
    if min(len(descriptors1), len(descriptors2)) < 2:
        return torch.zeros(0, 2, dtype=torch.int64)
    alike = descriptors1 @ descriptors2.T
    best, nearest = alike.topk(2, dim=1)
    forth, back = nearest[:, 0], alike.argmax(0)
    (chosen,) = (back[forth] == torch.arange(len(forth))).nonzero(as_tuple=True)
    squared = (1.0 - best[chosen]).clamp_min(1e-12)
    order = (squared[:, 0] / squared[:, 1]).argsort(stable=True)
    return torch.stack([chosen, forth[chosen]], 1)[order]
