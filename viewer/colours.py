"""Colours of the Gaussians by what a person wants to know of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.prepare import SH_C0
from splatnode.recon.result.export.quaternions import matrices_from_quats
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, decode_frame_id
from splatnode.viewer.state import Colouring, Moment
from splatnode.viewer.viewpoint import transform_to_camera

# Which cameras see which Gaussian: how well a surface is supported, and from where it was seen best.

_LONGER_SIDE = 160  # pixels of the depth images that tell what is hidden
_BEHIND = 1.05  # a Gaussian this many times as far as the surface that a camera sees there is hidden from it


@dataclass(frozen=True, eq=False)
class Support:
    sizes: npt.NDArray[np.float32]  # (N, C) how large camera C sees the Gaussian, pixels a world unit; 0: not at all

    @property
    def views(self) -> npt.NDArray[np.intp]:
        """(N,) the number of cameras that see the Gaussian."""
        return (self.sizes > 0).sum(1)

    @property
    def best(self) -> npt.NDArray[np.intp]:
        """(N,) the index of the camera that sees it largest; -1: none does."""
        if not self.sizes.shape[1]:
            return np.full(len(self.sizes), -1)
        return np.where(self.sizes.any(1), self.sizes.argmax(1), -1)


def support(gaussians: GaussianArrays, cameras: tuple[CameraEstimate, ...]) -> Support:
    """For each Gaussian, the cameras whose image shows its centre unhidden."""
    sizes = np.zeros((len(gaussians), len(cameras)), np.float32)
    for index, camera in enumerate(cameras if len(gaussians) else ()):
        sizes[:, index] = compute_apparent_sizes(gaussians, camera)
    return Support(sizes)


def compute_apparent_sizes(gaussians: GaussianArrays, camera: CameraEstimate) -> npt.NDArray[np.float64]:
    """(N,) how large the camera sees each Gaussian, in pixels a world unit; 0 where it does not see it."""
    scale = min(1.0, _LONGER_SIDE / max(camera.width, camera.height))
    width, height = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
    K = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    T_camera_world = np.linalg.inv(camera.T_world_camera)
    points = transform_to_camera(gaussians.means, T_camera_world)
    depth = points[:, 2]
    ahead = depth > 1e-3
    pixels = points[:, :2] / np.where(ahead, depth, 1.0)[:, None] * K[[0, 1], [0, 1]] + K[:2, 2]
    inside = ahead & (pixels >= 0).all(1) & (pixels < [width, height]).all(1)
    rendered = render_arrays(gaussians, camera.T_world_camera, K, width, height, channels=("depth",))
    columns, rows = pixels[inside].astype(np.int64).T
    surface = np.where(rendered.alpha > 0.5, rendered.depth, np.inf)[rows, columns]
    result = np.zeros(len(gaussians))
    result[inside] = np.where(depth[inside] <= _BEHIND * surface, camera.K[0, 0] / depth[inside], 0.0)
    return result


Array = npt.NDArray[np.float32]

UNKNOWN = (0.35, 0.35, 0.35)
_SUPPORT = np.array([UNKNOWN, (0.85, 0.2, 0.15), (0.95, 0.6, 0.1), (0.85, 0.85, 0.2), (0.2, 0.75, 0.3)], np.float32)
_GOLDEN = 0.61803398875  # steps around the circle of hues that stay far apart, however many there are


def colour_gaussians(moment: Moment, colouring: Colouring, support: Support) -> GaussianArrays:
    """The Gaussians in the colours of `colouring`; what is unknown is grey."""
    gaussians = moment.snapshot.gaussians
    if colouring is Colouring.PHOTOGRAPH:
        return gaussians
    rgb = {
        Colouring.DEPTH: _colour_by_depth,
        Colouring.NORMAL: _colour_by_normal,
        Colouring.SUPPORT: _colour_by_support,
        Colouring.SOURCE: _colour_by_source,
    }[colouring](moment, support)
    return replace(gaussians, sh=((rgb[:, None] - 0.5) / SH_C0).astype(np.float32))


def normals(gaussians: GaussianArrays, centre: npt.NDArray[np.float64]) -> Array:
    """(N, 3) the direction in which each Gaussian is thinnest, on the side of `centre`."""
    axes = matrices_from_quats(gaussians.quats)
    normal = axes[np.arange(len(gaussians)), :, gaussians.scales.argmin(1)]
    away = ((gaussians.means - centre) * normal).sum(1) > 0
    return np.where(away[:, None], -normal, normal).astype(np.float32)


def source_colour(index: int) -> tuple[float, float, float]:
    """RGB of the camera at `index`: as different from its neighbours' as can be."""
    hue = round(180 * (index * _GOLDEN % 1.0)) % 180
    ((red, green, blue),) = cv2.cvtColor(np.array([[[hue, 190, 235]]], np.uint8), cv2.COLOR_HSV2RGB)[0] / 255.0
    return float(red), float(green), float(blue)


def camera_colours(cameras: Sequence[CameraEstimate]) -> list[tuple[float, float, float]]:
    """RGB of each camera: of several ones by their ids, in the order of these; of one camera each view has its own."""
    ids = sorted({camera.camera_id for camera in cameras})
    if ids in ([], [""]):
        return [source_colour(index) for index in range(len(cameras))]
    return [source_colour(ids.index(camera.camera_id)) for camera in cameras]


def mean_camera_centre(cameras: Sequence[CameraEstimate]) -> npt.NDArray[np.float64]:
    """(3,) the mean of the cameras' centres; the origin without any."""
    return np.mean([camera.T_world_camera[:3, 3] for camera in cameras], axis=0) if cameras else np.zeros(3)


def _colour_by_depth(moment: Moment, _support: Support) -> Array:
    """Colours by inverse distance from the mean camera centre, as images resolve inverse depth."""
    means = moment.snapshot.gaussians.means
    if not len(means):
        return np.zeros((0, 3), np.float32)
    nearness = 1.0 / np.maximum(np.linalg.norm(means - mean_camera_centre(moment.snapshot.cameras), axis=1), 1e-6)
    low, high = np.percentile(nearness, [2, 98])
    levels = np.rint(255 * np.clip((nearness - low) / max(high - low, 1e-9), 0, 1)).astype(np.uint8)
    return cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1].astype(np.float32) / 255


def _colour_by_normal(moment: Moment, _support: Support) -> Array:
    snapshot = moment.snapshot
    return 0.5 + 0.5 * normals(snapshot.gaussians, mean_camera_centre(snapshot.cameras)) * np.array(
        [1, -1, -1], np.float32
    )


def _colour_by_support(_moment: Moment, support: Support) -> Array:
    return _SUPPORT[np.minimum(support.views, len(_SUPPORT) - 1)]


def _colour_by_source(moment: Moment, support: Support) -> Array:
    """Colours by the frame that started a Gaussian; in a file, without these, by the camera that sees it largest."""
    snapshot = moment.snapshot
    palette = np.array([*(source_colour(index) for index in range(len(snapshot.cameras))), UNKNOWN], np.float32)
    if not len(snapshot.gaussians) or not (decode_frame_id(snapshot.gaussians.source_frame) >= 0).any():
        return palette[support.best]
    index_of = {camera.frame_id: index for index, camera in enumerate(snapshot.cameras)}
    frames, inverse = np.unique(decode_frame_id(snapshot.gaussians.source_frame), return_inverse=True)
    return palette[np.array([index_of.get(int(frame), -1) for frame in frames])][inverse]
