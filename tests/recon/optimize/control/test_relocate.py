"""Relocation: what several Gaussians in one place look like, who moves where, and who gets noise."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from splatnode.recon.optimize.control import ControlChoice
from splatnode.recon.optimize.control.relocate import Config, add_noise, relocate_dead, split_opacity
from splatnode.recon.optimize.training import RefinementConfig as Optimising
from splatnode.recon.optimize.training import refine
from splatnode.recon.scene import Gaussians
from tests.recon.optimize.test_refinement import truth  # noqa: F401  a fixture


def gaussians(opacities: list[float]) -> Gaussians:
    count = len(opacities)
    return Gaussians(
        means=torch.arange(3.0 * count).reshape(count, 3),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.zeros(count, 3),
        logit_opacities=torch.tensor(opacities).logit(),
        sh=torch.arange(3.0 * count).reshape(count, 1, 3),
        source_frame=torch.arange(count, dtype=torch.int32),
    )


@pytest.mark.parametrize(("opacity", "count"), [(0.3, 1), (0.7, 2), (0.9, 5)])
def test_parts_in_one_place_look_like_the_whole(opacity, count):
    shared, narrower = split_opacity(torch.tensor([count]), torch.tensor([opacity]))
    assert 1 - (1 - float(shared)) ** count == pytest.approx(opacity, abs=1e-5)
    x = torch.linspace(-12, 12, 20001).double()
    together = 1 - (1 - shared.double() * torch.exp(-0.5 * (x / narrower.double()) ** 2)) ** count
    assert float(torch.trapezoid(together, x)) == pytest.approx(opacity * (2 * torch.pi) ** 0.5, rel=1e-4)


def test_the_dead_move_to_the_living_and_start_anew():
    before = gaussians([0.6, 0.001, 0.004])
    after, origin = relocate_dead(before, 0.005, torch.Generator().manual_seed(0))
    assert torch.equal(after.means, before.means[[0, 0, 0]])
    assert torch.equal(after.sh, before.sh[[0, 0, 0]])
    assert origin.tolist() == [-1, -1, -1]  # the living one, too: it is a third of itself now
    torch.testing.assert_close(after.opacities, torch.full((3,), 1 - 0.4 ** (1 / 3)))


def test_where_none_is_dead_or_none_alive_nothing_moves():
    for opacities in ([0.6, 0.5], [0.001, 0.002]):
        before = gaussians(opacities)
        after, origin = relocate_dead(before, 0.005, torch.Generator().manual_seed(0))
        assert after is before and origin.tolist() == [0, 1]


def test_the_transparent_move_within_their_extent_and_the_opaque_stay():
    before = gaussians([1e-4] * 500 + [0.5] * 500)
    flat = replace(before, log_scales=torch.tensor([0.0, -1.0, -20.0]).repeat(1000, 1))
    moves = add_noise(flat, 0.1, torch.Generator().manual_seed(0)).means - flat.means
    spread = moves[:500].std(0)
    assert float(spread[0] / spread[1]) == pytest.approx(float(torch.e**2), rel=0.2)  # as the variances
    assert moves[:, 2].abs().max() == 0
    assert moves[500:].abs().max() < 1e-3 * moves[:500].abs().max()


def test_it_refines_a_scene_without_changing_its_number(truth):  # noqa: F811
    optimising = Optimising(iterations=12, checkpoints=(), control=ControlChoice("relocate", Config(every=3)))
    dying = replace(truth.gaussians, logit_opacities=truth.gaussians.logit_opacities.clone())
    dying.logit_opacities[::2] = -8.0
    scene = list(refine(replace(truth, gaussians=dying), optimising, seed=0))[-1]
    assert len(scene.gaussians) == len(truth.gaussians)
    assert bool(torch.isfinite(scene.gaussians.means).all())
    assert (scene.gaussians.opacities > 0.01).sum() > (dying.opacities > 0.01).sum()
