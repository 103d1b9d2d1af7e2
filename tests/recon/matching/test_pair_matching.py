"""Matches of several sets become one: of a point's matches the most distinct one stays."""

from __future__ import annotations

import numpy as np

from splatnode.recon.matching.pair_matching import _merge_matches


def test_a_point_keeps_its_most_distinct_match():
    found = np.array([[0, 0], [0, 1], [1, 1], [2, 0]])  # the most distinct first
    assert _merge_matches([found]).tolist() == [[0, 0], [1, 1]]


def test_of_several_sets_the_most_distinct_of_each_come_first():
    plain, tilted = np.array([[0, 0], [1, 1], [2, 2], [3, 3]]), np.array([[4, 0], [3, 5]])
    assert _merge_matches([plain, tilted]).tolist() == [[0, 0], [1, 1], [2, 2], [3, 5]]
    assert _merge_matches([tilted, plain]).tolist() == [[4, 0], [1, 1], [3, 5], [2, 2]]
    assert len(_merge_matches([plain[:0], plain[:0]])) == 0
