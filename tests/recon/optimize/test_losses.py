"""Every loss has a value computed by hand, exact gradients, and is zero at its optimum."""

from __future__ import annotations

import math

import pytest
import torch

from splatnode.recon.networks.lpips import load_lpips
from splatnode.recon.optimize.losses.depth import local_depth_loss, pearson, tiles
from splatnode.recon.optimize.losses.normal import normal_loss
from splatnode.recon.optimize.losses.semantic import DinoFeatures, semantic_loss
from splatnode.recon.optimize.photometric_losses import LpipsDistance, MultiScaleGradient, load_perceptual


def image(seed: int, height: int = 64, width: int = 72) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_correlation_by_hand():
    x, y = torch.tensor([[1.0, 2.0, 3.0, 4.0]]), torch.tensor([[1.0, 3.0, 2.0, 4.0]])
    # Deviations (-1.5 -.5 .5 1.5) and (-1.5 .5 -.5 1.5): covariance 4, variances 5 and 5.
    assert pearson(x, y, torch.ones(1, 4)).item() == pytest.approx(0.8)
    assert pearson(x, 7 - 2 * x, torch.ones(1, 4)).item() == pytest.approx(-1.0)
    assert pearson(x, torch.ones(1, 4), torch.ones(1, 4)).item() == 0.0
    outlier = torch.tensor([[1.0, 2.0, 3.0, -90.0]])
    assert pearson(x, outlier, torch.tensor([[1.0, 1.0, 1.0, 0.0]])).item() == pytest.approx(1.0)


def test_tiles_are_the_patches_of_the_image():
    numbers = torch.arange(20.0).view(4, 5)
    assert tiles(numbers, 2).tolist() == [[0, 1, 5, 6], [2, 3, 7, 8], [10, 11, 15, 16], [12, 13, 17, 18]]
    assert tiles(numbers, 9).shape == (1, 20)


def test_local_depth_loss_by_hand():
    """Two patches: in one the rendered depth follows the known one, in the other it runs against it."""
    truth = torch.tensor([[1.0, 2.0, 1.0, 2.0], [3.0, 4.0, 3.0, 4.0]])
    depth = torch.tensor([[2.0, 4.0, 4.0, 3.0], [6.0, 8.0, 2.0, 1.0]])
    loss = local_depth_loss(depth, truth, torch.ones(2, 4), patch=2, share=1.0, generator=generator())
    assert loss.item() == pytest.approx((0.0 + 2.0) / 2)
    other_scale = local_depth_loss(3 * truth + 1, truth, torch.ones(2, 4), patch=2, share=1.0, generator=generator())
    assert other_scale.item() == pytest.approx(0.0, abs=1e-6)


def test_local_depth_loss_draws_its_share_and_skips_what_has_no_shape():
    truth = torch.rand(8, 8, dtype=torch.float64, generator=generator()) + 1
    truth[:, 4:] = 3.0  # flat: nothing to correlate with
    weights = torch.ones(8, 8, dtype=torch.float64)
    depth = torch.rand(8, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_(True)
    local_depth_loss(depth, truth, weights, patch=4, share=0.5, generator=generator()).backward()
    assert depth.grad is not None
    touched = tiles(depth.grad, 4).abs().sum(1) > 0
    assert touched.tolist().count(True) == 1 and not touched[1] and not touched[3]
    assert local_depth_loss(depth, truth, 0 * weights, patch=4, share=1.0, generator=generator()).item() == 0.0


def test_normal_loss_by_hand():
    truth = torch.tensor([[[0.0, 0.0, -1.0], [0.0, 0.0, -1.0]]])
    turned = torch.tensor([[[0.0, 0.0, -0.5], [0.0, -2.0, 0.0]]])  # the same direction, and a right angle
    assert normal_loss(turned, truth, torch.ones(1, 2)).item() == pytest.approx((0 + (2 + 1)) / 2)
    assert normal_loss(turned, truth, torch.tensor([[1.0, 0.0]])).item() == 0.0
    assert normal_loss(0 * turned, truth, torch.ones(1, 2)).item() == 0.0  # nothing rendered there


def test_semantic_loss_by_hand():
    assert semantic_loss(torch.tensor([1.0, 0.0]), torch.tensor([0.0, 1.0])).item() == 2.0
    assert semantic_loss(torch.tensor([0.6, 0.8]), torch.tensor([0.6, 0.8])).item() == 0.0


def test_embeddings_of_dinov2_have_unit_length():
    """Else the semantic loss would compare how strong features are, and not where they point."""

    class Network:
        blocks = range(12)

        def __call__(self, image, layers):
            assert layers == (11,) and max(image.shape[2:]) == 224
            return (torch.tensor([[[3.0, 0.0, 4.0], [9.0, 9.0, 9.0]]]),)

    assert DinoFeatures(Network())(image(0)).tolist() == pytest.approx([0.6, 0.0, 0.8])


def test_multi_scale_gradient_by_hand():
    """One step in x of height 1 instead of 2, on a single scale."""
    truth, half = torch.zeros(4, 4, 3), torch.zeros(4, 4, 3)
    truth[:, 2:], half[:, 2:] = 2.0, 1.0
    strength = 2 * 4 / 12  # of the 4 x 3 horizontal differences 4 are 2; the vertical ones are 0
    expected = (1 * 4 / 12) / (strength + 1e-3)
    assert MultiScaleGradient(scales=1).prepare_distance(truth)(half).item() == pytest.approx(expected)
    assert MultiScaleGradient().prepare_distance(truth)(truth).item() == 0.0
    assert MultiScaleGradient().prepare_distance(truth)(truth + 0.1).item() == pytest.approx(0.0, abs=1e-6)


def test_gradients_are_exact():
    torch.manual_seed(0)
    shape = (8, 8)
    depth, truth = torch.rand(2, *shape, dtype=torch.float64)
    weights = torch.rand(shape, dtype=torch.float64)
    normal, known = torch.randn(2, 4, 4, 3, dtype=torch.float64)
    known = torch.nn.functional.normalize(known, dim=-1)
    embedding, other = torch.randn(2, 5, dtype=torch.float64)
    picture, target = torch.rand(2, 16, 16, 3, dtype=torch.float64)
    losses = (
        (lambda x: local_depth_loss(x, truth, weights, patch=4, share=1.0, generator=generator()), depth),
        (lambda x: normal_loss(x, known, weights[:4, :4]), normal),
        (lambda x: semantic_loss(x, other), embedding),
        (MultiScaleGradient().prepare_distance(target), picture),
    )
    for loss, at in losses:
        assert torch.autograd.gradcheck(loss, (at.requires_grad_(True),))


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"\(H, W\)"):
        local_depth_loss(
            torch.ones(2, 2), torch.ones(2, 3), torch.ones(2, 2), patch=2, share=1.0, generator=generator()
        )
    with pytest.raises(ValueError, match=r"\(H, W, 3\)"):
        normal_loss(torch.ones(2, 2), torch.ones(2, 2), torch.ones(2, 2))
    with pytest.raises(ValueError, match=r"\(D,\)"):
        semantic_loss(torch.ones(2), torch.ones(3))


def test_lpips_as_a_loss(shared):
    """The metric's own value, a gradient that agrees with finite differences, and zero for equal images."""
    network = load_lpips("alex", shared / "weights")
    if network is None:
        pytest.skip("needs LPIPS's weights, which the shared test data has not")
    truth, other = image(0), image(1).requires_grad_(True)
    distance = LpipsDistance(network, "LPIPS AlexNet").prepare_distance(truth)
    assert distance(truth).item() == 0.0
    value = distance(other)
    assert value.item() == pytest.approx(network(other, truth), abs=1e-6)
    value.backward()
    assert other.grad is not None
    direction = other.grad / other.grad.norm()
    with torch.no_grad():
        step = 1e-2
        slope = (distance(other + step * direction) - distance(other - step * direction)).item() / (2 * step)
    assert slope == pytest.approx(other.grad.norm().item(), rel=0.05)


def test_without_weights_structure_serves(tmp_path):
    assert load_perceptual(tmp_path).name == "multi-scale gradient"
    assert math.isfinite(load_perceptual(tmp_path).prepare_distance(image(0))(image(1)).item())
