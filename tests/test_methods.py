"""Rival methods are configurations of the same engine."""

from __future__ import annotations

import msgspec
import pytest

from recon import regularise
from recon.config import PRESETS
from recon.evaluate.methods import CONFIGS, METHODS, method
from recon.pipeline import reconstruct
from tests.synthetic import photographs


def test_every_preset_is_a_method():
    assert PRESETS.items() <= CONFIGS.items() and CONFIGS.keys() <= METHODS.keys()
    with pytest.raises(ValueError, match="no method 'nerf'; there are: .*paper"):
        method("nerf")


def test_the_papers_schedule_and_weights():
    terms = CONFIGS["paper"].optimize.regularise
    weights = [term.weight for term in (terms.point_render, terms.depth, terms.normal, terms.semantic)]
    assert weights == [0.25, 0.05, 0.01, 0.5]
    assert CONFIGS["paper"].optimize.iterations == 1000
    assert [term.at(0.1) > 0 for term in (terms.point_render, terms.depth)] == [True, False]
    without = msgspec.structs.replace(CONFIGS["paper"].optimize, regularise=regularise.Config())
    assert without == CONFIGS["instantsplat-xl"].optimize


def test_they_start_from_a_gaussian_a_pixel_and_keep_them():
    few = msgspec.structs.replace(CONFIGS["paper"].optimize, iterations=30, checkpoints=())
    config = msgspec.structs.replace(CONFIGS["paper"], size=160, optimize=few)
    last = list(reconstruct(list(photographs()[:3]), config))[-1]
    assert last.verdict.publishable and last.iterations == 30
    assert len(last.gaussians) > 160 * 120
