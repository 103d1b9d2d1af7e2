"""preview.png: photographs above, renders below, first to last camera."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from splatnode.recon.result.report import make_contact_sheet, render_camera
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Code, Verdict

WIDTH, HEIGHT = 32, 24
K = np.array([[32.0, 0, 16], [0, 32.0, 12], [0, 0, 1]])


def ball(rgb: tuple[float, float, float] = (0.0, 1.0, 0.0)) -> GaussianArrays:
    """One opaque Gaussian two units ahead of the world's origin that fills the middle of the image."""
    return GaussianArrays(
        means=np.array([[0, 0, 2]], np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.full((1, 3), 0.3, np.float32),
        opacities=np.array([0.99], np.float32),
        sh=((np.array([[rgb]]) - 0.5) / 0.28209479177387814).astype(np.float32),
        source_frame=np.zeros(1, np.int32),
    )


def snapshot(num_cameras: int) -> Snapshot:
    """Photographs of one grey each, brighter from camera to camera."""
    cameras = tuple(CameraEstimate(f"{i}.png", i, np.eye(4), K, WIDTH, HEIGHT) for i in range(num_cameras))
    images = {camera.name: np.full((HEIGHT, WIDTH, 3), 20 * camera.frame_id, np.uint8) for camera in cameras}
    verdict = Verdict(Code.OK, "Good.", "", publishable=True)
    return Snapshot(0, verdict, cameras, ball(), images, (), 0)


def decoded(png: bytes) -> np.ndarray:
    bgr = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert bgr is not None
    return bgr[..., ::-1]


def test_the_gaussians_are_seen_from_the_camera():
    (camera,) = snapshot(1).cameras
    image = render_camera(ball(), camera)
    assert image.shape == (HEIGHT, WIDTH, 3) and image.dtype == np.uint8
    assert image[12, 16, 1] > 240 and image[12, 16, 0] < 5
    assert image[0, 0].max() < 60


def test_photographs_above_renders_below():
    sheet = decoded(make_contact_sheet(snapshot(2), height=HEIGHT))
    assert sheet.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    assert (sheet[:HEIGHT, :WIDTH] == 0).all() and (sheet[:HEIGHT, WIDTH:] == 20).all()
    assert (sheet[HEIGHT:, :WIDTH] == render_camera(ball(), snapshot(1).cameras[0])).all()


@pytest.mark.parametrize(
    ("num_cameras", "shown"), [(3, [0, 1, 2]), (4, [0, 1, 2, 3]), (7, [0, 2, 4, 6]), (12, [0, 4, 7, 11])]
)
def test_from_the_first_camera_to_the_last(num_cameras, shown):
    sheet = decoded(make_contact_sheet(snapshot(num_cameras), max_views=4, height=HEIGHT))
    assert [int(value) for value in sheet[0, WIDTH // 2 :: WIDTH, 0]] == [20 * index for index in shown]
