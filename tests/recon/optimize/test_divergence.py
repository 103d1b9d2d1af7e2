"""What a refinement may not do to a scene."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon.optimize.training import check_divergence, compute_photometric_misfit, refine
from splatnode.recon.result.verdict import Code
from splatnode.recon.scene import Scene
from tests.recon.optimize.test_refinement import QUICK, disturbed, photographed


@pytest.fixture(scope="module")
def truth() -> Scene:
    return photographed()


def scattered(scene: Scene, lost: float = 0.0) -> Scene:
    """With all Gaussians shrunk to nothing; means moved by `lost`."""
    gaussians = scene.gaussians
    return replace(
        scene,
        gaussians=replace(gaussians, means=gaussians.means + lost, log_scales=gaussians.log_scales - 5),
        iterations=scene.iterations + 100,
    )


def test_the_true_scene_misses_nothing_and_others_more(truth):
    assert (
        compute_photometric_misfit(truth)
        < 0.02
        < compute_photometric_misfit(disturbed(truth))
        < compute_photometric_misfit(scattered(truth))
    )


def test_a_refinement_that_works_is_let_through(truth):
    begun = disturbed(truth)
    *_, refined = refine(begun, QUICK, seed=0)
    assert (
        check_divergence(compute_photometric_misfit(begun), refined) is None
        and check_divergence(compute_photometric_misfit(begun), begun) is None
    )


def test_a_ruined_scene_is_refused_with_both_figures(truth):
    refused = check_divergence(compute_photometric_misfit(truth), scattered(truth))
    assert refused is not None and refused.code is Code.DIVERGED and not refused.publishable
    assert refused.frames == tuple(view.name for view in truth.views)
    assert f"{compute_photometric_misfit(scattered(truth)):.2g}" in refused.message and "optimize.lr" in refused.advice


def test_numbers_that_nothing_can_show_are_refused(truth):
    broken = scattered(truth, lost=math.nan)
    assert compute_photometric_misfit(broken) == math.inf
    refused = check_divergence(compute_photometric_misfit(truth), broken)
    assert refused is not None and refused.code is Code.DIVERGED


def test_of_many_photographs_some_are_looked_at(truth, monkeypatch):
    looked_at: list[str] = []
    monkeypatch.setattr(
        "splatnode.recon.optimize.training._misfit", lambda scene, view, valid: looked_at.append(view.name) or 1.0
    )
    views = tuple(replace(truth.views[0], name=f"{index}.png") for index in range(30))
    assert check_divergence(1.0, replace(scattered(truth), views=views)) is None
    assert looked_at == ["0.png", "8.png", "16.png", "24.png"]


def test_the_black_border_of_undistorted_photographs_is_not_compared(truth):
    def bordered(view):
        image = view.image.copy()
        image[:2] = 0
        return replace(view, image=image)

    bright = replace(truth, gaussians=replace(truth.gaussians, sh=truth.gaussians.sh + 3.0))
    views = tuple(replace(view, image=np.maximum(view.image, 120)) for view in bright.views)
    plain, rimmed = replace(bright, views=views), replace(bright, views=tuple(map(bordered, views)))
    assert compute_photometric_misfit(rimmed) == pytest.approx(compute_photometric_misfit(plain), rel=0.05)
