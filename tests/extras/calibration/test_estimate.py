"""The estimate on corners whose places are known: no picture is looked at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from splatnode.capture import lenses
from splatnode.capture.frame import Intrinsics
from splatnode.extras.calibration.board import Board, BoardView
from splatnode.extras.calibration.collect import ENOUGH
from splatnode.extras.calibration.estimate import MODELS, choose, estimate_lens, pixel_sigmas
from tests.support.board_photographs import parallel, waved

WIDTH, HEIGHT = 640, 480
SIGMA = 0.03  # pixels, of a corner
CORNERS = np.array([[0.0, 0.0], [WIDTH, 0.0], [0.0, HEIGHT], [WIDTH, HEIGHT]])
BOARD = Board()
LENSES = {
    "pinhole": Intrinsics(WIDTH, HEIGHT, 620.0, 618.0, 325.0, 236.0, "given"),
    "opencv2": Intrinsics(WIDTH, HEIGHT, 640.0, 641.0, 325.0, 236.0, "given", (-0.3, 0.02, 0.0, 0.0)),
    "fisheye": Intrinsics(WIDTH, HEIGHT, 216.0, 216.0, 325.0, 236.0, "given", (0.01, -0.005, 0.001, 0.0), "fisheye"),
}


def views_of(lens: Intrinsics, Ts: Sequence[np.ndarray], seed: int = 0, spoilt: int = 0) -> list[BoardView]:
    """What would be seen of the board; `spoilt` corners of each view are far off."""
    rng, views = np.random.default_rng(seed), []
    for number, T in enumerate(Ts):
        pixels = lenses.project(BOARD.corners @ T[:3, :3].T + T[:3, 3], lens)
        inside = np.flatnonzero(((pixels > 0) & (pixels < (lens.width, lens.height))).all(axis=1))
        noise = rng.normal(0, SIGMA, (len(inside), 2))
        noise[:spoilt] += rng.choice([-3.0, 3.0], (min(spoilt, len(inside)), 2))
        if len(inside) >= 12:
            views.append(BoardView(str(number), inside, pixels[inside] + noise))
    return views


@pytest.mark.parametrize("name", LENSES)
def test_the_lens_is_found_and_its_model_chosen(name: str):
    true = LENSES[name]
    choice = choose(views_of(true, waved(BOARD, true, 30, 3)), BOARD, WIDTH, HEIGHT)
    assert choice is not None
    found = choice.taken.estimate
    assert found.model.name == name
    assert abs(found.lens.fx / true.fx - 1) < 0.001
    errors = np.linalg.norm(lenses.project(lenses.unproject(CORNERS, true), found.lens) - CORNERS, axis=1)
    assert errors.max() < 0.3
    assert (errors < 3.0 * pixel_sigmas(found, CORNERS)).all()
    assert found.rms_px == pytest.approx(SIGMA * np.sqrt(2), rel=0.1)


def test_what_is_told_of_the_errors_is_what_they_are():
    """Over 12 draws of the noise the errors are as large as the covariance says."""
    true, model, ratios = LENSES["opencv2"], MODELS["opencv2"], []
    for seed in range(12):
        found = estimate_lens(views_of(true, waved(BOARD, true, 20, seed), seed), BOARD, model, WIDTH, HEIGHT)
        assert found is not None
        errors = np.array([found.lens.fx - true.fx, found.lens.cx - true.cx, found.lens.cy - true.cy])
        ratios.append(errors / np.sqrt(np.diag(found.covariance)[[0, 2, 3]]))
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_corners_that_were_not_seen_right_are_left_out():
    true = LENSES["pinhole"]
    views = views_of(true, waved(BOARD, true, 20, 5), spoilt=2)
    found = estimate_lens(views, BOARD, MODELS["opencv2"], WIDTH, HEIGHT)
    assert found is not None and found.left_out >= 2 * len(views) - 2
    assert abs(found.lens.fx / true.fx - 1) < 0.001


def test_a_board_that_was_always_parallel_leaves_the_focal_length_open():
    true = LENSES["pinhole"]
    flat = estimate_lens(views_of(true, parallel(BOARD, true, 20, 5)), BOARD, MODELS["pinhole"], WIDTH, HEIGHT)
    assert flat is None or flat.focal_sigma > ENOUGH.focal


def test_views_of_another_board_fit_no_lens():
    true = LENSES["pinhole"]
    views = views_of(true, waved(BOARD, true, 12, 5))
    found = estimate_lens(views, Board(12, 7), MODELS["opencv2"], WIDTH, HEIGHT)
    assert found is None or found.rms_px > 1.0
