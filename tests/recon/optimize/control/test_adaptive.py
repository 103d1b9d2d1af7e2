"""Adaptive density control and unpooling, on Gaussians for which it is plain what should happen."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from splatnode.recon.optimize.control import OptimizerStep, adaptive, proximity
from splatnode.recon.optimize.photometric_losses import PhotometricLoss, TrainingImage
from splatnode.recon.rasterize import rasterize_on_cpu
from splatnode.recon.scene import Gaussians
from tests.support.synthetic import tiny_scene

K = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
IMAGE = TrainingImage(K, 40, 30, PhotometricLoss(torch.zeros(30, 40, 3)))
CONFIG = adaptive.Config(every=10, start=0.0, end=1.0, reset_every=0.5)


def gaussians(count: int = 4, scale: float = 0.01, opacity: float = 0.5) -> Gaussians:
    means = torch.stack([torch.arange(count) * 0.1, torch.zeros(count), torch.full((count,), 2.0)], 1)
    return Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        log_scales=torch.full((count, 3), math.log(scale)),
        logit_opacities=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh=torch.zeros(count, 1, 3),
        source_frame=torch.arange(count, dtype=torch.int32),
    )


def step(of: Gaussians, iteration: int = 10, gradient: float = 0.0) -> OptimizerStep:
    """Two cameras 1 apart: an extent of 0.55. The gradient is that of the means, along x."""
    apart = torch.eye(4)
    apart[0, 3] = 1.0
    of.means.requires_grad_()
    of.means.grad = torch.zeros_like(of.means)
    of.means.grad[:1, 0] = gradient
    return OptimizerStep(iteration, 100, iteration / 100, 0, of, (torch.eye(4), apart), (IMAGE, IMAGE), None)


def test_the_extent_is_that_of_the_cameras():
    assert adaptive.extent(step(gaussians()).Ts_world_camera) == pytest.approx(0.55)


def test_the_gradient_in_the_image_is_that_of_moving_what_is_seen():
    scene = tiny_scene(seed=3, num_gaussians=1, num_cameras=1)
    of = scene.gaussians.map(lambda tensor: tensor.clone())
    of = replace(of, log_scales=torch.full_like(of.log_scales, -3.0), logit_opacities=torch.tensor([2.0]))
    of.means.requires_grad_()
    T = scene.Ts_world_camera[0]
    photograph = TrainingImage(scene.Ks[0], scene.width, scene.height, IMAGE.loss)

    def image(K):
        return rasterize_on_cpu(of.means, of.quats, of.scales, of.opacities, of.sh, T, K, scene.width, scene.height)

    ramp = torch.linspace(0, 1, scene.width)[None, :, None] + torch.linspace(0, 2, scene.height)[:, None, None]
    (image(scene.Ks[0]).rgb * ramp).sum().backward()
    found = adaptive.image_gradient(OptimizerStep(1, 10, 0.1, 0, of, (T,), (photograph,), None))
    principal = scene.Ks[0].clone().requires_grad_()  # moving it moves the image of all that is seen
    (image(principal).rgb * ramp).sum().backward()
    halves = torch.tensor([scene.width / 2, scene.height / 2])
    assert float(found[0]) == pytest.approx(float((principal.grad[:2, 2] * halves).norm()), rel=0.1)


def test_a_small_one_that_is_pulled_is_doubled():
    change = adaptive.AdaptiveControl(CONFIG, 0).after_step(step(gaussians(scale=0.005), gradient=1.0))
    assert len(change.gaussians) == 5
    assert change.origin.tolist() == [0, 1, 2, 3, -1]
    assert torch.equal(change.gaussians.means[4], change.gaussians.means[0])


def test_a_large_one_that_is_pulled_is_divided():
    change = adaptive.AdaptiveControl(CONFIG, 0).after_step(step(gaussians(scale=0.01), gradient=1.0))
    assert change.origin.tolist() == [1, 2, 3, -1, -1]
    assert change.gaussians.scales[3:].flatten().tolist() == pytest.approx([0.01 / 1.6] * 6)
    assert not torch.equal(change.gaussians.means[3], change.gaussians.means[4])
    assert (change.gaussians.means[3:] - torch.tensor([0.0, 0, 2])).abs().max() < 0.05
    assert change.gaussians.source_frame[3:].tolist() == [0, 0]


def test_those_that_nothing_pulls_stay_and_the_faint_go():
    faint = gaussians()
    faint.logit_opacities[1] = -8.0
    change = adaptive.AdaptiveControl(CONFIG, 0).after_step(step(faint))
    assert change.origin.tolist() == [0, 2, 3]
    assert adaptive.AdaptiveControl(CONFIG, 0).after_step(step(gaussians(), iteration=9)) is None


def test_all_become_faint_at_a_reset_and_the_large_go_after_it():
    control = adaptive.AdaptiveControl(CONFIG, 0)
    mixed = gaussians()
    mixed.log_scales[2] = math.log(0.2)
    change = control.after_step(step(mixed, iteration=50))
    assert len(change.gaussians) == 4
    assert change.gaussians.opacities.tolist() == pytest.approx([0.01] * 4)
    assert control.after_step(step(mixed, iteration=60)).origin.tolist() == [0, 1, 3]


def test_where_all_are_pruned_the_refinement_goes_on_with_none():
    control = adaptive.AdaptiveControl(CONFIG, 0)
    left = control.after_step(step(gaussians(opacity=1e-4))).gaussians
    assert len(left) == 0
    assert control.after_step(step(left, iteration=11)) is None


def test_there_is_an_end_to_growing():
    full = adaptive.Config(every=10, start=0.0, end=1.0, max_gaussians=4)
    assert len(adaptive.AdaptiveControl(full, 0).after_step(step(gaussians(), gradient=1.0)).gaussians) == 4


def test_a_gap_is_filled_half_way_to_the_neighbours():
    three_near = gaussians(5)
    three_near.means[4, 0] = 2.0
    grown = proximity.unpool(three_near, 1.0, 3)
    assert grown.means[:, 0].tolist() == pytest.approx([1.15, 1.1, 1.05])
    assert grown.source_frame.tolist() == [4, 4, 4]
    assert len(proximity.unpool(three_near, 5.0, 3)) == 0


def test_unpooling_is_part_of_a_round():
    config = proximity.Config(CONFIG, min_distance=1.0)
    lonely = gaussians(5)
    lonely.means[4, 0] = 2.0
    change = proximity.load(config, 0).after_step(step(lonely))
    assert change.origin.tolist() == [0, 1, 2, 3, 4, -1, -1, -1]
    assert proximity.load(config, 0).after_step(step(gaussians(5), iteration=5)) is None
