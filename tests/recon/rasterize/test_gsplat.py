"""The GPU back-end where there is no GPU: our side of it, and gsplat's own PyTorch in place of its kernels.

tests/gpu compares the same on a device.
"""

from __future__ import annotations

import pytest
import torch

from splatnode.recon import rasterize
from splatnode.recon.geometry import twist_gradient
from splatnode.recon.rasterize import DeviceUnavailable, gsplat, reference
from tests.support import gsplat_by_torch
from tests.support.rasterize_cases import (
    CASES,
    HEIGHT,
    NAMES,
    WIDTH,
    changed,
    moderate,
    random_case,
    relative_error,
    render_and_differentiate,
    single,
)


@pytest.fixture
def by_torch(monkeypatch):
    gsplat_by_torch.install(monkeypatch)


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("channels", [reference.CHANNELS, ("rgb",), ("depth", "normal"), ("alpha",)])
def test_images_and_all_gradients_are_the_references(by_torch, channels, antialias):
    options = {"channels": channels, "antialias": antialias}
    expected_images, expected = render_and_differentiate(reference.rasterize, moderate(31), **options)
    actual_images, actual = render_and_differentiate(gsplat.rasterize, moderate(31), **options)
    for image, expected_image in zip(actual_images, expected_images, strict=True):
        assert image.shape == expected_image.shape
        assert (image - expected_image).abs().max() < 1e-4
    for name, gradient, expected_gradient in zip(NAMES, actual, expected, strict=True):
        assert (gradient - expected_gradient).norm() <= 1e-4 * expected_gradient.norm(), name


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("made", CASES)
def test_known_intrinsics_change_nothing_but_the_time(by_torch, made, antialias):
    """Without a gradient of K gsplat gets the Gaussians in the world, otherwise in the camera's frame."""

    def known(*tensors, **options):
        return gsplat.rasterize(*tensors[:6], tensors[6].detach(), **options)

    expected_images, expected = render_and_differentiate(gsplat.rasterize, made(35), antialias=antialias)
    actual_images, actual = render_and_differentiate(known, made(35), antialias=antialias)
    for image, expected_image in zip(actual_images, expected_images, strict=True):
        torch.testing.assert_close(image, expected_image, rtol=0, atol=1e-6)
    for name, gradient, expected_gradient in zip(NAMES[:6], actual, expected, strict=False):
        assert relative_error(gradient, expected_gradient) < 1e-5, name
    assert actual[6].abs().max() == 0


@pytest.mark.parametrize("bases", [1, 4, 9, 16])
def test_colours_of_every_degree(by_torch, bases):
    case = moderate(36)
    harmonics = torch.randn(len(case.means), bases, 3, generator=torch.Generator().manual_seed(0)).double()
    case = changed(case, sh=0.5 * harmonics)
    expected_images, expected = render_and_differentiate(reference.rasterize, case, channels=("rgb",))
    actual_images, actual = render_and_differentiate(gsplat.rasterize, case, channels=("rgb",))
    assert (actual_images[0] - expected_images[0]).abs().max() < 1e-4
    for name, gradient, expected_gradient in zip(NAMES, actual, expected, strict=True):
        assert relative_error(gradient, expected_gradient) < 1e-4, name


@pytest.mark.parametrize(("beside", "drawn"), [(0.29, True), (0.31, False)])
@pytest.mark.parametrize("direction", [(-1, 0), (1, 0), (0, -1), (0, 1)])
@pytest.mark.parametrize("known", [False, True])
def test_what_is_too_far_beside_the_image_is_not_drawn(by_torch, beside, drawn, direction, known):
    """However large it is: a ball as large as its distance."""
    half = torch.tensor([WIDTH / 2, HEIGHT / 2])
    pixel = half + torch.tensor(direction) * (half + beside * 2 * half)
    K = torch.tensor([[20.0, 0, WIDTH / 2], [0, 20, HEIGHT / 2], [0, 0, 1]], requires_grad=not known)
    x, y = ((pixel - half) / 20 * 2).tolist()
    one = single(mean=(x, y, 2.0), opacity=0.9, scale=2.0)
    render = gsplat.rasterize(*one[:6], K, WIDTH, HEIGHT, channels=("alpha",))
    assert render.alpha is not None and bool(render.alpha.max() > 0) == drawn


@pytest.mark.parametrize("packed", [False, True])
def test_it_is_what_gsplat_makes_of_quaternions_harmonics_and_a_pose(by_torch, packed):
    """Of a camera without distortion; by gsplat's function for everything."""
    import gsplat as package  # pyright: ignore[reportMissingImports]

    ours, theirs = moderate(32).tensors(), moderate(32).tensors()
    render = gsplat.rasterize(*ours, width=WIDTH, height=HEIGHT, channels=("rgb", "alpha"))
    means, quats, scales, opacities, sh, T_world_camera, K = theirs
    colours = reference.compute_colours(sh, means - T_world_camera[:3, 3])
    image, alpha, _ = package.rasterization(  # pyright: ignore[reportAttributeAccessIssue]
        means, quats, scales, opacities, colours, torch.linalg.inv(T_world_camera)[None], K[None], WIDTH, HEIGHT,
        packed=packed,
    )  # fmt: skip
    torch.testing.assert_close(render.rgb, image[0], rtol=0, atol=1e-6)
    torch.testing.assert_close(render.alpha, alpha[0, ..., 0], rtol=0, atol=1e-6)
    (render.rgb**2).sum().backward()
    (image**2).sum().backward()
    for name, mine, other in zip(NAMES[:6], ours, theirs, strict=False):
        gradients = [mine.grad, other.grad]
        if name == "T_world_camera":  # in directions that no motion has, the two ways may differ
            gradients = [twist_gradient(each.detach(), each.grad) for each in (mine, other)]
        assert relative_error(*gradients) < 1e-4, name


def test_a_background_shows_through_what_alpha_leaves(by_torch, monkeypatch):
    import gsplat as package  # pyright: ignore[reportMissingImports]

    tensors, white = moderate(33).tensors(), torch.full((1, 3), 1.0).double()
    black = gsplat.rasterize(*tensors, width=WIDTH, height=HEIGHT, channels=("rgb", "alpha"))
    plain = package.rasterize_to_pixels  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setattr(package, "rasterize_to_pixels", lambda *given: plain(*given, backgrounds=white))
    on_white = gsplat.rasterize(*tensors, width=WIDTH, height=HEIGHT, channels=("rgb", "alpha"))
    assert black.rgb is not None and black.alpha is not None
    torch.testing.assert_close(on_white.rgb, black.rgb + (1 - black.alpha)[..., None], rtol=0, atol=1e-6)


def test_the_dispatch_follows_the_tensors(by_torch):
    tensors = moderate(34).tensors()
    direct = gsplat.rasterize(*tensors, width=WIDTH, height=HEIGHT)
    assert torch.equal(rasterize.rasterize(*tensors, WIDTH, HEIGHT).rgb, direct.rgb)


def test_nothing_in_view(by_torch):
    tensors = random_case(32).tensors()
    behind = (tensors[0].detach() - torch.tensor([0, 0, 100.0])).requires_grad_()
    render = gsplat.rasterize(behind, *tensors[1:], width=WIDTH, height=HEIGHT)
    assert render.rgb is not None and render.rgb.shape == (HEIGHT, WIDTH, 3) and render.rgb.abs().max() == 0
    render.rgb.sum().backward()
    assert behind.grad is not None and behind.grad.abs().max() == 0


def test_tensors_must_be_on_the_gpu():
    with pytest.raises(ValueError, match="means must be on cuda for this rasteriser, got cpu"):
        gsplat.rasterize(*random_case(33).tensors(), width=WIDTH, height=HEIGHT)


@pytest.mark.skipif(torch.cuda.is_available(), reason="has a GPU")
def test_a_gpu_that_is_not_there_is_refused_with_what_to_do():
    with pytest.raises(DeviceUnavailable, match=r"device cuda needs an NVIDIA GPU .* but .* Take device auto or cpu"):
        rasterize.choose_device("cuda")
    assert rasterize.choose_device("auto") == rasterize.choose_device("cpu") == torch.device("cpu")
    assert "on the processor: the torch that is installed" in rasterize.format_device("auto", torch.device("cpu"))
