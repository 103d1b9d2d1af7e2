"""Wide-baseline matches: a photograph is warped into the other's view by the network's depth and cameras, then matched.

Descriptors alone decide, anywhere in the two pictures: where the network is right, both look the same from one
viewpoint; where it is wrong, the warped one shows something else, and matches are lost, but none are made up.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching import nearest_neighbours
from splatnode.recon.matching.features import describe
from splatnode.recon.networks.crop import crop_image
from splatnode.recon.priors.da3.inference import CroppedEstimate, Network, estimate_keyframes

Array = npt.NDArray[np.float64]

_KEYPOINT_PX = 6.0  # size of a keypoint, network pixels: its descriptor looks at 6 times as much
_MAX_DISTANCE_PX = 1.0  # from a feature to the origin of the warped pixel that shows it, network pixels
_NOWHERE = -1e4  # the origin of pixels that the first photograph does not show: far outside of it
_MIN_DEPTH = 1e-6  # of a point before the first camera, in the network's unit


@dataclass(frozen=True, eq=False)
class WarpMatcher:
    """A `recon.matching.view_graph.Matcher` of the points that keyframes have."""

    network: Network
    longer_side: int

    def add_points(self, keyframe: Keyframe) -> Keyframe:
        return keyframe

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> npt.NDArray[np.int64]:
        first, second = estimate_keyframes(self.network, [keyframe1, keyframe2], self.longer_side)
        origin = _compute_origins(first, second)
        grey1, grey2 = (
            (crop_image(keyframe.frame.image, answer.crop).mean(-1) * 255).byte().numpy()
            for keyframe, answer in ((keyframe1, first), (keyframe2, second))
        )
        from_u, from_v = np.moveaxis((origin - 0.5).astype(np.float32), -1, 0)
        warped = np.asarray(cv2.remap(grey1, from_u, from_v, cv2.INTER_LINEAR), np.uint8)
        where1, chosen1 = _find_warped_pixels(first.crop.map_to_network(keyframe1.features.points), origin)
        where2 = second.crop.map_to_network(keyframe2.features.points)
        (chosen2,) = np.nonzero(((where2 >= 0) & (where2 < [second.crop.width, second.crop.height])).all(1))
        # Upright and of one size: both pictures are from one viewpoint.
        described1 = describe(warped, where1, _KEYPOINT_PX)
        described2 = describe(grey2, where2[chosen2], _KEYPOINT_PX)
        found = nearest_neighbours.match(described1, described2, nearest_neighbours.NearestNeighbourConfig())
        return np.stack([chosen1[found[:, 0]], chosen2[found[:, 1]]], 1)


def _compute_origins(first: CroppedEstimate, second: CroppedEstimate) -> Array:
    """(H, W, 2): the pixel of the first photograph that shows what each pixel of the second shows; else _NOWHERE."""
    depth, camera2, camera1 = second.estimate.depth, second.estimate.camera, first.estimate.camera
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera2.K).T
    T_first_second = np.linalg.inv(camera1.T_world_camera) @ camera2.T_world_camera
    points = (rays * depth[..., None]) @ T_first_second[:3, :3].T + T_first_second[:3, 3]
    ahead = points[..., 2] > _MIN_DEPTH
    projected = (points @ camera1.K.T)[..., :2] / np.where(ahead, points[..., 2], 1.0)[..., None]
    inside = ahead & (np.abs(projected) < -_NOWHERE).all(-1)
    return np.where(inside[..., None], projected, _NOWHERE)


def _find_warped_pixels(points: Array, origin: Array) -> tuple[Array, npt.NDArray[np.int64]]:
    """(M, 2) pixels of the warped picture that show features `points` (F, 2) of the first photograph; (M,) which."""
    inside = (origin > _NOWHERE).all(-1)
    rows, columns = np.nonzero(inside)
    if not len(rows) or not len(points):
        return np.zeros((0, 2)), np.zeros(0, np.int64)
    distance, nearest = (np.asarray(found) for found in KDTree(origin[inside]).query(points))
    (chosen,) = np.nonzero(distance < _MAX_DISTANCE_PX)
    pixels = np.stack([columns, rows], 1)[nearest[chosen].astype(np.int64)]
    return pixels.astype(np.float64) + 0.5, chosen
