"""The perceptual loss compares what shows the scene, in every few steps, and is left out without a network."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from msgspec import structs

from splatnode.recon.networks.lpips import Layer, Lpips
from splatnode.recon.optimize import photometric_losses
from splatnode.recon.optimize.photometric_losses import LpipsDistance, PerceptualLossConfig, make_training_image
from splatnode.recon.optimize.training import RefinementConfig as Refinement
from splatnode.recon.optimize.training import refine
from splatnode.recon.scene import Exposure, TrainingView
from tests.support.known_scene import disturbed, photographed

HEIGHT, WIDTH = 40, 56


@pytest.fixture
def measure() -> LpipsDistance:
    """One layer that sees differences of neighbouring pixels."""
    kernels = torch.randn(4, 3, 3, 3, generator=torch.Generator().manual_seed(0))
    weights = {"net.0.weight": kernels, "net.0.bias": torch.zeros(4), "lin0.weight": torch.ones(1, 4, 1, 1)}
    return LpipsDistance(Lpips((Layer(4, tap=True),), weights), "LPIPS AlexNet")


@pytest.fixture
def photograph() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 180, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def view_of(photograph: np.ndarray, exposure: Exposure | None = None) -> TrainingView:
    return TrainingView("a.png", 0, photograph, torch.eye(4), torch.eye(3), exposure=exposure)


def test_it_counts_in_every_few_steps_as_much_as_in_all():
    config = PerceptualLossConfig(weight=0.5, start=0.5, every=3)
    assert [config.weight_in_step(step, 0.6) for step in range(5)] == [1.5, 0.0, 0.0, 1.5, 0.0]
    assert config.weight_in_step(0, 0.4) == 0.0
    assert not any(PerceptualLossConfig().weight_in_step(step, 0.9) for step in range(10))


@pytest.mark.parametrize("keep", [True, False])
def test_only_what_shows_the_scene_is_compared(measure, photograph, keep):
    shown = np.ones((HEIGHT, WIDTH), bool)
    shown[:9] = False
    compared = make_training_image(view_of(photograph), shown, 1.0, 0.2, keep=keep, measure=measure)
    assert compared.perceptual is not None
    same = torch.from_numpy(photograph).float() / 255
    hidden = same.clone()
    hidden[:9] = 0.5
    assert float(compared.perceptual(same)) == float(compared.perceptual(hidden)) == 0.0
    other = torch.full_like(same, 0.3).requires_grad_(True)
    compared.perceptual(other).backward()
    assert other.grad is not None and not other.grad[:9].any() and bool(other.grad[9:].any())


def test_what_is_left_of_the_exposure_costs_nothing(measure, photograph):
    exposed = view_of(photograph, Exposure((2.0, 2.0, 2.0), 0.0, None))
    shown = np.ones((HEIGHT, WIDTH), bool)
    render = 0.8 * torch.from_numpy(photograph).float() / 255
    found = [make_training_image(view, shown, 1.0, 0.2, measure=measure) for view in (exposed, view_of(photograph))]
    with_gain, without = (float(each.perceptual(render)) for each in found if each.perceptual)
    assert with_gain < 0.1 * without


def test_a_photograph_that_the_network_would_pool_away_has_none(measure):
    thin = np.zeros((31, 90, 3), np.uint8)
    assert make_training_image(view_of(thin), np.ones((31, 90), bool), 1.0, 0.2, measure=measure).perceptual is None


def test_it_changes_a_scene_where_there_is_a_network_and_nothing_where_there_is_none(measure, monkeypatch):
    start = disturbed(photographed())
    refined = Refinement(iterations=6, checkpoints=(), control=None)
    configured = structs.replace(refined, perceptual=PerceptualLossConfig(weight=0.2, start=0.0, every=2))

    def end(config, found):
        monkeypatch.setattr(photometric_losses, "load_alex", lambda: found)
        *_, scene = refine(start, config, seed=0)
        return scene

    plain, without, with_it = end(refined, measure), end(configured, None), end(configured, measure)
    assert torch.equal(plain.gaussians.sh, without.gaussians.sh)
    assert not torch.equal(plain.gaussians.sh, with_it.gaussians.sh)
    assert plain.losses[0] == with_it.losses[0]  # which are photometric
    assert plain.served_by == {}
    assert without.served_by == {"perceptual": "nothing: no weights"}
    assert with_it.served_by == {"perceptual": measure.name}
