"""The hook of density controls: what they are shown, and that the optimiser goes on with what they give back."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest
import torch
from msgspec import structs

from splatnode.recon.optimize.control import GaussianChange, OptimizerStep
from splatnode.recon.optimize.training import refine
from splatnode.recon.scene import Scene
from tests.recon.optimize.test_refinement import plain, truth  # noqa: F401  a fixture

QUICK = plain(iterations=6, half_resolution_share=0.5)


def controlled(scene: Scene, after_step: Callable[[OptimizerStep], GaussianChange | None]) -> Scene:
    """`scene` after its refinement under a control that is this function."""
    choice = SimpleNamespace(config=None, module=SimpleNamespace(load=lambda config, seed: control))
    control = SimpleNamespace(after_step=after_step)
    return list(refine(scene, structs.replace(QUICK, control=choice), seed=0))[-1]


def test_a_control_sees_every_step_with_its_gradients(truth):  # noqa: F811
    seen = []

    def watch(step: OptimizerStep) -> None:
        assert step.gaussians.means.grad is not None and step.gaussians.means.grad.abs().max() > 0
        assert len(step.Ts_world_camera) == len(step.images) == 3
        seen.append((step.iteration, step.iterations, step.view, step.images[0].width))

    controlled(truth, watch)
    assert [entry[:2] for entry in seen] == [(iteration, 6) for iteration in range(1, 7)]
    assert sorted(entry[2] for entry in seen[:3]) == [0, 1, 2]
    assert [entry[3] for entry in seen] == [32, 32, 32, 64, 64, 64]


def test_the_optimiser_goes_on_with_what_a_control_gives_back(truth):  # noqa: F811
    counts = []

    def change(step: OptimizerStep) -> GaussianChange | None:
        counts.append(len(step.gaussians))
        if step.iteration != 2:
            return None
        origin = torch.tensor([5, 1, 1])
        kept = step.gaussians.map(lambda tensor: tensor.detach()[origin])
        return GaussianChange(kept, torch.where(torch.arange(3) == 2, -1, origin))

    scene = controlled(truth, change)
    assert counts == [len(truth.gaussians)] * 2 + [3] * 4
    assert len(scene.gaussians) == 3 and not scene.gaussians.means.requires_grad
    assert scene.gaussians.source_frame.tolist() == truth.gaussians.source_frame[[5, 1, 1]].tolist()
    first, second = scene.gaussians.means[1:]
    assert 0 < (first - second).abs().max() < 0.1  # alike but for their moments


def test_a_control_that_changes_nothing_changes_nothing(truth):  # noqa: F811
    plain = list(refine(truth, QUICK, seed=0))[-1]
    torch.testing.assert_close(
        controlled(truth, lambda step: None).gaussians.means, plain.gaussians.means, rtol=0, atol=0
    )


def test_a_change_whose_rows_do_not_fit_their_origins_is_an_error(truth):  # noqa: F811
    with pytest.raises(ValueError, match="for these origins"):
        controlled(truth, lambda step: GaussianChange(step.gaussians.map(torch.Tensor.detach), torch.zeros(3).long()))
