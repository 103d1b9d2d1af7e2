"""Ellipsoids hold 95 % of the errors, point the right way, and are balls where nothing tells their shape."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from splatnode.recon.result.verdict import Bounds, compute_axes, find_widest, make_ball


@pytest.mark.parametrize(
    "sigmas", [(1.0, 1.0, 1.0), (5.0, 1.0, 1.0), (3.0, 3.0, 0.5), (4.0, 2.0, 1.0), (9.0, 0.1, 0.1)]
)
def test_an_ellipsoid_holds_95_percent_where_its_bound_does(sigmas):
    turn = cv2.Rodrigues(np.array([0.4, -0.9, 1.3]))[0]
    errors = np.random.default_rng(0).normal(size=(200_000, 3)) * sigmas @ turn.T
    centre = float(np.quantile(np.linalg.norm(errors, axis=1), 0.95))
    axes = np.array(compute_axes(7.0 * turn @ np.diag(np.square(sigmas)) @ turn.T, centre))
    lengths = np.linalg.norm(axes, axis=1)
    inside = ((errors @ (axes / lengths[:, None] ** 2).T) ** 2).sum(1) < 1.0
    assert inside.mean() == pytest.approx(0.95, abs=0.01)
    assert list(lengths) == sorted(lengths, reverse=True)
    np.testing.assert_allclose(lengths / lengths[0], np.array(sigmas) / sigmas[0], rtol=1e-6)
    assert lengths[0] < 1.45 * centre


def test_the_longest_axis_points_where_the_error_is_largest():
    along = np.array([0.6, 0.0, 0.8])
    axes = np.array(compute_axes(0.01 * np.eye(3) + np.outer(along, along), 1.0))
    np.testing.assert_allclose(axes[0] / np.linalg.norm(axes[0]), along, atol=1e-9)


def test_alike_in_all_directions_is_a_ball_of_the_bound():
    lengths = np.linalg.norm(compute_axes(3.0 * np.eye(3), 0.2), axis=1)
    np.testing.assert_allclose(lengths, 0.2, rtol=0.01)


@pytest.mark.parametrize("covariance", [np.zeros((3, 3)), np.full((3, 3), np.nan), 1e-20 * np.eye(3), -np.eye(3)])
def test_a_covariance_without_a_shape_gives_a_ball(covariance):
    assert compute_axes(covariance, 0.2) == make_ball(0.2)


def test_a_bound_that_is_not_finite_has_no_nan_in_its_axes():
    assert compute_axes(np.eye(3), np.inf) == make_ball(np.inf)
    assert not np.isnan(make_ball(np.inf)).any()


def test_a_larger_unit_scales_centre_and_axes_alike():
    known = Bounds(0.1, 0.02, 2.0, 1.5, ((0.0, 0.0, 0.03), (0.01, 0.0, 0.0), (0.0, 0.01, 0.0)))
    scaled = known.rescale(4.0)
    assert (scaled.centre, scaled.centre_percent) == (0.08, 2.0)
    np.testing.assert_allclose(scaled.axes, 4.0 * np.array(known.axes))


def test_the_widest_of_each_kind():
    one, other = Bounds(0.1, 0.02, 2.0, 1.5, make_ball(0.02)), Bounds(0.3, 0.01, 1.0, 2.5, make_ball(0.01))
    assert find_widest([one, other]) == Bounds(0.3, 0.02, 2.0, 2.5, make_ball(0.02))
    assert find_widest([]) is None
