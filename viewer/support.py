"""Which cameras see which Gaussian: how well a surface is supported, and from where it was seen best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.viewer.canvas import transform_to_camera

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
