from __future__ import annotations

import numpy as np
import yaml

from splatnode.capture import lenses
from splatnode.capture.frame import Intrinsics
from splatnode.capture.lenses import read_lens
from splatnode.extras.calibration.board import Board, BoardView
from splatnode.extras.calibration.collect import add_view, create_coverage, describe_choice, lens_file
from splatnode.extras.calibration.estimate import MODELS, Choice, choose
from tests.support.board_photographs import waved

BOARD = Board()
LENS = Intrinsics(640, 480, 620.0, 620.0, 325.0, 236.0, "given")


def found(stretch: float) -> tuple[Choice, list[BoardView]]:
    """The lens from a board that was printed so many times too wide."""
    rng, views = np.random.default_rng(0), []
    for number, T in enumerate(waved(BOARD, LENS, 20, 1)):
        points = BOARD.corners * (stretch, 1.0, 1.0)
        pixels = lenses.project(points @ T[:3, :3].T + T[:3, 3], LENS) + rng.normal(0, 0.03, (len(points), 2))
        inside = np.flatnonzero(((pixels > 0) & (pixels < (640, 480))).all(axis=1))
        views.append(BoardView(str(number), inside, pixels[inside]))
    choice = choose(views, BOARD, 640, 480, [MODELS["pinhole"]])
    assert choice is not None
    return choice, views


def test_a_board_that_was_printed_too_wide_is_warned_of():
    straight, views = found(1.0)
    stretched, _ = found(1.02)
    coverage = add_view(create_coverage(640, 480), views[0])
    assert "fx and fy differ" not in " ".join(describe_choice(straight, coverage))
    assert "fx and fy differ by" in " ".join(describe_choice(stretched, coverage))


def test_the_file_is_the_lens_and_says_how_well_it_is_known(tmp_path):
    choice, views = found(1.0)
    text = lens_file(choice, add_view(create_coverage(640, 480), views[0]), BOARD)
    (tmp_path / "lens.yaml").write_text(text)
    lens = read_lens(tmp_path / "lens.yaml")
    assert abs(lens.fx - choice.taken.estimate.lens.fx) < 1e-4 and lens.distortion == ()
    report = yaml.safe_load(text)["calibration"]
    errors = abs(lens.fx - LENS.fx), abs(lens.cx - LENS.cx)
    assert all(error < 4 * report["sigma"][name] for error, name in zip(errors, ("fx", "cx"), strict=True))
    assert report["board"]["square_mm"] == 26.0 and set(report["corner_sigma_px"]) == {
        "upper left",
        "upper right",
        "lower left",
        "lower right",
    }
