"""Monocular depth, learned from single photographs, fitted to multi-view depth: known where that is unknown too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.networks.vit import Crop
from splatnode.recon.priors.pointmap import Pointmap, compute_depth_normals, compute_modelled_K, select_sparse_points
from splatnode.recon.registration.registration import RegisteredCamera, Registration

Map = npt.NDArray[np.float32]
Network = Callable[[npt.NDArray[np.uint8]], tuple[Map, Crop]]  # image (h, w, 3) -> values (H, W), and their crop

_MIN_KNOWN = 50  # pixels with multi-view depth, to fit two numbers to
_MAX_DEPTH = 20.0  # times the median depth: beyond, inverse depths say nothing
_ITERATIONS = 15  # of reweighted least squares: the line then moves no more
_MIN_RESIDUAL = 1e-4  # of the median inverse depth: smaller residuals weigh no more


def fit_monocular_depth(pointmap: Pointmap, image: npt.NDArray[np.uint8], network: Network) -> Pointmap:
    """`pointmap` with the depth and the normals of `network`, which gives inverse depths up to scale and offset.

    These two are fitted to the known depths. `image` (h, w, 3) is the view at modelled size. The confidence is 1 where
    the network's depth is known. A view of which too little is known, or that the network contradicts, stays.
    """
    inverse = _resample_to_image(*network(image), image.shape[:2])
    known = (pointmap.depth > 0) & (inverse > 0)
    if known.sum() < _MIN_KNOWN:
        return pointmap
    slope, offset = _fit_line(inverse[known], 1.0 / pointmap.depth[known], pointmap.confidence[known])
    if slope <= 0:
        return pointmap
    fitted = slope * inverse + offset
    usable = (inverse > 0) & (fitted > 1.0 / (_MAX_DEPTH * np.median(pointmap.depth[known])))
    depth = np.where(usable, 1.0 / np.where(usable, fitted, 1.0), 0.0).astype(np.float32)
    return replace(
        pointmap, depth=depth, confidence=usable.astype(np.float32), normal=compute_depth_normals(depth, pointmap.K)
    )


def _resample_to_image(values: Map, crop: Crop, size: tuple[int, ...]) -> Map:
    """(h, w) at the size of the image that was cropped, from `values` (H, W) of the crop; 0 outside of it."""
    to_network = np.array([[crop.scale, 0, -crop.left], [0, crop.scale, -crop.top]])
    to_network[:, 2] += 0.5 * crop.scale - 0.5  # from centres at whole numbers to such

    def warp(source: Map, interpolation: int, border: int) -> Map:
        flags = interpolation | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(source, to_network, (size[1], size[0]), None, flags, border), np.float32)

    inside = warp(np.ones_like(values), cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)
    return inside * warp(values, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)


def _fit_line(x: Map, y: Map, weights: Map) -> tuple[float, float]:
    """Slope and offset of the line through points x, y (M,), by weighted least absolute deviations."""
    x64, y64, robust = x.astype(np.float64), y.astype(np.float64), weights.astype(np.float64) + 1e-6
    slope, offset = 0.0, float(np.median(y64))
    for _ in range(_ITERATIONS):
        share = robust / robust.sum()
        mean_x, mean_y = share @ x64, share @ y64
        slope = float(share @ ((x64 - mean_x) * (y64 - mean_y)) / max(share @ (x64 - mean_x) ** 2, 1e-18))
        offset = float(mean_y - slope * mean_x)
        robust = (weights + 1e-6) / np.maximum(np.abs(slope * x64 + offset - y64), _MIN_RESIDUAL * np.median(y64))
    return slope, offset


# A network's depth map, up to scale and in a crop, as the point map of a registered camera.


def make_registered_pointmap(
    graph: ViewGraph, registration: Registration, camera: RegisteredCamera, crop: Crop, depth: Map, certainty: Map
) -> Pointmap:
    """The point map from `depth` (H, W) of the network's image, scaled to the registered points that the camera sees.

    `certainty` (H, W) is the network's, from 1 up (DUSt3R's confidence); the point map's is 1 - 1 / certainty. Pixels
    outside the crop are unknown.
    """
    keyframe = graph.keyframes[camera.index]
    K = compute_modelled_K(graph, camera)
    depth = resample_to_modelled(keyframe, crop, depth, unknown=0)
    certainty = resample_to_modelled(keyframe, crop, certainty, unknown=1)
    depth = (depth * _compute_point_scale(registration, camera, keyframe, depth)).astype(np.float32)
    confidence = np.where(depth > 0, 1.0 - 1.0 / np.maximum(certainty, 1.0), 0).astype(np.float32)
    return Pointmap(
        name=keyframe.name,
        frame_id=keyframe.frame.frame_id,
        depth=depth,
        confidence=confidence,
        normal=compute_depth_normals(depth, K),
        T_world_camera=camera.T_world_camera,
        K=K,
    )


def resample_to_modelled(keyframe: Keyframe, crop: Crop, values: Map, *, unknown: float) -> Map:
    """(h, w) at the keyframe's modelled size: the nearest of `values` (H, W) of the network's image; else `unknown`."""
    height, width = keyframe.image.shape[:2]
    step = keyframe.frame.width / width * crop.scale, keyframe.frame.height / height * crop.scale
    u = ((np.arange(width) + 0.5) * step[0] - crop.left - 0.5).astype(np.float32)
    v = ((np.arange(height) + 0.5) * step[1] - crop.top - 0.5).astype(np.float32)
    map_u, map_v = np.meshgrid(u, v)
    border = cv2.BORDER_CONSTANT
    return np.asarray(cv2.remap(values, map_u, map_v, cv2.INTER_NEAREST, None, border, unknown), np.float32)


def _compute_point_scale(registration: Registration, camera: RegisteredCamera, keyframe: Keyframe, depth: Map) -> float:
    """The factor that brings `depth` (h, w) to the registered points' depths, in the median; 1 without such points."""
    there, truth = sample_depth_at_points(registration, camera, keyframe, depth)
    both = (there > 0) & (truth > 0)
    return float(np.median(truth[both] / there[both])) if both.any() else 1.0


def sample_depth_at_points(
    registration: Registration, camera: RegisteredCamera, keyframe: Keyframe, depth: Map
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """(M,) `depth` (h, w) at the pixels where the camera observes registered points; (M,) the points' own depths."""
    points = select_sparse_points(registration, camera, keyframe.scale)
    pixels = np.floor(points.points).astype(np.int64)
    height, width = depth.shape
    inside = ((pixels >= 0) & (pixels < [width, height])).all(1)
    return depth[pixels[inside, 1], pixels[inside, 0]].astype(np.float64), points.depths[inside]
