"""L1 + D-SSIM: the core against the reference, and both against values worked out by hand."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from splatnode.recon import core, rasterize
from splatnode.recon.optimize import photometric_losses
from splatnode.recon.optimize.photometric_losses import PhotometricLoss


def textured(height: int, width: int, seed: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(height, width, 3, generator=generator, dtype=torch.float64)
    return (target + 0.1 * noise).float().double(), target.float().double()


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 50), (37, 5), (48, 64), (200, 75)])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("instruction_set", core.instruction_sets())
def test_value_and_gradient(height, width, weighted, instruction_set, monkeypatch):
    monkeypatch.setattr(photometric_losses, "library", lambda: core.library(instruction_set))
    rgb, target = textured(height, width, height)
    weights = torch.ones(height, width).double()
    if weighted:
        generator = torch.Generator().manual_seed(2)
        weights = torch.rand(height, width, generator=generator).double()
        weights[weights < 0.3] = 0
        weights[0, 0] = 1
    expected_rgb = rgb.clone().requires_grad_()
    expected = photometric_losses.photometric_loss(expected_rgb, target.permute(2, 0, 1), 0.2, weights)
    expected.backward()
    actual_rgb = rgb.float().requires_grad_()
    actual = PhotometricLoss(target, weights=weights if weighted else None)(actual_rgb)
    (3 * actual).backward()
    assert actual.item() == pytest.approx(expected.item(), rel=1e-5)
    assert expected_rgb.grad is not None and actual_rgb.grad is not None
    error = (actual_rgb.grad.double() / 3 - expected_rgb.grad).norm() / expected_rgb.grad.norm()
    assert error < 2e-5
    assert actual_rgb.grad[weights == 0].abs().sum() == 0


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 50), (37, 5), (48, 64)])
@pytest.mark.parametrize("weighted", [False, True])
def test_the_closed_form_is_the_references(height, width, weighted):
    rgb, target = textured(height, width, height)
    weights = torch.rand(height, width, generator=torch.Generator().manual_seed(2)).double() if weighted else None
    if weights is not None:
        weights[weights < 0.3] = 0
        weights[0, 0] = 1
    target = target.permute(2, 0, 1).contiguous()
    expected_rgb = rgb.clone().requires_grad_()
    expected = photometric_losses.photometric_loss(expected_rgb, target, 0.4, weights)
    expected.backward()
    weighing = photometric_losses.make_weights(target, 0.4, weights)
    value, gradient = photometric_losses.evaluate_loss(rgb.permute(2, 0, 1), target, weighing)
    assert value.item() == pytest.approx(expected.item(), rel=1e-10)
    torch.testing.assert_close(gradient.permute(1, 2, 0), expected_rgb.grad, rtol=1e-8, atol=1e-12)
    assert gradient.permute(1, 2, 0).is_contiguous()  # as the rasteriser wants it


def test_where_torch_computes_single_precision_suffices(monkeypatch):
    monkeypatch.setattr(rasterize, "is_on_cpu", lambda tensor: False)
    rgb, target = textured(60, 80, 5)
    rgb, target = 0.02 * rgb + 0.9, 0.02 * target + 0.9  # bright and almost plain: where variances lose most digits
    expected_rgb, actual_rgb = rgb.clone().requires_grad_(), rgb.float().requires_grad_()
    expected = photometric_losses.photometric_loss(expected_rgb, target.permute(2, 0, 1), 0.4)
    expected.backward()
    actual = PhotometricLoss(target, 0.4)(actual_rgb)
    (3 * actual).backward()
    assert actual.item() == pytest.approx(expected.item(), rel=1e-4)
    assert expected_rgb.grad is not None and actual_rgb.grad is not None
    error = (actual_rgb.grad.double() / 3 - expected_rgb.grad).norm() / expected_rgb.grad.norm()
    assert error < 1e-3


def test_equal_images_have_no_loss(computed_by):
    _, target = textured(30, 40, 1)
    rgb = target.float().requires_grad_()
    loss = PhotometricLoss(target)(rgb)
    loss.backward()
    assert loss.item() == pytest.approx(0, abs=1e-6)
    assert rgb.grad is not None and rgb.grad.abs().max() < 1e-6


def test_constant_difference_by_hand(computed_by):
    """Without SSIM: the mean absolute difference; its gradient is the sign over the count."""
    rgb = torch.full((4, 6, 3), 0.75, requires_grad=True)
    loss = PhotometricLoss(torch.full((4, 6, 3), 0.5), ssim_weight=0)(rgb)
    loss.backward()
    assert loss.item() == pytest.approx(0.25)
    torch.testing.assert_close(rgb.grad, torch.full((4, 6, 3), 1 / 72))


def test_ignored_pixels_have_no_influence(computed_by):
    rgb, target = textured(40, 50, 3)
    weights = torch.ones(40, 50)
    weights[10:20, 10:30] = 0
    changed = rgb.clone()
    changed[10:20, 10:30] = 100
    loss = PhotometricLoss(target, weights=weights)
    assert loss(rgb).item() == loss(changed).item()
    assert PhotometricLoss(target, weights=torch.zeros(40, 50))(rgb).item() == 0


def test_the_result_does_not_depend_on_threads():
    rgb, target = textured(300, 64, 4)
    before = core.library().core_get_threads()
    gradients = []
    try:
        for threads in (1, 2, 3):
            core.set_threads(threads)
            image = rgb.float().requires_grad_()
            PhotometricLoss(target)(image).backward()
            gradients.append(image.grad)
    finally:
        core.set_threads(before)
    assert torch.equal(gradients[0], gradients[1]) and torch.equal(gradients[0], gradients[2])


def test_moments_that_are_not_kept_change_nothing():
    rgb, target = textured(40, 30, 3)
    kept, computed = (PhotometricLoss(target, keep_moments=keep)(rgb.float()) for keep in (True, False))
    assert kept == computed


def test_planar_images_are_not_copied():
    """The rasteriser's images are views of planar memory; so are the gradients that come back."""
    planar = torch.rand(3, 20, 30)
    rgb = planar.permute(1, 2, 0).requires_grad_()
    PhotometricLoss(torch.rand(20, 30, 3))(rgb).backward()
    assert rgb.grad is not None and rgb.grad.permute(2, 0, 1).is_contiguous()


@pytest.mark.parametrize(
    ("target", "rgb", "weights", "message"),
    [
        (torch.zeros(3, 4, 5), None, None, r"target must be \(H, W, 3\) floats, got \(3, 4, 5\)"),
        (torch.zeros(4, 5, 3, dtype=torch.uint8), None, None, "target must be .* floats"),
        (torch.full((4, 5, 3), float("nan")), None, None, "target must be finite"),
        (torch.zeros(4, 5, 3), torch.zeros(5, 4, 3), None, r"rgb must be \(4, 5, 3\)"),
        (torch.zeros(4, 5, 3), torch.zeros(4, 5, 3), torch.zeros(5, 4), r"weights must be \(4, 5\)"),
    ],
)
def test_bad_input_is_named(target, rgb, weights, message):
    with pytest.raises(ValueError, match=message):
        PhotometricLoss(target, weights=weights)(rgb)
