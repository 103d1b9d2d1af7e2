"""The CUDA back-end. Without a GPU: our side of it, with gsplat's place taken by the reference's blending."""

from __future__ import annotations

import sys
import time
import types

import pytest
import torch
from torch import Tensor

from splatnode.recon.rasterize import gsplat, reference
from splatnode.recon.rasterize.reference import Splats, blend_weights
from tests.support.rasterize_cases import HEIGHT, NAMES, WIDTH, random_case, relative_error, render_and_differentiate

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def stand_in(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options) -> tuple:
    """gsplat.rasterization for what our back-end asks of it, from its documentation. Intrinsics get no gradient."""
    assert quats.shape == (len(means), 4) and scales.shape == (len(means), 3)
    assert torch.equal(viewmats[0], torch.eye(4).to(means)) and options["render_mode"] == "RGB"
    (fx, _, cx), (_, fy, cy), _ = Ks[0].detach()
    x, y, z = means.unbind(1)
    zero = torch.zeros_like(z)
    jacobians = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], 1).view(-1, 2, 3)
    bare = jacobians @ options["covars"] @ jacobians.mT
    covariances = bare + options["eps2d"] * torch.eye(2).to(means)
    if options["rasterize_mode"] == "antialiased":
        opacities = opacities * (torch.linalg.det(bare) / torch.linalg.det(covariances)).clamp(min=0).sqrt()
    centres = torch.stack([fx * x / z + cx, fy * y / z + cy], 1)
    weights = blend_weights(Splats(centres, covariances, opacities, colors, z, colors), width, height)
    return (weights @ colors).view(1, height, width, -1), weights.sum(1).view(1, height, width, 1), {}


@pytest.fixture
def gsplat_stand_in(monkeypatch):
    module = types.ModuleType("gsplat")
    module.rasterization = stand_in  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "gsplat", module)
    monkeypatch.setattr(gsplat, "check_input", lambda *_: None)


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("channels", [reference.CHANNELS, ("rgb",), ("depth", "normal"), ("alpha",)])
def test_our_side_gives_every_gradient(gsplat_stand_in, channels, antialias):
    case = random_case(31, bases=4)
    options = {"channels": channels, "antialias": antialias}
    expected_images, expected = render_and_differentiate(reference.rasterize, case, **options)
    actual_images, actual = render_and_differentiate(gsplat.rasterize, case, **options)
    for image, expected_image in zip(actual_images, expected_images, strict=True):
        assert relative_error(image, expected_image) < 1e-9
    for name, gradient, expected_gradient in zip(NAMES, actual, expected, strict=True):
        assert (gradient - expected_gradient).norm() <= 1e-7 * expected_gradient.norm(), name


def test_nothing_in_view(gsplat_stand_in):
    tensors = random_case(32).tensors()
    behind = (tensors[0].detach() - torch.tensor([0, 0, 100.0])).requires_grad_()
    render = gsplat.rasterize(behind, *tensors[1:], width=WIDTH, height=HEIGHT)
    assert render.rgb is not None and render.rgb.shape == (HEIGHT, WIDTH, 3) and render.rgb.abs().max() == 0
    render.rgb.sum().backward()
    assert behind.grad is not None and behind.grad.abs().max() == 0


def test_tensors_must_be_on_the_gpu():
    with pytest.raises(ValueError, match="means must be on cuda for this rasteriser, got cpu"):
        gsplat.rasterize(*random_case(33).tensors(), width=WIDTH, height=HEIGHT)


def on_cuda(tensors: list[Tensor]) -> list[Tensor]:
    return [tensor.detach().float().cuda().requires_grad_() for tensor in tensors]


@needs_cuda
@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_cuda_agrees_with_the_reference(seed, antialias):
    pytest.importorskip("gsplat", reason="needs the extra cuda")
    case = random_case(seed)
    # Opacities below both cut-offs and centres well inside, where the two are meant to be equal.
    case_tensors = case.tensors()
    with torch.no_grad():
        case_tensors[3].clamp_(max=0.9)
        case_tensors[0][:, :2] *= 0.5
    expected_leaves = [tensor.detach().clone().requires_grad_() for tensor in case_tensors]
    actual_leaves = on_cuda(case_tensors)
    expected = reference.rasterize(*expected_leaves, width=WIDTH, height=HEIGHT, antialias=antialias)
    actual = gsplat.rasterize(*actual_leaves, width=WIDTH, height=HEIGHT, antialias=antialias)
    losses = []
    for render in (expected, actual):
        assert render.rgb is not None and render.normal is not None and render.alpha is not None
        losses.append((render.rgb**2).mean() + (render.normal**2).mean() + (render.alpha**2).mean())
    for loss in losses:
        loss.backward()
    assert expected.rgb is not None and actual.rgb is not None
    assert (actual.rgb.detach().cpu() - expected.rgb.detach()).abs().max() < 5e-3
    for name, leaf, expected_leaf in zip(NAMES, actual_leaves, expected_leaves, strict=True):
        assert leaf.grad is not None and expected_leaf.grad is not None
        assert relative_error(leaf.grad.cpu().double(), expected_leaf.grad) < 2e-2, name


@needs_cuda
def test_cuda_iterates_quickly():
    pytest.importorskip("gsplat", reason="needs the extra cuda")
    leaves = on_cuda(random_case(0, count=50_000, bases=1, width=512, height=384).tensors())
    with torch.no_grad():
        leaves[2] *= 0.1

    def iterate() -> None:
        render = gsplat.rasterize(*leaves, width=512, height=384)
        assert render.rgb is not None
        render.rgb.mean().backward()

    for _ in range(5):
        iterate()
    torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(20):
        iterate()
    torch.cuda.synchronize()
    assert (time.perf_counter() - start) / 20 < 0.1
