"""Depth Anything V2 and DINOv2 against values of their authors' code; what is made of them, on known answers.

The golden values were computed in float32 by Depth Anything V2's own code, which carries DINOv2's, as it is bundled in
the package instantsplat 1.17.6, with weights generated from their names (tests/support/generated.py);
`depth_head.scratch.output_conv2.2.bias` has 2 added, so that depths are positive. Ours agree to 3e-7.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatnode.recon.networks.depth_anything import (
    INDOORS_M,
    DepthAnythingV2,
    Monocular,
    Size,
    load_metric,
    load_network,
    load_relative,
)
from splatnode.recon.networks.vit import Dinov2, crop
from splatnode.recon.networks.vit import Size as VitSize
from splatnode.recon.optimize.losses.semantic import DinoFeatures, load_dino
from splatnode.recon.optimize.losses.semantic import load_network as load_dinov2
from splatnode.recon.priors import Pointmap, fit_monocular_depth
from tests.support.generated import generated_images, generated_weights, shapes_of

TINY = Size(vit=VitSize(width=48, depth=12, heads=3, grid=5), head_width=16, head_layer_widths=(8, 16, 24, 32))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    path = tmp_path_factory.mktemp("depth_anything") / "depth_anything_v2_vits.pth"
    made = generated_weights(DepthAnythingV2)
    made["depth_head.scratch.output_conv2.2.bias"] = made["depth_head.scratch.output_conv2.2.bias"] + 2.0
    torch.save(made, path)
    return path


def test_depths_equal_those_of_the_authors_code(checkpoint):
    image = generated_images(1, 70, 98)[0]
    inverse = load_network(checkpoint)(image)
    found = [float(value) for value in (inverse[20, 33], inverse[50, 60], inverse.mean(), inverse.std())]
    np.testing.assert_allclose(found, [2.475874662, 2.479676962, 2.064292908, 0.595957160], rtol=2e-6)
    metres = load_network(checkpoint, max_m=INDOORS_M)(image)
    torch.testing.assert_close(metres, 20.0 / (1.0 + (-inverse).exp()))
    with pytest.raises(ValueError, match="multiples of 14"):
        load_network(checkpoint)(image[:, :60])


def test_features_equal_those_of_the_authors_code():
    network = Dinov2()
    network.load_state_dict(generated_weights(Dinov2, prefix="pretrained."))
    with torch.no_grad():
        early, late = network(generated_images(2, 70, 98), (2, 11))
    assert early.shape == late.shape == (2, 36, 384)
    expected = [0.788344443, 2.090086937, -0.633330643, 1.222983360]
    np.testing.assert_allclose(late[0, 0, :4].numpy(), expected, rtol=1e-5)
    np.testing.assert_allclose(late[1, 0, -2:].numpy(), [0.397090733, 1.827463388], rtol=1e-5)


def test_the_checkpoint_of_dinov2_is_known_by_its_names(tmp_path):
    assert len(shapes_of(Dinov2)) == 175 and "mask_token" in shapes_of(Dinov2)
    weights = {name: torch.zeros(shape) for name, shape in shapes_of(Dinov2).items()}
    del weights["blocks.3.ls1.gamma"]
    torch.save(weights, tmp_path / "lacking.pth")
    with pytest.raises(ValueError, match=r"not the checkpoint of DINOv2 ViT-S/14: it lacks blocks\.3\.ls1\.gamma"):
        load_dinov2(tmp_path / "lacking.pth")


def test_the_semantic_embedding_has_gradients():
    network = Dinov2(TINY.vit)
    network.load_state_dict(generated_weights(lambda: Dinov2(TINY.vit)))
    encode = DinoFeatures(network.eval().requires_grad_(False), longer_side=56)
    image = torch.rand(40, 60, 3, generator=torch.Generator().manual_seed(0))
    truth = encode(image)
    assert truth.shape == (48,) and float(truth.norm()) == pytest.approx(1.0)
    other = (image * 0.5).requires_grad_()
    loss = ((encode(other) - truth) ** 2).sum()
    (gradient,) = torch.autograd.grad(loss, other)
    assert loss > 0 and gradient.abs().max() > 0
    with torch.no_grad():
        step = 1e-2 * gradient / gradient.abs().max()
        slope = (((encode(other + step) - truth) ** 2).sum() - ((encode(other - step) - truth) ** 2).sum()) / 2
    assert float(slope) == pytest.approx(float((gradient * step).sum()), rel=0.02)


def test_without_weights_there_is_no_network(tmp_path, monkeypatch):
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    assert load_relative() is None and load_metric() is None and load_dino() is None


def test_a_photograph_goes_in_as_it_is():
    network = DepthAnythingV2(TINY)
    network.load_state_dict(generated_weights(lambda: DepthAnythingV2(TINY)))
    values, to = Monocular(network.eval(), "a test", longer_side=70)(np.zeros((90, 100, 3), np.uint8))
    assert values.shape == (to.height, to.width) == (56, 70)


def test_monocular_depth_takes_its_scale_from_several_views():
    """The truth is a slanted plane; of it the views know a half, a tenth of which is wrong."""
    K = np.array([[100.0, 0, 60], [0, 100.0, 45], [0, 0, 1]])
    u, v = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
    truth = (3.0 / (1.0 + 0.3 * (u - 60) / 100 + 0.2 * (v - 45) / 100)).astype(np.float32)
    rng = np.random.default_rng(0)
    known = rng.random(truth.shape) < 0.5
    wrong = rng.random(truth.shape) < 0.1
    depth = np.where(known, np.where(wrong, 2.0 * truth, truth), 0).astype(np.float32)
    pointmap = Pointmap("a", 0, depth, (depth > 0).astype(np.float32), np.zeros((*depth.shape, 3)), np.eye(4), K)
    image = np.zeros((90, 120, 3), np.uint8)

    def network(photograph: np.ndarray):
        to = crop(120, 90, 60, 14)
        columns, rows = np.meshgrid(np.arange(to.width) + 0.5, np.arange(to.height) + 0.5)
        there = to.map_to_image(np.stack([columns, rows], -1))
        inverse = (1.0 + 0.3 * (there[..., 0] - 60) / 100 + 0.2 * (there[..., 1] - 45) / 100) / 3.0
        return (50.0 * inverse - 7.0).astype(np.float32), to

    full = fit_monocular_depth(pointmap, image, network)
    inside = full.depth > 0
    assert inside.mean() > 0.8 and (full.confidence[inside] == 1).all()
    np.testing.assert_allclose(full.depth[inside], truth[inside], rtol=0.01)
    middle = inside & (np.abs(u - 60) < 50) & (np.abs(v - 45) < 35)
    facing = np.array([-0.3, -0.2, -1.0]) / np.linalg.norm([0.3, 0.2, 1.0])
    assert np.median(full.normal[middle] @ facing) > 0.99
    contradicted = fit_monocular_depth(
        pointmap, image, lambda photograph: (2.0 - network(photograph)[0] / 50, crop(120, 90, 60, 14))
    )
    assert contradicted is pointmap
    nothing = Pointmap("a", 0, 0 * depth, 0 * depth, pointmap.normal, np.eye(4), K)
    assert fit_monocular_depth(nothing, image, network) is nothing
