"""The rasterisers against their definition, and the definition against finite differences."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from splatnode.recon import core
from splatnode.recon.rasterize import rasterize_on_cpu, reference
from splatnode.recon.result import rendering
from tests.support.rasterize_cases import (
    HEIGHT,
    NAMES,
    TWENTY_SCENES,
    WIDTH,
    changed,
    images,
    needles,
    random_case,
    relative_error,
    render_and_differentiate,
    single,
)


@pytest.mark.parametrize(("make", "seed"), TWENTY_SCENES, ids=lambda value: getattr(value, "__name__", str(value)))
@pytest.mark.parametrize("antialias", [False, True], ids=["plain", "antialias"])
def test_cpu_equals_the_reference(make, seed, antialias):
    case = make(seed)
    expected_images, expected = render_and_differentiate(reference.rasterize, case, antialias=antialias)
    actual_images, actual = render_and_differentiate(rasterize_on_cpu, case, antialias=antialias)
    for image, expected_image in zip(actual_images, expected_images, strict=True):
        assert relative_error(image, expected_image) < 2e-5
    for name, gradient, expected_gradient in zip(NAMES, actual, expected, strict=True):
        assert relative_error(gradient, expected_gradient) < 1e-4, name


@pytest.mark.parametrize("bases", [1, 4, 9, 16])
def test_every_degree_of_spherical_harmonics(bases):
    case = random_case(3, bases=bases)
    _, expected = render_and_differentiate(reference.rasterize, case, channels=("rgb",))
    _, actual = render_and_differentiate(rasterize_on_cpu, case, channels=("rgb",))
    for name, gradient, expected_gradient in zip(NAMES, actual, expected, strict=True):
        assert relative_error(gradient, expected_gradient) < 1e-4, name


@pytest.mark.parametrize(
    "channels", [("rgb",), ("depth",), ("normal",), ("alpha",), ("rgb", "depth"), ("normal", "depth")]
)
def test_channels_are_the_same_alone(channels):
    case = random_case(4)
    whole = rasterize_on_cpu(*case.tensors(), width=WIDTH, height=HEIGHT)
    part = rasterize_on_cpu(*case.tensors(), width=WIDTH, height=HEIGHT, channels=channels)
    for name in reference.CHANNELS:
        if name in channels:
            torch.testing.assert_close(getattr(part, name), getattr(whole, name))
        else:
            assert getattr(part, name) is None
    _, expected = render_and_differentiate(reference.rasterize, case, channels=channels)
    _, actual = render_and_differentiate(rasterize_on_cpu, case, channels=channels)
    for name, gradient, expected_gradient in zip(NAMES, actual, expected, strict=True):
        if expected_gradient.norm() == 0:
            assert gradient.norm() == 0, name
        else:
            assert relative_error(gradient, expected_gradient) < 1e-4, name


def test_the_definition_passes_gradcheck():
    """Finite differences in float64, of the camera's pose and focal length among the rest."""
    case = random_case(0, count=3, bases=4, width=8, height=8)
    case = changed(case, scales=case.scales * 3, opacities=case.opacities * 0.5 + 0.2)

    def rendered(*tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(images(reference.rasterize(*tensors, width=8, height=8, antialias=True)))

    assert torch.autograd.gradcheck(rendered, case.tensors(), eps=1e-7, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("parameter", ["T_world_camera", "K"])
def test_cpu_camera_gradient_against_finite_differences_of_the_definition(parameter):
    case = random_case(11, count=60)
    generator = torch.Generator().manual_seed(1)
    if parameter == "K":
        direction = torch.tensor([[1.0, 0, 0.3], [0, -0.7, 0.2], [0, 0, 0]]).double()
    else:
        turn = torch.randn(3, generator=generator, dtype=torch.float64)
        x, y, z = turn.tolist()
        tangent = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]]).double()
        direction = torch.zeros(4, 4).double()
        direction[:3, :3] = case.T_world_camera[:3, :3] @ tangent
        direction[:3, 3] = torch.randn(3, generator=generator, dtype=torch.float64)

    def loss(value: Tensor) -> float:
        moved = {name: getattr(case, name) for name in NAMES} | {parameter: value}
        rendered = images(reference.rasterize(*moved.values(), width=WIDTH, height=HEIGHT, channels=("rgb", "alpha")))
        return float(sum((image * image).sum() for image in rendered))

    tensors = case.tensors()
    rendered = images(rasterize_on_cpu(*tensors, width=WIDTH, height=HEIGHT, channels=("rgb", "alpha")))
    torch.stack([(image * image).sum() for image in rendered]).sum().backward()
    gradient = tensors[NAMES.index(parameter)].grad
    assert gradient is not None
    step = 1e-6
    start = getattr(case, parameter)
    slope = (loss(start + step * direction) - loss(start - step * direction)) / (2 * step)
    assert float((gradient * direction).sum()) == pytest.approx(slope, rel=5e-4)


@pytest.mark.parametrize("rasterize", [reference.rasterize, rasterize_on_cpu], ids=["reference", "cpu"])
def test_one_gaussian_by_hand(rasterize):
    render = rasterize(*single(), width=17, height=17)
    variance = (20 * 0.1 / 2) ** 2 + 0.3
    assert render.rgb[8, 8, 0].item() == pytest.approx(0.5, rel=1e-5)
    assert render.alpha[8, 9].item() == pytest.approx(0.5 * math.exp(-0.5 / variance), rel=1e-5)
    assert render.depth[8, 8].item() == pytest.approx(2.0, rel=1e-5)
    assert render.depth[0, 0].item() == 0
    torch.testing.assert_close(render.normal[8, 8], torch.tensor([-0.5, 0.0, 0.0]).abs() * render.normal[8, 8].sign())
    filtered = rasterize(*single(), width=17, height=17, antialias=True)
    assert filtered.rgb[8, 8, 0].item() == pytest.approx(0.5 * (variance - 0.3) / variance, rel=1e-5)


@pytest.mark.parametrize("rasterize", [reference.rasterize, rasterize_on_cpu], ids=["reference", "cpu"])
@pytest.mark.parametrize(
    ("mean", "seen"),
    [
        ((0.0, 0.0, -2.0), False),
        ((0.0, 0.0, 0.04), False),
        ((0.0, 0.0, 0.06), True),
        ((-1.3, 0.0, 2.0), True),  # projects to x = -4.5; the guard is at -5.1
        ((-1.4, 0.0, 2.0), False),
    ],
)
def test_near_plane_and_frustum_guard(rasterize, mean, seen):
    render = rasterize(*single(mean, opacity=0.9, scale=0.5), width=17, height=17, near=0.05)
    assert (render.alpha.max().item() > 0) == seen


@pytest.mark.parametrize("instruction_set", core.instruction_sets())
def test_instruction_sets_agree(instruction_set, monkeypatch):
    monkeypatch.setattr(rendering, "library", lambda: core.library(instruction_set))
    case = needles(1)
    expected_images, expected = render_and_differentiate(reference.rasterize, case)
    actual_images, actual = render_and_differentiate(rasterize_on_cpu, case)
    for image, expected_image in zip(actual_images, expected_images, strict=True):
        assert relative_error(image, expected_image) < 2e-5
    for name, gradient, expected_gradient in zip(NAMES, actual, expected, strict=True):
        assert relative_error(gradient, expected_gradient) < 1e-4, name
