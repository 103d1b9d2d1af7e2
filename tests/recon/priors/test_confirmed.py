"""What two photographs confirm, and what nobody does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.recon.priors.confirmed import confirmed
from tests.support.synthetic import plane_pointmap

WIDTH, HEIGHT = 64, 48


def wall(x: float = 0.0, depth: float = 2.0):
    T = np.eye(4)
    T[0, 3] = x
    return plane_pointmap(T, point=(0, 0, depth), width=WIDTH, height=HEIGHT, confidence=0.8)


def test_a_depth_is_confirmed_where_another_photograph_has_the_same_point():
    left, right = wall(-0.2), wall(0.2)
    one, other = confirmed([left, right])
    shared = slice(16, 48)  # the pictures overlap there
    assert one[10:38, shared].mean() > 0.95 and other[10:38, :32].mean() > 0.95
    assert not any(mask.any() for mask in confirmed([left, wall(0.2, depth=2.1)]))
    assert not any(mask.any() for mask in confirmed([left]))


def test_doubtful_depths_confirm_nothing():
    left, right = wall(-0.2), wall(0.2)
    doubtful = replace(right, confidence=np.full_like(right.confidence, 0.1))
    assert not any(mask.any() for mask in confirmed([left, doubtful]))
