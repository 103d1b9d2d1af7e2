"""preview.png: what the cameras saw beside what the Gaussians show."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import torch

from recon.rasterize.cpu import rasterize
from recon.snapshot import CameraEstimate, GaussianArrays, Snapshot

Image = npt.NDArray[np.uint8]


def render_camera(gaussians: GaussianArrays, camera: CameraEstimate) -> Image:
    """(H, W, 3) RGB of the Gaussians from an estimated camera."""
    render = rasterize(
        torch.from_numpy(gaussians.means),
        torch.from_numpy(gaussians.quats),
        torch.from_numpy(gaussians.scales),
        torch.from_numpy(gaussians.opacities),
        torch.from_numpy(gaussians.sh),
        torch.from_numpy(camera.T_world_camera).float(),
        torch.from_numpy(camera.K).float(),
        camera.width,
        camera.height,
        channels=("rgb",),
    )
    assert render.rgb is not None
    return (render.rgb.clamp(0, 1) * 255).round().byte().numpy()


def contact_sheet(snapshot: Snapshot, max_views: int = 4, height: int = 240) -> bytes:
    """A PNG: photographs above, the Gaussians seen from the same cameras below; cameras from the first to the last."""
    count = len(snapshot.cameras)
    shown = np.linspace(0, count - 1, min(count, max_views)).round().astype(int)
    columns = []
    for camera in (snapshot.cameras[index] for index in shown):
        pair = [snapshot.images[camera.name], render_camera(snapshot.gaussians, camera)]
        size = (round(camera.width * height / camera.height), height)
        columns.append(np.vstack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in pair]))
    _, png = cv2.imencode(".png", cv2.cvtColor(np.hstack(columns), cv2.COLOR_RGB2BGR))
    return png.tobytes()
