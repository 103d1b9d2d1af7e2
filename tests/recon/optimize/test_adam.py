"""The native Adam against torch.optim.Adam, and rows that come and go."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from splatnode.recon.optimize.fit import Adam, Moments, adam_direction

SHAPES = {"means": (5000, 3), "opacities": (5000,), "sh": (5000, 4, 3), "cameras": (3, 6)}


def leaf(value: Tensor) -> Tensor:
    return value.detach().clone().requires_grad_()


def random_params(seed: int) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {name: leaf(torch.randn(*shape, generator=generator)) for name, shape in SHAPES.items()}


def give_gradients(params: dict[str, Tensor], seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for param in params.values():
        param.grad = torch.randn(param.shape, generator=generator)


def test_equals_torch(computed_by):
    ours, theirs = random_params(0), random_params(0)
    lrs = {"means": 1e-2, "opacities": 5e-2, "sh": 2.5e-3, "cameras": 1e-3}
    optimizer = Adam(ours, lrs)
    expected = torch.optim.Adam([{"params": [theirs[name]], "lr": lrs[name]} for name in SHAPES], eps=1e-15)
    for seed in range(5):
        give_gradients(ours, seed)
        give_gradients(theirs, seed)
        optimizer.step()
        expected.step()
    for name in SHAPES:
        torch.testing.assert_close(ours[name], theirs[name], rtol=1e-5, atol=1e-6)


def test_the_first_step_is_the_learning_rate_against_the_sign(computed_by):
    param = leaf(torch.tensor([1.0, 1.0, 1.0]))
    optimizer = Adam({"x": param}, {"x": 0.1})
    param.grad = torch.tensor([5.0, -1e-6, 0.0])
    optimizer.step()
    torch.testing.assert_close(param.detach(), torch.tensor([0.9, 1.1, 1.0]))


def test_factors_scale_rows(computed_by):
    params = {"x": leaf(torch.zeros(4, 3))}
    optimizer = Adam(params, {"x": 0.1})
    params["x"].grad = torch.ones(4, 3)
    optimizer.step({"x": torch.tensor([0.0, 1.0, 2.0, 0.5])})
    torch.testing.assert_close(params["x"].detach()[:, 0], torch.tensor([0.0, -0.1, -0.2, -0.05]))


def test_parameters_without_gradient_stay(computed_by):
    params = random_params(1)
    before = params["means"].detach().clone()
    optimizer = Adam(params, dict.fromkeys(SHAPES, 0.1))
    give_gradients(params, 0)
    params["means"].grad = None
    optimizer.step()
    assert torch.equal(params["means"], before)


def test_old_rows_go_on_as_if_nothing_was_added_or_removed(computed_by):
    alone, changing = leaf(torch.zeros(6, 2)), leaf(torch.zeros(6, 2))
    one, other = Adam({"x": alone}, {"x": 0.1}), Adam({"x": changing}, {"x": 0.1})
    generator = torch.Generator().manual_seed(3)

    def step_both(rows: Tensor) -> None:
        gradient = torch.randn(6, 2, generator=generator)
        alone.grad = gradient
        one.step()
        param = other.params["x"]
        param.grad = torch.cat([gradient[rows], torch.ones(len(param) - len(rows), 2)])
        other.step()
        torch.testing.assert_close(param[: len(rows)], alone[rows])

    step_both(torch.arange(6))
    other.follow({"x": leaf(torch.cat([changing, torch.ones(3, 2)]))}, torch.tensor([0, 1, 2, 3, 4, 5, -1, -1, -1]))
    step_both(torch.arange(6))
    keep = torch.tensor([0, 2, 3, 5, 7, 8])
    other.follow({"x": leaf(other.params["x"][keep])}, keep)
    step_both(torch.tensor([0, 2, 3, 5]))


def test_a_new_row_starts_without_a_past(computed_by):
    params = {"x": leaf(torch.zeros(2))}
    optimizer = Adam(params, {"x": 0.1})
    params["x"].grad = torch.ones(2)
    optimizer.step()
    optimizer.follow({"x": leaf(torch.zeros(3))}, torch.tensor([-1, 1, -1]))
    optimizer.params["x"].grad = torch.zeros(3)
    optimizer.step()
    moved = optimizer.params["x"].detach() != 0
    assert moved.tolist() == [False, True, False]  # only what had a past goes on without a gradient


def test_autograd_notices_the_change(computed_by):
    param = leaf(torch.ones(3))
    optimizer = Adam({"x": param}, {"x": 0.1})
    square = (param * param).sum()
    param.grad = torch.ones(3)
    optimizer.step()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        square.backward()


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"x": torch.zeros(3).double().requires_grad_()}, "x must be a contiguous float32 tensor"),
        ({"x": torch.zeros(3)}, "x must be a leaf that requires its gradient"),
        ({"y": torch.zeros(3).requires_grad_()}, "params and lrs must have the same names"),
    ],
)
def test_bad_parameters_are_named(params, message):
    with pytest.raises(ValueError, match=message):
        Adam(params, {"x": 0.1})


def test_bad_rows_are_named():
    optimizer = Adam({"x": leaf(torch.zeros(4, 3))}, {"x": 0.1})
    with pytest.raises(ValueError, match=r"x must be \(2, 3\) for these origins, got \(3, 3\)"):
        optimizer.follow({"x": leaf(torch.zeros(3, 3))}, torch.tensor([0, 1]))
    with pytest.raises(ValueError, match=r"names \['x'\], got \['y'\]"):
        optimizer.follow({"y": leaf(torch.zeros(3, 3))}, torch.tensor([0, 1, 2]))
    with pytest.raises(ValueError, match=r"lr_factors\['x'\] must be \(4,\)"):
        optimizer.step({"x": torch.ones(3)})


def test_the_direction_of_a_tangent_vector_is_adams():
    """With other decay rates than the default, as the cameras have them."""
    betas, rate = (0.9, 0.99), 1e-2
    theirs = leaf(torch.zeros(6))
    expected = torch.optim.Adam([theirs], lr=rate, betas=betas, eps=1e-15)
    ours, moments = torch.zeros(6), Moments(torch.zeros(6), torch.zeros(6))
    for seed in range(5):
        give_gradients({"pose": theirs}, seed)
        assert theirs.grad is not None
        direction, moments = adam_direction(theirs.grad, moments, betas)
        ours = ours - rate * direction
        expected.step()
    assert moments.steps == 5
    torch.testing.assert_close(ours, theirs.detach(), rtol=1e-5, atol=1e-7)
