from __future__ import annotations

import numpy as np

from splatnode.extras.calibration.board import BoardView
from splatnode.extras.calibration.collect import add_picture, add_view, create_coverage, describe_missing_coverage

LIGHT = np.full((300, 400, 3), 100, np.uint8)


def view(*pixels: tuple[float, float]) -> BoardView:
    return BoardView("a", np.arange(len(pixels)), np.array(pixels, np.float64))


def test_cells_in_which_a_corner_was_seen_are_marked():
    coverage = add_view(add_picture(create_coverage(400, 300), LIGHT), view((5.0, 5.0), (399.9, 299.9), (201.0, 5.0)))
    assert coverage.text_rows == ["#....#....", *["." * 10] * 6, ".........#"]
    assert coverage.share == 3 / 80
    assert coverage.open_corners == ("upper right", "lower left")
    assert "upper right and lower left" in str(describe_missing_coverage(coverage))


def test_where_a_fisheye_has_no_picture_nothing_need_be_seen():
    y, x = np.mgrid[:300, :400]
    circle = LIGHT * ((x - 200) ** 2 + (y - 150) ** 2 < 110**2)[..., None]
    coverage = add_picture(create_coverage(400, 300), circle.astype(np.uint8))
    assert coverage.text_rows[0] == " " * 10 and coverage.text_rows[4].startswith(" ")
    inside = [(x, y) for x in range(95, 310, 5) for y in range(45, 260, 5)]
    coverage = add_view(coverage, view(*inside))
    assert describe_missing_coverage(coverage) is None
    middle = np.array([200.0, 150.0])
    assert (np.linalg.norm(coverage.outermost - middle, axis=1) < 200).all()  # the picture's own corners are at 250


def test_too_small_a_part_is_refused():
    corners = [(x, y) for x in (5.0, 395.0) for y in (5.0, 295.0)]
    coverage = add_view(add_picture(create_coverage(400, 300), LIGHT), view(*corners))
    assert coverage.open_corners == () and "in 5% of the picture, and 75% is needed" in str(
        describe_missing_coverage(coverage)
    )
