"""Matches of several sets become one, and what the epipolar geometry of a pair explains of them."""

from __future__ import annotations

import numpy as np

from splatnode.recon.geometry import epipolar_errors
from splatnode.recon.matching.pair_matching import (
    TwoView,
    _merge_matches,
    count_explained,
    fit_epipolar_errors,
)


def test_a_point_keeps_its_most_distinct_match():
    found = np.array([[0, 0], [0, 1], [1, 1], [2, 0]])  # the most distinct first
    assert _merge_matches([found]).tolist() == [[0, 0], [1, 1]]


def test_of_several_sets_the_most_distinct_of_each_come_first():
    plain, tilted = np.array([[0, 0], [1, 1], [2, 2], [3, 3]]), np.array([[4, 0], [3, 5]])
    assert _merge_matches([plain, tilted]).tolist() == [[0, 0], [1, 1], [2, 2], [3, 5]]
    assert _merge_matches([tilted, plain]).tolist() == [[4, 0], [1, 1], [3, 5], [2, 2]]
    assert len(_merge_matches([plain[:0], plain[:0]])) == 0


def make_pair(points1, points2):
    count = len(points1)
    return TwoView(np.tile(np.arange(count)[:, None], 2), points1, points2, count, -99.0, 0, 0, 1.0)


def test_the_error_of_a_match_is_its_distance_from_the_epipolar_line():
    sideways = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    points1, points2 = np.array([[1.0, 2.0], [5.0, 3.0]]), np.array([[9.0, 2.0], [7.0, 4.0]])
    assert np.allclose(np.abs(epipolar_errors(sideways, points1, points2)), [0.0, np.sqrt(0.5)])
    assert count_explained(np.array([0.0, 0.5, 1.0, 3.0, np.inf]), 1.0) == 1.75


def test_a_fundamental_matrix_explains_matches_of_two_lenses():
    generator = np.random.default_rng(0)
    points = generator.uniform([-2, -1.5, 4], [2, 1.5, 8], (300, 3))
    moved = points @ np.array([[0.98, 0.0, -0.199], [0.0, 1.0, 0.0], [0.199, 0.0, 0.98]]) + [0.8, 0.1, 0.05]
    noise = generator.normal(0.0, 0.2, (2, 300, 2))
    points1, points2 = (f * x[:, :2] / x[:, 2:] + e for f, x, e in zip((500, 870), (points, moved), noise, strict=True))
    points2[:30] += generator.uniform(15.0, 60.0, (30, 2))
    errors = fit_epipolar_errors(make_pair(points1, points2), 1.25)
    assert np.median(errors[30:]) < 0.2 and 255 < count_explained(errors[30:], 1.25) < 270
    assert count_explained(errors[:30], 1.25) < 5


def test_matches_without_a_fundamental_matrix_have_infinite_errors():
    same = np.zeros((8, 2))
    assert count_explained(fit_epipolar_errors(make_pair(same[:5], same[:5]), 1.0), 1.0) == 0.0
