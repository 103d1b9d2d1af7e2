"""The ground grid of the web viewer."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.viewer.web.ground import _round_number, ground
from tests.viewer.test_scene import camera, moment, wall


def test_it_is_level_and_lies_below_what_was_photographed():
    ends = ground(moment(wall(21), camera(-0.2), camera(0.2, frame_id=1))).ends  # y points down; the wall ends at 0.3
    assert np.ptp(ends[..., 1]) < 1e-6 and 0.25 < ends[0, 0, 1] < 0.31
    assert np.allclose(np.abs(ends[:, 1] - ends[:, 0]).max(1), np.abs(ends[:, 1] - ends[:, 0]).max())  # a square


def test_far_gaussians_have_no_say():
    near = ground(moment(wall(21), camera(0.0))).ends[0, 0, 1]
    far = wall(21)
    far.means[:20, 1] = 500.0
    assert ground(moment(far, camera(0.0))).ends[0, 0, 1] == pytest.approx(near, abs=0.05)


def test_without_gaussians_there_is_none():
    assert ground(moment(GaussianArrays.empty(), camera(0.0))).ends.shape == (0, 2, 3)


@pytest.mark.parametrize(("least", "cell"), [(0.07, 0.1), (0.1, 0.1), (0.11, 0.2), (3.0, 5.0), (700.0, 1000.0)])
def test_cells_are_round_numbers(least, cell):
    assert _round_number(least) == pytest.approx(cell)
