"""XFeat's matches: its keypoints are added to a keyframe's points, which its matches then name."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.priors.xfeat.network import Keypoints, Xfeat

_REMEMBERED = 64  # keyframes whose keypoints are kept: half a megabyte each


@dataclass(frozen=True, eq=False)
class _AddedKeypoints:
    """The keypoints that were added to a keyframe's points."""

    first: int  # number of the keyframe's first point that is one of these
    keypoints: Keypoints

    def is_in(self, keyframe: Keyframe) -> bool:
        """Whether the keyframe has them, at `first`."""
        mine = self.keypoints.points
        return np.array_equal(keyframe.features.points[self.first : self.first + len(mine)], mine)


class XfeatMatcher:
    """A `recon.matching.view_graph.Matcher`."""

    def __init__(self, network: Xfeat, num_keypoints: int) -> None:
        self._network, self._count = network, num_keypoints
        self._added: dict[str, _AddedKeypoints] = {}  # by keyframe, the last ones that were asked about

    def add_points(self, keyframe: Keyframe) -> Keyframe:
        known = self._added.get(keyframe.name)
        if known is not None and known.is_in(keyframe):
            return keyframe
        keypoints = self._network.extract(keyframe.frame.image, self._count)
        features = keyframe.features
        self._added[keyframe.name] = _AddedKeypoints(len(features.points), keypoints)
        while len(self._added) > _REMEMBERED:
            del self._added[next(iter(self._added))]
        points = np.concatenate([features.points, keypoints.points])
        return replace(keyframe, features=replace(features, points=points))

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> npt.NDArray[np.int64]:
        first, second = self._added[keyframe1.name], self._added[keyframe2.name]
        sizes = ((keyframe.frame.width, keyframe.frame.height) for keyframe in (keyframe1, keyframe2))
        size1, size2 = sizes
        return self._network.match(first.keypoints, size1, second.keypoints, size2) + [first.first, second.first]
