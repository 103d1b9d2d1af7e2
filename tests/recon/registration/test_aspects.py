"""Pixels that are far from square, of which nothing tells: their aspect is found, and no other lens passes for it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.extras.evaluate.dataset import TrueCamera
from splatnode.extras.evaluate.stability.perturbations import TrialImage
from splatnode.recon.registration import incremental_mapper, mapping_problem, self_calibration
from splatnode.recon.registration.incremental_mapper import FinalModel, MapperConfig
from splatnode.recon.registration.mapping_problem import Lens, MapperInput, MapperView
from tests.recon.registration.test_mapper import SIZE, Photographed, built, compared, errors, photographed
from tests.recon.registration.test_own_lenses import check_within_bounds, estimate, photographs

CONFIG = MapperConfig()
ASPECT = 1.5


def squeeze(photo: TrialImage, width: int, height: int) -> TrialImage:
    """The whole photograph, resized to another shape."""
    assert photo.camera is not None
    K = photo.camera.K_for(width, height)
    image = cv2.resize(photo.image, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
    return replace(photo, image=image, camera=TrueCamera(photo.camera.T_world_camera, K, width, height))


def stretch(taken: Photographed, factors: tuple[float, ...]) -> Photographed:
    """The same views, each enlarged downwards by its factor."""
    return replace(taken, pixels=[pixels * (1.0, by) for pixels, by in zip(taken.pixels, factors, strict=True)])


@pytest.fixture(scope="module")
def stretched() -> Photographed:
    return stretch(photographed(), (ASPECT,) * 5)


@pytest.mark.numerical
def test_photographs_that_were_made_square_are_right_within_their_bounds():
    photos = [squeeze(photo, 320, 320) for photo in photographs()[:4]]
    found = estimate(photos)
    check_within_bounds(photos, found)
    assert found.registration is not None
    for camera in found.registration.cameras:
        assert camera.aspect == pytest.approx(4 / 3, rel=0.05)


def test_an_aspect_that_all_views_have_is_found(stretched):
    found = built(stretched, compared(stretched), (1000.0,))
    assert found.estimate.aspects == pytest.approx(ASPECT, rel=0.02)
    assert len(found.estimate.aspects) == 1 and len(found.views) == 5
    rotation_deg, centre = errors(stretched, found)
    assert rotation_deg < 0.3 and centre < 0.02


def test_pixels_that_are_square_stay_so():
    taken = photographed()
    found = built(taken, compared(taken), (1000.0,))
    assert found.prior.aspect_sigmas is None or (found.prior.aspect_sigmas <= CONFIG.own_lenses.aspect_sigma).all()
    assert found.estimate.aspects == pytest.approx(1.0, abs=0.005)


def test_zoomed_views_do_not_pass_for_pixels_that_are_not_square():
    """An aspect explains a part of what a zoom of some views does, and lenses of their own explain all of it."""
    taken = photographed()
    zoomed = replace(taken, pixels=[pixels * (1.0 if i < 2 else 1.2) for i, pixels in enumerate(taken.pixels)])
    found = built(zoomed, compared(zoomed), (1000.0,))
    focals = np.exp(found.estimate.log_focals[found.estimate.lens_of_camera])
    assert focals == pytest.approx([900.0, 900.0, 1080.0, 1080.0, 1080.0], rel=0.03)
    assert found.estimate.aspects == pytest.approx(1.0, abs=0.01)


def finished(taken: Photographed, num_lenses: int, aspect: float) -> tuple[MapperInput, FinalModel]:
    """A finished model whose lenses are given another aspect."""
    views = [MapperView(points, 0, max(SIZE)) for points in taken.pixels]
    pairs, lenses = compared(taken), [Lens((900.0,), 0.3)] * num_lenses
    problem = mapping_problem.prepare(views, lenses, pairs, 100, 100)
    partial = incremental_mapper.grow(problem, [900.0] * num_lenses, (0, 1), CONFIG.incremental)
    assert partial is not None
    found = incremental_mapper.run_final_adjustment(problem, partial, (), CONFIG.finishing)
    assert found is not None
    estimate = replace(found.model.estimate, log_aspects=np.full(num_lenses, np.log(aspect)))
    return problem, replace(found, model=replace(found.model, estimate=estimate))


@pytest.mark.parametrize(
    ("lenses", "ratio", "kept"),
    [(3, 0.9, "other"), (3, 1.02, "other"), (3, 1.06, "unknown"), (3, 1.2, "own"), (1, 0.8, "other"), (1, 0.9, "own")],
)
def test_of_two_explanations_the_better_or_simpler_one_is_kept(monkeypatch, lenses, ratio, kept):
    own, other = finished(photographed(3), lenses, 1.0), finished(photographed(3), 1, 1.2)
    errors = {id(own[1].model): 1.0, id(other[1].model): ratio}
    monkeypatch.setattr(mapping_problem, "compute_median_error", lambda _, partial: errors[id(partial)])
    chosen = incremental_mapper._choose_aspect(own, other, CONFIG)
    if kept != "unknown":
        assert chosen is (own if kept == "own" else other)
        return
    sigmas = chosen[1].model.prior.aspect_sigmas
    assert chosen[1].model.estimate is own[1].model.estimate and sigmas is not None
    assert sigmas[0] == CONFIG.own_lenses.widest_aspect


def test_what_an_aspect_explains_little_of_frees_none():
    _, found = finished(photographed(3), 1, 1.0)
    assert self_calibration.free_aspects(found.model, found.loss, CONFIG.own_lenses) is None
    calibrated = replace(found.model, prior=replace(found.model.prior, sigmas=np.zeros(1)))
    assert not self_calibration.free_aspect_prior(calibrated, CONFIG.own_lenses).own_sigmas[:, 5].any()
