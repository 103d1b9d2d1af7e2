"""A network's depth map, up to scale and in a crop, as the point map of a registered camera."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.networks.crop import Crop
from splatnode.recon.priors.depth_normals import compute_depth_normals
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.priors.registered_camera import compute_modelled_K, select_sparse_points
from splatnode.recon.registration.register import RegisteredCamera, Registration

Map = npt.NDArray[np.float32]


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
