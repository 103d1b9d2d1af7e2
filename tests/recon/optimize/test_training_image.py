"""A photograph is compared at its size or a smaller one, where it shows the scene."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatnode.recon.optimize.photometric_losses import make_training_image
from splatnode.recon.scene import Exposure, TrainingView

HEIGHT, WIDTH = 24, 40


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_only_what_shows_the_scene_is_compared(scale):
    image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    shown = np.ones((HEIGHT, WIDTH), bool)
    image[:3], shown[:3] = 0, False
    K = torch.tensor([[40.0, 0, 20], [0, 40, 12], [0, 0, 1]])
    compared = make_training_image(TrainingView("a", 0, image, torch.eye(4), K), shown, scale, 0.2)
    assert (compared.width, compared.height) == (WIDTH * scale, HEIGHT * scale)
    torch.testing.assert_close(compared.K[:2], scale * K[:2])
    grey = torch.full((compared.height, compared.width, 3), 128 / 255, requires_grad=True)
    assert compared.loss(grey).item() == pytest.approx(0, abs=1e-5)
    brighter = torch.full((compared.height, compared.width, 3), 0.7, requires_grad=True)
    compared.loss(brighter).backward()
    rows = 3 if scale == 1 else 2  # a pixel of the smaller photograph that mixes both is left out
    assert brighter.grad is not None
    assert not brighter.grad[:rows].any() and bool((brighter.grad[rows:] != 0).all())


def test_a_photograph_that_is_read_only_is_nothing_to_warn_of(recwarn):
    photograph = np.full((8, 12, 3), 51, np.uint8)
    photograph.setflags(write=False)
    view = TrainingView("a.png", 0, photograph, torch.eye(4), torch.eye(3))
    found = make_training_image(view, np.ones((8, 12), bool), 1.0, 0.0)
    assert float(found.loss(torch.full((8, 12, 3), 0.2))) == pytest.approx(0.0, abs=1e-6)
    assert not recwarn.list


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_render_may_be_brighter_where_the_photograph_is_saturated(scale):
    image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    saturated = np.zeros((HEIGHT, WIDTH, 3), bool)
    saturated[:, :20] = True
    K = torch.tensor([[40.0, 0, 20], [0, 40, 12], [0, 0, 1]])
    view = TrainingView("a", 0, image, torch.eye(4), K, exposure=Exposure((2.0, 2.0, 2.0), 0.0, saturated))
    compared = make_training_image(view, np.ones((HEIGHT, WIDTH), bool), scale, 0.0)
    for level, expected in ((0.9, False), (0.2, True)):
        render = torch.full((compared.height, compared.width, 3), level, requires_grad=True)
        compared.loss(render).backward()
        assert render.grad is not None
        left, right = (render.grad[:, part] for part in (slice(0, int(20 * scale)), slice(int(20 * scale), None)))
        assert bool((left != 0).all()) is expected and bool((right != 0).all())


def test_what_is_left_of_the_exposure_is_a_gain_that_fits_the_render():
    image = np.random.default_rng(0).integers(40, 200, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    K = torch.tensor([[40.0, 0, 20], [0, 40, 12], [0, 0, 1]])
    shown = np.ones((HEIGHT, WIDTH), bool)
    render = 1.1 * torch.from_numpy(image).float() / 255
    as_it_is = make_training_image(TrainingView("a", 0, image, torch.eye(4), K), shown, 1.0, 0.0)
    exposed = make_training_image(
        TrainingView("a", 0, image, torch.eye(4), K, exposure=Exposure((2.0, 2.0, 2.0), 0.0, None)), shown, 1.0, 0.0
    )
    assert float(exposed.loss(render)) < 0.2 * float(as_it_is.loss(render))
    assert float(exposed.loss(2 * render)) > float(exposed.loss(render))  # the prior: not any gain will do


@pytest.mark.parametrize(("gain", "headroom"), [(1.2, 1.0), (1.7, 1.6)])
def test_of_a_small_exposure_nothing_is_left(gain, headroom):
    image = np.random.default_rng(0).integers(40, 200, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    K = torch.tensor([[40.0, 0, 20], [0, 40, 12], [0, 0, 1]])
    shown = np.ones((HEIGHT, WIDTH), bool)
    render = 1.1 * torch.from_numpy(image).float() / 255
    plain = TrainingView("a", 0, image, torch.eye(4), K)
    saturated = np.zeros((HEIGHT, WIDTH, 3), bool)
    saturated[0] = True
    for known in (None, saturated):
        view = replace(plain, exposure=Exposure((gain,) * 3, 0.1, known))
        exposed = make_training_image(view, shown, 1.0, 0.0, headroom=headroom).loss(render)
        as_it_is = make_training_image(plain, shown, 1.0, 0.0).loss(render)
        assert float(exposed) == pytest.approx(float(as_it_is), rel=0.0 if known is None else 0.1)


def test_a_colour_that_an_exposed_photograph_has_nowhere_is_wrong_in_a_render():
    image = np.random.default_rng(0).integers(40, 200, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    image[..., 1:] = 0
    K = torch.tensor([[40.0, 0, 20], [0, 40, 12], [0, 0, 1]])
    exposure = Exposure((2.0, 2.0, 2.0), 0.0, None)
    view = TrainingView("a", 0, image, torch.eye(4), K, exposure=exposure)
    render = torch.full((HEIGHT, WIDTH, 3), 0.5, requires_grad=True)
    make_training_image(view, np.ones((HEIGHT, WIDTH), bool), 1.0, 0.0).loss(render).backward()
    assert render.grad is not None and bool((render.grad[..., 1:] > 0).all())
