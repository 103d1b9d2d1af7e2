"""Dropout leaves out what it is told to, and the rest makes up for it."""

import pytest
import torch

from recon.dropout import Config, Dropout


def test_a_share_is_left_out_and_the_others_make_up_for_it():
    opacities = torch.full((20000,), 0.4, requires_grad=True)
    rendered = Dropout(Config(share=0.2), seed=0)(opacities, progress=0.0)
    there = rendered > 0
    assert float(there.float().mean()) == pytest.approx(0.8, abs=0.01)
    torch.testing.assert_close(rendered[there], torch.full((int(there.sum()),), 0.5))
    rendered.sum().backward()
    assert opacities.grad is not None and bool((opacities.grad[~there] == 0).all())


def test_each_render_leaves_out_others_and_a_seed_says_which():
    opacities = torch.full((100,), 0.5)
    first, again = Dropout(Config(share=0.1), seed=3), Dropout(Config(share=0.1), seed=3)
    drawn = [first(opacities, 0.0) for _ in range(2)]
    assert not torch.equal(*drawn)
    assert all(torch.equal(again(opacities, 0.0), each) for each in drawn)


def test_opacities_stay_below_one():
    assert float(Dropout(Config(share=0.5), seed=0)(torch.full((100,), 0.9), 0.0).max()) < 1


def test_in_the_end_all_are_there():
    opacities = torch.rand(100)
    assert Dropout(Config(share=0.1, until=0.7), seed=0)(opacities, progress=0.7) is opacities


def test_by_default_nothing_is_left_out():
    opacities = torch.rand(100)
    assert Dropout(Config(), seed=0)(opacities, progress=0.0) is opacities


def test_all_cannot_be_left_out():
    with pytest.raises(ValueError, match="share must be from 0 to below 1, got 1"):
        Dropout(Config(share=1.0), seed=0)
