"""Dropout leaves out what is uncertain, and the rest makes up for it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatnode.recon.optimize.ensemble import Dropout, DropoutConfig, uncertainty
from splatnode.recon.scene import Gaussians, TrainingView
from splatnode.recon.scene.background import SHELL
from tests.support.synthetic import plane_pointmap

SEEN = plane_pointmap(np.eye(4), confidence=0.3, frame_id=4)


def view(pointmap=SEEN) -> TrainingView:
    image = np.zeros((*SEEN.depth.shape, 3), np.uint8)
    return TrainingView(SEEN.name, 4, image, torch.eye(4), torch.from_numpy(SEEN.K).float(), pointmap)


def gaussians(count: int, source_frame: int = SHELL) -> Gaussians:
    """All at one place before the camera."""
    return Gaussians(
        means=torch.tensor([[0.0, 0.0, 2.0]]).repeat(count, 1),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        log_scales=torch.zeros(count, 3),
        logit_opacities=torch.zeros(count),
        sh=torch.zeros(count, 1, 3),
        source_frame=torch.full((count,), source_frame, dtype=torch.int32),
    )


def test_a_share_of_the_unknown_is_left_out_and_the_others_make_up_for_it():
    opacities = torch.full((20000,), 0.4, requires_grad=True)
    rendered = Dropout(DropoutConfig(share=0.2), gaussians(20000), [view()], seed=0)(opacities, progress=0.0)
    there = rendered > 0
    assert float(there.float().mean()) == pytest.approx(0.8, abs=0.01)
    torch.testing.assert_close(rendered[there], torch.full((int(there.sum()),), 0.5))
    rendered.sum().backward()
    assert opacities.grad is not None and bool((opacities.grad[~there] == 0).all())


def test_the_surer_stereo_is_the_less_is_uncertain():
    assert float(uncertainty(gaussians(1), [view()], 0.6)) == 1  # no photograph started it
    assert float(uncertainty(gaussians(1, 4), [view()], 0.6)) == pytest.approx(0.5)
    assert float(uncertainty(gaussians(1, 4), [view()], 0.3)) == pytest.approx(0)
    assert float(uncertainty(gaussians(1, 4), [view(None)], 0.6)) == 0


def test_a_gaussian_is_looked_up_at_its_pixel():
    SEEN.confidence[:, : SEEN.depth.shape[1] // 2] = 0.9
    left = gaussians(1, 4)
    left.means[0, 0] = -0.2
    assert float(uncertainty(left, [view()], 0.6)) == 0
    left.means[0, 0] = -100.0  # beside the image
    assert float(uncertainty(left, [view()], 0.6)) == 0
    SEEN.confidence[:] = 0.3


def test_what_stereo_is_sure_of_is_never_left_out():
    opacities = torch.full((1000,), 0.4)
    drawn = Dropout(DropoutConfig(share=0.5, sure=0.3), gaussians(1000, 4), [view()], seed=0)(opacities, progress=0.0)
    torch.testing.assert_close(drawn, opacities)


def test_each_render_leaves_out_others_and_a_seed_says_which():
    opacities = torch.full((100,), 0.5)
    first, again = (Dropout(DropoutConfig(share=0.1), gaussians(100), [view()], seed=3) for _ in range(2))
    drawn = [first(opacities, 0.0) for _ in range(2)]
    assert not torch.equal(*drawn)
    assert all(torch.equal(again(opacities, 0.0), each) for each in drawn)


def test_it_follows_the_gaussians():
    dropout = Dropout(DropoutConfig(share=0.5), gaussians(10), [view()], seed=0)
    dropout.follow(gaussians(300))
    assert len(dropout(torch.full((300,), 0.5), 0.0)) == 300


def test_opacities_stay_below_one():
    dropout = Dropout(DropoutConfig(share=0.5), gaussians(100), [view()], seed=0)
    assert float(dropout(torch.full((100,), 0.9), 0.0).max()) < 1


@pytest.mark.parametrize(
    ("config", "progress"), [(DropoutConfig(share=0.1, until=0.7), 0.7), (DropoutConfig(share=0.0), 0.0)]
)
def test_in_the_end_and_without_a_share_all_are_there(config, progress):
    opacities = torch.rand(100)
    assert Dropout(config, gaussians(100), [view()], seed=0)(opacities, progress) is opacities


def test_all_cannot_be_left_out():
    with pytest.raises(ValueError, match="share must be from 0 to below 1, got 1"):
        Dropout(DropoutConfig(share=1.0), gaussians(1), [], seed=0)
