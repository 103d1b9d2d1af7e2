"""preview.png: what the cameras saw beside what the Gaussians show. It needs no torch."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.image_file import encode_png
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot

Image = npt.NDArray[np.uint8]


def render_rgb(
    gaussians: GaussianArrays,
    T_world_camera: npt.NDArray[np.float64],
    K: npt.NDArray[np.float64],
    width: int,
    height: int,
) -> npt.NDArray[np.float32]:
    """(H, W, 3) the Gaussians' image on black, in [0, 1]."""
    return np.clip(render_arrays(gaussians, T_world_camera, K, width, height).rgb, 0.0, 1.0)


def render_camera(gaussians: GaussianArrays, camera: CameraEstimate) -> Image:
    """(H, W, 3) RGB of the Gaussians from an estimated camera."""
    rgb = render_rgb(gaussians, camera.T_world_camera, camera.K, camera.width, camera.height)
    return np.rint(rgb * 255).astype(np.uint8)


def make_contact_sheet(snapshot: Snapshot, max_views: int = 4, height: int = 240) -> bytes:
    """A PNG: photographs above, the Gaussians seen from the same cameras below; cameras from the first to the last.

    Without photographs where the snapshot does not have one of each camera.
    """
    count = len(snapshot.cameras)
    photographed = all(camera.name in snapshot.images for camera in snapshot.cameras)
    shown = np.linspace(0, count - 1, min(count, max_views)).round().astype(int)
    columns = []
    for camera in (snapshot.cameras[index] for index in shown):
        above = [snapshot.images[camera.name]] if photographed else []
        pair = [*above, render_camera(snapshot.gaussians, camera)]
        size = (round(camera.width * height / camera.height), height)
        columns.append(np.vstack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in pair]))
    return encode_png(np.hstack(columns))
