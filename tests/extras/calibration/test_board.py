from __future__ import annotations

import cv2
import numpy as np
import pytest

from splatnode.extras.calibration.board import PAPERS, Board, Page, board_page

_PIXELS_PER_MM = 4


def drawn(page: Page) -> np.ndarray:
    """The page's rectangles as grey levels, by nothing of what made them."""
    size = round(page.paper.height_mm * _PIXELS_PER_MM), round(page.paper.width_mm * _PIXELS_PER_MM)
    picture = np.full(size, 255, np.uint8)
    for mark in page.rectangles:
        ends = np.array([mark.x_mm, mark.y_mm, mark.x_mm + mark.width_mm, mark.y_mm + mark.height_mm])
        x0, y0, x1, y1 = np.round(ends * _PIXELS_PER_MM).astype(int)
        picture[y0:y1, x0:x1] = 0
    return picture


@pytest.mark.parametrize("paper", ["a4", "letter"])
@pytest.mark.parametrize("board", [Board(), Board(8, 6, 30.0, 22.0, "6X6_250"), Board(5, 5, 30.0, 20.0, "4X4_50")])
def test_opencv_finds_every_corner_of_the_printed_board_where_it_should_be(paper: str, board: Board):
    page = board_page(board, PAPERS[paper])
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board.charuco).detectBoard(drawn(page))
    assert sorted(ids.ravel()) == list(range(board.num_corners))
    sides = np.array([board.columns, board.rows]) * board.square_mm
    paper_mm = np.array([page.paper.width_mm, page.paper.height_mm])
    expected = (paper_mm - sides) / 2 + board.corners[ids.ravel(), :2]
    found = (corners.reshape(-1, 2) + 0.5) / _PIXELS_PER_MM
    assert np.abs(found - expected).max() < 0.15  # mm; a pixel of this picture is .25


def test_a_board_that_the_paper_does_not_hold_is_refused():
    with pytest.raises(ValueError, match="300 x 210 mm; paper of 297 x 210 mm has no room"):
        board_page(Board(square_mm=30.0, marker_mm=20.0), PAPERS["a4"])
    board_page(Board(), PAPERS["letter"])


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"columns": 2}, "3 x 3 squares or more, got 2 x 7"),
        ({"dictionary": "5X5"}, "must be one of 4X4_100"),
        ({"dictionary": "4X4_50", "columns": 20}, "needs 70 markers; the dictionary 4X4_50 has 50"),
        ({"marker_mm": 30.0}, "smaller than its square of 26 mm, got 30"),
    ],
)
def test_a_board_that_cannot_be_is_refused(wrong: dict, said: str):
    with pytest.raises(ValueError, match=said):
        Board(**wrong)
