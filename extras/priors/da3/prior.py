"""Depth Anything 3 as a prior: it proposes matches, and gives depth once it was told the verified cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import KDTree
from torch import Tensor

from splatnode.capture.process.config_keys import Internal
from splatnode.extras.priors.da3.network import DepthEstimate, PlacedCamera, load_network
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching import features
from splatnode.recon.matching.features import describe
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.networks.vit import PATCH, Crop, crop, crop_image, normalize_image
from splatnode.recon.networks.weights import find
from splatnode.recon.priors.monocular import make_registered_pointmap
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.priors.prior import Prior
from splatnode.recon.registration.registration import Registration

# Keyframes through the network together, all at one size.


class Network(Protocol):
    """The interface of the prior's network; `DepthAnything3` implements it."""

    def __call__(self, images: Tensor, cameras: Sequence[PlacedCamera] | None = None) -> list[DepthEstimate]: ...


@dataclass(frozen=True, eq=False)
class KnownCamera:
    """A camera of a photograph at full size."""

    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    focal: float  # pixels


@dataclass(frozen=True, eq=False)
class CroppedEstimate:
    """The network's estimate for a keyframe, and the crop that it was made for."""

    estimate: DepthEstimate
    crop: Crop


def estimate_keyframes(
    network: Network, keyframes: Sequence[Keyframe], longer_side: int, cameras: Sequence[KnownCamera] | None = None
) -> list[CroppedEstimate]:
    """Runs the network on these keyframes together; images are cropped to a common size."""
    crops = [crop(keyframe.frame.width, keyframe.frame.height, longer_side, PATCH) for keyframe in keyframes]
    width, height = min(each.width for each in crops), min(each.height for each in crops)
    crops = [each.crop_centre(width, height) for each in crops]
    images = [
        normalize_image(crop_image(keyframe.frame.image, to)) for keyframe, to in zip(keyframes, crops, strict=True)
    ]
    placed = None if cameras is None else [_place_camera(camera, to) for camera, to in zip(cameras, crops, strict=True)]
    estimates = network(torch.stack(images), placed)
    return [CroppedEstimate(estimate, to) for estimate, to in zip(estimates, crops, strict=True)]


def _place_camera(camera: KnownCamera, to: Crop) -> PlacedCamera:
    """Makes the cropped image's camera, with a central principal point, as the network assumes."""
    focal = camera.focal * to.scale
    K = np.array([[focal, 0.0, to.width / 2], [0.0, focal, to.height / 2], [0.0, 0.0, 1.0]])
    return PlacedCamera(camera.T_world_camera, K)


# Wide-baseline matches: a photograph is warped into the other's view by the network's depth and cameras, then matched.
#
# Descriptors alone decide, anywhere in the two pictures: where the network is right, both look the same from one
# viewpoint; where it is wrong, the warped one shows something else, and matches are lost, but none are made up.

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
        found = features.match(described1, described2, features.NearestNeighbourConfig())
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


WEIGHTS = ("da3/da3-small.safetensors",)
PACKAGE = "safetensors"  # reads them


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Depth Anything 3 as a prior: it proposes matches, and gives depth once it was told the verified cameras."""

    weights: Path | None = None  # file of the network's; None: where `splatnode weights` puts them
    longer_side: int = 504  # of the network's images, pixels: what it was published with
    views_at_once: Internal[int] = 12  # photographs that look at each other: memory and time grow with their square
    seed: Internal[int] = 0  # every prior has one; this one draws no random numbers


class Da3Prior(Prior):
    """Matches by warping one photograph into another's view, depth from the network given registered cameras.

    The network's own cameras serve the warping alone; matches are verified as plain ones are. Depth maps are brought
    to the scale of the registered points that each camera sees.
    """

    def __init__(self, network: Network, config: Config) -> None:
        self._network, self._config = network, config
        self.matcher = WarpMatcher(network, config.longer_side)

    def pointmaps(
        self, graph: ViewGraph, registration: Registration, pause: Callable[[], None] = lambda: None
    ) -> tuple[Pointmap, ...]:
        found = []
        cameras, at_once = registration.cameras, self._config.views_at_once
        for start in range(0, len(cameras), at_once):
            some = cameras[start : start + at_once]
            keyframes = [graph.keyframes[camera.index] for camera in some]
            known = [KnownCamera(camera.T_world_camera, camera.focal) for camera in some]
            for camera, answer in zip(
                some, estimate_keyframes(self._network, keyframes, self._config.longer_side, known), strict=True
            ):
                depth, sure = answer.estimate.depth, answer.estimate.confidence
                found.append(make_registered_pointmap(graph, registration, camera, answer.crop, depth, sure))
            pause()
        return tuple(found)


def load(config: Config) -> Da3Prior:
    """Raises WeightsError or FileNotFoundError without weights, ValueError where they are another network's."""
    return Da3Prior(load_network(config.weights or find(*WEIGHTS)), config)
