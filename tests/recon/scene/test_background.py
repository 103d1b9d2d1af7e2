"""The far shell: where it stands, what colour it has, and that no gap shows through it."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splatnode.recon.rasterize import Camera, render_gaussians
from splatnode.recon.scene import Gaussians
from splatnode.recon.scene.background import SHELL, BackgroundConfig, far_shell
from tests.support.synthetic import plane_pointmap

WIDTH, HEIGHT = 64, 48


def two_colours() -> np.ndarray:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:, : WIDTH // 2, 0], image[:, WIDTH // 2 :, 2] = 255, 255  # red on the left, blue on the right
    return image


def turned(yaw_deg: float) -> np.ndarray:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = Rotation.from_euler("y", yaw_deg, degrees=True).as_matrix()
    return T_world_camera


def pointmap(T_world_camera: np.ndarray):
    facing = plane_pointmap(np.eye(4), width=WIDTH, height=HEIGHT)
    return replace(facing, T_world_camera=T_world_camera)


def directions(gaussians: Gaussians) -> np.ndarray:
    means = gaussians.means.double().numpy()
    return means / np.linalg.norm(means, axis=1, keepdims=True)


def test_the_shell_stands_at_its_distance_and_faces_the_cameras():
    shell = far_shell([pointmap(np.eye(4))], [two_colours()], BackgroundConfig(distance=4.0, spacing_deg=5.0))
    assert len(shell) > 50
    np.testing.assert_allclose(np.linalg.norm(shell.means.numpy(), axis=1), 4.0 * 2.0, rtol=1e-5)
    axes = Rotation.from_quat(shell.quats.double().numpy()[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(axes[:, :, 2], directions(shell), atol=1e-5)
    assert (shell.scales[:, 2] < 0.2 * shell.scales[:, 0]).all()
    assert set(shell.source_frame.tolist()) == {SHELL}


def test_neighbours_are_about_the_spacing_apart():
    shell = far_shell([pointmap(np.eye(4))], [two_colours()], BackgroundConfig(spacing_deg=6.0, elsewhere_deg=0.0))
    cosines = directions(shell) @ directions(shell).T - 2 * np.eye(len(shell))
    nearest = np.degrees(np.arccos(cosines.max(1)))
    assert nearest.min() > 0.7 * 6 and nearest.max() < 1.3 * 6


def test_it_is_close_up_to_its_margin_beyond_the_image_and_no_further():
    view = pointmap(np.eye(4))
    for margin in (0.0, 0.5):
        alone = BackgroundConfig(margin=margin, spacing_deg=2.0, elsewhere_deg=0.0)
        ray = directions(far_shell([view], [two_colours()], alone))
        u = ray[:, 0] / ray[:, 2] * view.K[0, 0] / WIDTH + 0.5
        v = ray[:, 1] / ray[:, 2] * view.K[1, 1] / HEIGHT + 0.5
        for share in (u, v):
            assert -margin - 0.01 <= share.min() < -margin + 0.1
            assert 1 + margin - 0.1 < share.max() <= 1 + margin + 0.01


def test_it_has_the_colour_of_the_image_there():
    shell = far_shell([pointmap(np.eye(4))], [two_colours()], BackgroundConfig(margin=0.0, elsewhere_deg=0.0))
    ray = directions(shell)
    left, right = ray[:, 0] < -0.1, ray[:, 0] > 0.1
    torch.testing.assert_close(shell.rgb[left], torch.tensor([[1.0, 0, 0]]).expand(left.sum(), 3), rtol=0, atol=0.03)
    torch.testing.assert_close(shell.rgb[right], torch.tensor([[0, 0, 1.0]]).expand(right.sum(), 3), rtol=0, atol=0.03)


def test_beside_the_images_it_has_their_colour_at_that_elevation():
    sky_over_grass = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    sky_over_grass[: HEIGHT // 2, :, 2], sky_over_grass[HEIGHT // 2 :, :, 1] = 255, 255
    ray = directions(shell := far_shell([pointmap(np.eye(4))], [sky_over_grass], BackgroundConfig()))
    beside = (ray[:, 0] / ray[:, 2] > 0.8) & (ray[:, 2] > 0)  # the image ends at 0.5
    sky, grass = beside & (ray[:, 1] < -0.2), beside & (ray[:, 1] > 0.2)
    assert sky.sum() > 20 and grass.sum() > 20
    assert (shell.rgb[sky, 2] > 0.7).all() and (shell.rgb[sky, 1] < 0.3).all()
    assert (shell.rgb[grass, 1] > 0.7).all() and (shell.rgb[grass, 2] < 0.3).all()


def test_each_direction_has_the_colour_of_the_view_that_looks_there():
    green, white = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    green[..., 1] = 255
    shell = far_shell(
        [pointmap(turned(0)), pointmap(turned(180))], [green, white], BackgroundConfig(margin=0.0, elsewhere_deg=0.0)
    )
    ahead = directions(shell)[:, 2] > 0
    assert ahead.any() and (~ahead).any()
    torch.testing.assert_close(shell.rgb[ahead], torch.tensor([[0, 1.0, 0]]).expand(ahead.sum(), 3))
    torch.testing.assert_close(shell.rgb[~ahead], torch.ones((~ahead).sum(), 3))


@pytest.mark.parametrize("yaw_deg", range(0, 360, 30))
@pytest.mark.parametrize("pitch_deg", [0, 50, -80])
def test_no_gap_shows_through_wherever_one_looks(yaw_deg, pitch_deg):
    view, white = pointmap(np.eye(4)), np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    shell = far_shell([view], [white], BackgroundConfig())
    looking = np.eye(4)
    looking[:3, :3] = Rotation.from_euler("yx", [yaw_deg, pitch_deg], degrees=True).as_matrix()
    camera = torch.from_numpy(looking).float(), torch.from_numpy(view.K).float()
    image = render_gaussians(shell, Camera(*camera, WIDTH, HEIGHT)).rgb
    assert image is not None and image.min() > 0.8


def test_elsewhere_it_has_the_colours_of_all_images_together():
    shell = far_shell([pointmap(np.eye(4))], [two_colours()], BackgroundConfig())
    behind = directions(shell)[:, 2] < -0.5
    assert 50 < behind.sum() < 150  # about 10 degrees apart
    assert (shell.rgb[behind][:, 1] < 0.01).all()
    mixed = shell.rgb[behind & (abs(directions(shell)[:, 0]) < 0.1)]
    assert len(mixed) and (abs(mixed[:, 0] - mixed[:, 2]) < 0.5).all()  # neither red nor blue


def test_a_shell_of_spacing_zero_is_left_out():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shell = far_shell([pointmap(np.eye(4))], [two_colours()], BackgroundConfig(spacing_deg=0.0))
    assert len(shell) == 0


@pytest.mark.parametrize("most", [40, 8, 0])
def test_a_bounded_shell_is_coarser_not_torn(most):
    views = [pointmap(turned(yaw)) for yaw in (0, 60)]
    assert len(far_shell(views, [two_colours()] * 2, BackgroundConfig())) > 40
    shell = far_shell(views, [two_colours()] * 2, BackgroundConfig(), max_gaussians=most)
    assert len(shell) <= most
    if most:
        assert len(shell) >= most // 2
        ray = directions(shell)  # some to the far left of the first view, some to the far right of the second
        assert ray[:, 0].min() < -0.2 and ray[:, 0].max() > 0.9
