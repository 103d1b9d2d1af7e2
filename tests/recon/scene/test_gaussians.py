"""Gaussians: what is stored, what is activated, and what a similarity does to them."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splatnode.recon.geometry import Similarity
from splatnode.recon.rasterize import Camera, render_gaussians
from splatnode.recon.scene import SH_C0, Gaussians, concatenate
from tests.support.synthetic import TinyScene, tiny_scene


def covariances(gaussians: Gaussians) -> np.ndarray:
    """(N, 3, 3) of equation 1."""
    axes = Rotation.from_quat(gaussians.quats.double().numpy()[:, [1, 2, 3, 0]]).as_matrix()
    return axes @ (gaussians.scales.double().numpy()[:, :, None] ** 2 * axes.transpose(0, 2, 1))


def render(scene: TinyScene, gaussians: Gaussians, T_world_camera: torch.Tensor) -> torch.Tensor:
    image = render_gaussians(gaussians, Camera(T_world_camera, scene.Ks[0], scene.width, scene.height)).rgb
    assert image is not None
    return image


def test_activated_values():
    gaussians = Gaussians(
        means=torch.zeros(1, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.tensor([[1.0, 2.0, 0.5]]).log(),
        logit_opacities=torch.tensor([3.0]).log(),
        sh=torch.tensor([[[0.5 / SH_C0, 0.0, -0.5 / SH_C0], *[[9.0, 9.0, 9.0]] * 3]]),
        source_frame=torch.tensor([4], dtype=torch.int32),
    )
    assert len(gaussians) == 1
    torch.testing.assert_close(gaussians.scales, torch.tensor([[1.0, 2.0, 0.5]]))
    torch.testing.assert_close(gaussians.opacities, torch.tensor([0.75]))
    torch.testing.assert_close(gaussians.rgb, torch.tensor([[1.0, 0.5, 0.0]]))


def test_a_subset_by_mask_is_that_by_index_in_every_field():
    gaussians = tiny_scene().gaussians
    index = torch.tensor([3, 10, 11])
    mask = torch.zeros(len(gaussians), dtype=torch.bool).index_fill(0, index, True)
    for field in fields(Gaussians):
        expected = getattr(gaussians, field.name)[[3, 10, 11]]
        assert torch.equal(getattr(gaussians.subset(index), field.name), expected)
        assert torch.equal(getattr(gaussians.subset(mask), field.name), expected)


def test_concatenation_keeps_the_order_and_pads_lower_degrees_with_zeros():
    plain, shiny = tiny_scene(seed=1, num_gaussians=5).gaussians, tiny_scene(seed=2, num_gaussians=7, bases=4).gaussians
    both = concatenate([plain, shiny])
    assert len(both) == 12 and both.sh.shape == (12, 4, 3)
    assert torch.equal(both.means, torch.cat([plain.means, shiny.means]))
    assert torch.equal(both.sh[:5, :1], plain.sh) and not both.sh[:5, 1:].any()
    assert torch.equal(both.sh[5:], shiny.sh)
    assert both.source_frame.dtype == torch.int32


def test_a_similarity_moves_means_and_covariances():
    gaussians = tiny_scene(dtype=torch.float64).gaussians
    rotation, translation = Rotation.random(random_state=1).as_matrix(), np.array([0.3, -2.0, 5.0])
    moved = gaussians.transform(3.0, torch.from_numpy(rotation), torch.from_numpy(translation))
    np.testing.assert_allclose(moved.means, 3.0 * gaussians.means.numpy() @ rotation.T + translation, atol=1e-12)
    np.testing.assert_allclose(covariances(moved), 9.0 * rotation @ covariances(gaussians) @ rotation.T, atol=1e-12)
    assert torch.equal(moved.sh, gaussians.sh) and torch.equal(moved.logit_opacities, gaussians.logit_opacities)


@pytest.mark.parametrize("scale", [0.2, 1.0, 7.0])
def test_a_camera_moved_along_sees_the_same_image(scale):
    scene = tiny_scene()
    # Nothing is as near as the rasteriser's near plane or as small as its least footprint, at any of these scales.
    gaussians = replace(scene.gaussians, log_scales=scene.gaussians.log_scales.clamp_min(-2.5))
    similarity = Similarity(scale, Rotation.random(random_state=5).as_matrix(), np.array([1.0, -0.5, 2.0]))
    moved = gaussians.transform(scale, torch.from_numpy(similarity.rotation), torch.from_numpy(similarity.translation))
    T = scene.Ts_world_camera[0]
    T_moved = torch.from_numpy(similarity.camera(T.double().numpy())).float()
    before, after = render(scene, gaussians, T), render(scene, moved, T_moved)
    assert before.std() > 0.05
    torch.testing.assert_close(after, before, rtol=0, atol=2e-3)
