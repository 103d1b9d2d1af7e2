"""Scoring on a GPU, with the core in place of one: a scene is moved there once, and its images come back."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from splatnode.recon.rasterize import gsplat
from splatnode.recon.rasterize.cpu import rasterize
from tests.bench.quality.gpu_scoring import rasterize_on_gpu


def test_a_scene_is_moved_once_and_a_pose_gets_its_gradient(monkeypatch):
    moved: list[tuple[int, ...]] = []

    def cuda(tensor: Tensor) -> Tensor:
        moved.append(tuple(tensor.shape))
        return tensor.clone()

    monkeypatch.setattr(Tensor, "cuda", cuda)
    monkeypatch.setattr(gsplat, "rasterize", rasterize)
    scene = (
        torch.tensor([[0.0, 0.0, 2.0], [0.1, 0.0, 3.0]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
        torch.full((2, 3), 0.2),
        torch.full((2,), 0.8),
        torch.ones(2, 1, 3),
    )
    K = torch.tensor([[30.0, 0.0, 16.0], [0.0, 30.0, 12.0], [0.0, 0.0, 1.0]])
    for x in (0.0, 0.1):
        T = torch.eye(4)
        T[0, 3] = x
        T.requires_grad_()
        image = rasterize_on_gpu(*scene, T, K, 32, 24, channels=("rgb",)).rgb
        expected = rasterize(*scene, T.detach(), K, 32, 24, channels=("rgb",)).rgb
        assert image is not None and expected is not None and image.device.type == "cpu"
        assert image.detach().numpy() == pytest.approx(expected.numpy())
        (gradient,) = torch.autograd.grad(image.mean(), T)
        assert gradient.abs().sum() > 0
    assert len(moved) == len(scene)
