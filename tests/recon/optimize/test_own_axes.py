import numpy as np
import pytest
import torch

from splatnode.recon.optimize import fit
from splatnode.recon.optimize.fit import (
    LARGEST_EXTENT,
    Shifts,
    axes_by_torch,
    make_axis_rotation,
    rotate_by_torch,
)
from splatnode.recon.scene import Gaussians

pytestmark = pytest.mark.numerical
QUARTER_TURN = [
    np.sqrt(0.5),
    0.0,
    0.0,
    np.sqrt(0.5),
]  # about z: the first axis of a Gaussian points along the world's y


def gaussians(quats: list, scales: list) -> Gaussians:
    count = len(quats)
    return Gaussians(
        means=torch.zeros(count, 3, requires_grad=True),
        quats=torch.tensor(quats, dtype=torch.float32),
        log_scales=torch.tensor(scales, dtype=torch.float32).log(),
        logit_opacities=torch.zeros(count),
        sh=torch.zeros(count, 1, 3),
        source_frame=torch.zeros(count, dtype=torch.int32),
    )


def test_an_offset_goes_along_the_gaussian_s_own_axis_by_its_standard_deviations():
    one = gaussians([QUARTER_TURN], [[0.1, 0.02, 0.03]])
    assert make_axis_rotation(one)(torch.tensor([[2.0, 0.0, 0.0]]), to_world=True).numpy() == pytest.approx(
        np.array([[0.0, 0.2, 0.0]]), abs=1e-6
    )
    assert make_axis_rotation(one)(torch.tensor([[0.0, 1.0, 0.0]]), to_world=True).numpy() == pytest.approx(
        np.array([[-0.02, 0.0, 0.0]]), abs=1e-6
    )


def test_derivatives_by_offsets_are_those_by_the_chain_rule():
    some = random_gaussians()
    offsets = torch.zeros(len(some), 3, requires_grad=True)
    weights = torch.rand(len(some), 3, generator=torch.Generator().manual_seed(1))
    (rotate_by_torch(axes_by_torch(some.quats, some.log_scales), offsets, to_world=True) * weights).sum().backward()
    assert make_axis_rotation(some)(weights, to_world=False).numpy() == pytest.approx(offsets.grad.numpy(), abs=1e-6)


@pytest.mark.parametrize("to_world", [False, True])
def test_the_core_computes_what_torch_computes(to_world: bool):
    some = random_gaussians()
    vectors = torch.randn(len(some), 3, generator=torch.Generator().manual_seed(2))
    expected = rotate_by_torch(axes_by_torch(some.quats, some.log_scales), vectors, to_world)
    assert make_axis_rotation(some)(vectors, to_world).numpy() == pytest.approx(expected.numpy(), abs=1e-5)


def test_what_is_far_larger_than_the_scene_moves_as_if_it_were_not():
    one = gaussians([[1.0, 0.0, 0.0, 0.0]], [[50.0, 0.01, 0.01]])
    assert float(make_axis_rotation(one)(torch.tensor([[1.0, 0.0, 0.0]]), to_world=True)[0, 0]) == pytest.approx(
        LARGEST_EXTENT
    )


def test_the_first_step_moves_each_axis_by_the_rate_whatever_the_gradient_s_size():
    one = gaussians([[1.0, 0.0, 0.0, 0.0]], [[0.1, 0.02, 0.04]])
    one.means.grad = torch.tensor([[1e-3, -5.0, 0.2]])
    Shifts(one).step(one, 0.5)
    assert one.means.detach().numpy() == pytest.approx(np.array([[-0.05, 0.01, -0.02]]), rel=1e-4)


def test_moments_follow_their_gaussians():
    pair = gaussians([[1.0, 0.0, 0.0, 0.0]] * 2, [[0.1] * 3] * 2)
    pair.means.grad = torch.tensor([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0]])
    shifts = Shifts(pair)
    shifts.step(pair, 0.1)
    second = gaussians([[1.0, 0.0, 0.0, 0.0]], [[0.1] * 3])
    shifts.follow(second, torch.tensor([1]))
    second.means.grad = torch.zeros(1, 3)
    shifts.step(second, 0.1)
    assert (second.means > 0).all()  # it goes on as the second of the pair began


def random_gaussians(count: int = 5000) -> Gaussians:
    random = np.random.default_rng(0)
    return gaussians(random.normal(size=(count, 4)).tolist(), random.uniform(1e-3, 0.5, (count, 3)).tolist())


def test_gaussians_on_another_device_are_turned_by_torch(monkeypatch: pytest.MonkeyPatch):
    some, vectors = random_gaussians(20), torch.ones(20, 3)
    expected = make_axis_rotation(some)(vectors, to_world=True)
    monkeypatch.setattr(fit.rasterize, "is_on_cpu", lambda _: False)
    assert make_axis_rotation(some)(vectors, to_world=True).numpy() == pytest.approx(expected.numpy(), abs=1e-6)
