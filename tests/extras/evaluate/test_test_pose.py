"""A test image's camera is found again."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatnode.extras.evaluate.protocol import find_test_pose
from splatnode.extras.evaluate.regions import GaussianAppearance
from splatnode.recon.geometry import angles_deg, exp_se3
from splatnode.recon.rasterize import rasterize_on_cpu
from splatnode.recon.result.report import render_rgb
from splatnode.recon.result.snapshot import GaussianArrays

WIDTH, HEIGHT = 128, 96
K = np.array([[110.0, 0, 64], [0, 110.0, 48], [0, 0, 1]])


def motion(seed: int, size: float = 1.0) -> np.ndarray:
    return exp_se3(size * torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))).numpy()


def make_wall(num_gaussians: int = 600) -> GaussianArrays:
    """Coloured blobs at different depths, so that every direction of motion shows."""
    rng = np.random.default_rng(0)
    means = rng.uniform([-3, -2.5, 2.5], [3, 2.5, 6], (num_gaussians, 3))
    return GaussianArrays(
        means=means.astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (num_gaussians, 1)),
        scales=np.full((num_gaussians, 3), 0.12, np.float32),
        opacities=np.full(num_gaussians, 0.8, np.float32),
        sh=rng.uniform(-1.5, 1.5, (num_gaussians, 1, 3)).astype(np.float32),
        source_frame=np.zeros(num_gaussians, np.int32),
    )


@pytest.mark.parametrize(("levels", "steps"), [(1, 150), (3, 250)])
def test_test_pose_is_found_again(levels, steps):
    gaussians, true = make_wall(), motion(5, 0.05)
    image = torch.from_numpy(render_rgb(gaussians, true, K, WIDTH, HEIGHT))
    start = true @ motion(6, 0.02)
    found = find_test_pose(GaussianAppearance(gaussians, rasterize_on_cpu), image, start, K, steps=steps, levels=levels)
    assert float(np.linalg.norm(start[:3, 3] - true[:3, 3])) > 0.02
    assert float(np.linalg.norm(found.T_world_camera[:3, 3] - true[:3, 3])) < 0.002
    assert angles_deg(found.T_world_camera[:3, :3], true[:3, :3]) < 0.03
    rotation = found.T_world_camera[:3, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("levels", [1, 3])
def test_what_is_not_used_does_not_move_the_pose(levels):
    gaussians, true = make_wall(), motion(5, 0.05)
    image = torch.from_numpy(render_rgb(gaussians, true, K, WIDTH, HEIGHT))
    image[:, 50:] = torch.from_numpy(render_rgb(gaussians, true @ motion(9, 0.03), K, WIDTH, HEIGHT))[:, 50:]
    used = (torch.arange(WIDTH) < 50).expand(HEIGHT, WIDTH)
    start, off = true @ motion(6, 0.01), []
    for mask in (used, None):
        found = find_test_pose(
            GaussianAppearance(gaussians, rasterize_on_cpu), image, start, K, steps=200, levels=levels, used=mask
        )
        off.append(float(np.linalg.norm(found.T_world_camera[:3, 3] - true[:3, 3])))
    assert off[0] < 0.005 < off[1]


def test_search_never_ends_worse_than_it_started():
    gaussians = make_wall()
    image = torch.from_numpy(render_rgb(gaussians, np.eye(4), K, WIDTH, HEIGHT))
    found = find_test_pose(
        GaussianAppearance(gaussians, rasterize_on_cpu), image, np.eye(4), K, steps=3, levels=2, learning_rate=0.5
    )
    assert found.loss == pytest.approx(0.0, abs=1e-6)
    assert np.array_equal(found.T_world_camera, np.eye(4))


class Valley:
    """A scene that looks right from x = .1 alone, and as much worse as the camera is beside it."""

    num_gaussians, num_bytes = None, 0

    def __init__(self) -> None:
        self.seen: list[float] = []

    def depth(self, T_world_camera: np.ndarray) -> float:
        return 1.0

    def difference(self, image, T_world_camera, K, used=None) -> torch.Tensor:
        loss = (T_world_camera[0, 3] - 0.1).abs()
        self.seen.append(float(loss.detach()))
        return loss

    def render(self, T_world_camera, K, width, height) -> torch.Tensor:
        raise AssertionError("the search renders nothing")


@pytest.mark.parametrize("steps", range(8, 14))
def test_the_best_pose_on_the_way_is_the_one_that_is_found(steps):
    """Steps that do not fall go to and fro around the place: the last one is not the best."""
    scene, image = Valley(), torch.zeros(6, 8, 3)
    found = find_test_pose(scene, image, np.eye(4), K, steps=steps, learning_rate=0.04, final=1.0)
    assert found.loss == pytest.approx(min(scene.seen), abs=1e-7)
    assert abs(found.T_world_camera[0, 3] - 0.1) == pytest.approx(found.loss, abs=1e-6)


def test_with_several_sizes_the_best_pose_is_the_best_at_the_full_size():
    scene, image = Valley(), torch.zeros(6, 8, 3)
    found = find_test_pose(scene, image, np.eye(4), K, steps=12, levels=3, learning_rate=0.04, final=1.0)
    assert found.loss == pytest.approx(min(scene.seen[8:]), abs=1e-7)
