"""ALIKED's matches: its keypoints are added to a keyframe's points, which its matches then name."""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.capture.frame import Frame
from splatnode.extras.priors.aliked.network import STRIDE, Aliked, Keypoints
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.networks.vit import crop, crop_image


class AlikedMatcher:
    """A `recon.matching.view_graph.Matcher`. The keypoints of a keyframe are its last points."""

    def __init__(self, network: Aliked, longer_side: int, num_keypoints: int) -> None:
        self._network, self._longer_side, self._count = network, longer_side, num_keypoints
        self._found: WeakKeyDictionary[Frame, Keypoints] = WeakKeyDictionary()

    def add_points(self, keyframe: Keyframe) -> Keyframe:
        features, mine = keyframe.features, self._find_keypoints(keyframe).points.numpy()
        if len(mine) == 0 or np.array_equal(features.points[-len(mine) :], mine):
            return keyframe
        return replace(keyframe, features=replace(features, points=np.concatenate([features.points, mine])))

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> npt.NDArray[np.int64]:
        first, second = self._find_keypoints(keyframe1), self._find_keypoints(keyframe2)
        added = [
            len(keyframe.features.points) - len(found.points)
            for keyframe, found in ((keyframe1, first), (keyframe2, second))
        ]
        return match_mutual(first.descriptors, second.descriptors).numpy() + np.array(added)

    def _find_keypoints(self, keyframe: Keyframe) -> Keypoints:
        frame = keyframe.frame
        if frame not in self._found:
            self._found[frame] = self._extract_keypoints(frame.image)
        return self._found[frame]

    @torch.inference_mode()
    def _extract_keypoints(self, image: npt.NDArray[np.uint8]) -> Keypoints:
        """In pixels of an image (H, W, 3)."""
        height, width = image.shape[:2]
        to = crop(width, height, min(self._longer_side, max(width, height)), STRIDE)
        found = self._network(crop_image(image, to).permute(2, 0, 1), self._count)
        return replace(found, points=torch.from_numpy(to.map_to_image(found.points.double().numpy())))


def match_mutual(descriptors1: Tensor, descriptors2: Tensor) -> Tensor:
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
