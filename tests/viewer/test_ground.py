"""The ground grid, and the legend with the scale bar and the axes."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.recon.result.verdict import RELATIVE, Scale
from splatnode.viewer.shapes import bar_length, format_length, ground, ground_lines, legend, round_number
from splatnode.viewer.state import orbit, project
from tests.viewer.test_scene import camera, moment, wall
from tests.viewer.test_viewpoint import viewpoint


def test_it_is_level_and_lies_below_what_was_photographed():
    there = ground(moment(wall(21), camera(-0.2), camera(0.2, frame_id=1)))
    grid, *axes = ground_lines(there)
    ends = grid.ends  # y points down; the wall ends at 0.3
    assert np.ptp(ends[..., 1]) < 1e-6 and 0.25 < ends[0, 0, 1] < 0.31
    assert np.allclose(np.abs(ends[:, 1] - ends[:, 0]).max(1), np.abs(ends[:, 1] - ends[:, 0]).max())  # a square
    assert there.height(np.zeros(3)) == pytest.approx(ends[0, 0, 1])
    assert [np.argmax(axis.ends[0, 1] - axis.ends[0, 0]) for axis in axes] == [0, 1, 2]
    assert np.allclose([axis.ends[0, 0] for axis in axes], there.centre)


def test_far_gaussians_have_no_say():
    near = ground(moment(wall(21), camera(0.0))).centre[1]
    far = wall(21)
    far.means[:20, 1] = 500.0
    assert ground(moment(far, camera(0.0))).centre[1] == pytest.approx(near, abs=0.05)


def test_without_gaussians_there_is_none():
    assert ground(moment(GaussianArrays.empty(), camera(0.0))) is None and ground_lines(None) == ()


@pytest.mark.parametrize(("least", "cell"), [(0.07, 0.1), (0.1, 0.1), (0.11, 0.2), (3.0, 5.0), (700.0, 1000.0)])
def test_cells_are_round_numbers(least, cell):
    assert round_number(least) == pytest.approx(cell)


@pytest.mark.parametrize(
    ("length", "metric", "said"),
    [
        (0.2, False, "0.2 relative"),
        (1234.5, False, "1230 relative"),
        (0.42, True, "42 cm"),
        (1.0, True, "1 m"),
        (12.346, True, "12.3 m"),
        (0.0035, True, "3.5 mm"),
        (0.00001, True, "0.01 mm"),
    ],
)
def test_a_length_has_its_unit_or_says_that_it_has_none(length, metric, said):
    assert format_length(length, Scale(metric)) == said


@pytest.mark.parametrize("distance", [0.013, 0.4, 1.0, 77.0])
def test_the_scale_bar_is_as_long_as_it_says_at_the_depth_of_the_pivot(distance):
    view, size = viewpoint(distance), (400, 320)
    length = bar_length(view, *size)
    bar = project(legend(view, *size, RELATIVE).lines[0].ends[0], view, *size)
    pivot_and_beside = np.array([view.pivot, view.pivot + length * view.T_world_camera[:3, 0]])
    there = project(pivot_and_beside, view, *size)
    assert np.hypot(*(bar[1] - bar[0])[:2]) == pytest.approx(np.hypot(*(there[1] - there[0])[:2]))
    assert 0.1 * size[0] < bar[1, 0] - bar[0, 0] <= 0.25 * size[0] + 1e-6
    assert float(f"{length:.1g}") == pytest.approx(length) and f"{length:.0e}"[0] in "125"


def test_the_axes_point_where_the_world_s_do():
    view, size = orbit(viewpoint(), 0.7, 0.3), (400, 320)
    shown = legend(view, *size, RELATIVE)
    assert [label.text for label in shown.labels] == ["0.2 relative", "x", "y", "z", "up"]
    ends = [project(lines.ends[0], view, *size)[:, :2] for lines in shown.lines[1:]]
    drawn = np.array([end - start for start, end in ends])
    assert np.allclose(drawn / 34.0, _flat(view))
    corners = np.concatenate(ends)
    assert (corners > 0).all() and (corners < size).all()


def _flat(view) -> np.ndarray:
    """(4, 2) the world's axes and its up, without their part along the view."""
    return np.array([*np.eye(3), view.up]) @ view.T_world_camera[:3, :2]
