"""What two photographs confirm, and what nobody does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.recon.priors import compute_consistent_depths, compute_consistent_shares, find_consistent_pixels
from tests.support.synthetic import plane_pointmap

WIDTH, HEIGHT = 64, 48


def wall(x: float = 0.0, depth: float = 2.0):
    T = np.eye(4)
    T[0, 3] = x
    return plane_pointmap(T, point=(0, 0, depth), width=WIDTH, height=HEIGHT, confidence=0.8)


def test_a_depth_is_confirmed_where_another_photograph_has_the_same_point():
    left, right = wall(-0.2), wall(0.2)
    one, other = find_consistent_pixels([left, right])
    shared = slice(16, 48)  # the pictures overlap there
    assert one[10:38, shared].mean() > 0.95 and other[10:38, :32].mean() > 0.95
    assert not any(mask.any() for mask in find_consistent_pixels([left, wall(0.2, depth=2.1)]))
    assert not any(mask.any() for mask in find_consistent_pixels([left]))


def test_doubtful_depths_confirm_nothing():
    left, right = wall(-0.2), wall(0.2)
    doubtful = replace(right, confidence=np.full_like(right.confidence, 0.1))
    assert not any(mask.any() for mask in find_consistent_pixels([left, doubtful]))


def test_a_value_for_four_pixels_is_kept_where_two_of_them_are_confirmed_on_one_surface():
    left, right = wall(-0.2), wall(0.2)
    kept = compute_consistent_depths([left, replace(right, name="right")])[left.name]
    mask = find_consistent_pixels([left, right])[0].reshape(HEIGHT // 2, 2, WIDTH // 2, 2).sum((1, 3))
    assert kept.shape == (HEIGHT // 2, WIDTH // 2) and kept.dtype == np.float16
    assert np.array_equal(kept > 0, mask >= 2) and np.allclose(kept[kept > 0], 2.0, rtol=1e-3)
    step = replace(left, depth=left.depth.copy())
    step.depth[:, 33:] *= 1.01  # within a square: two surfaces 1 % apart count as one, 5 % apart as none
    assert compute_consistent_depths([step, replace(step, name="again")])[left.name][10, 16] > 0
    step.depth[:, 33:] *= 1.05
    assert compute_consistent_depths([step, replace(step, name="again")])[left.name][10, 16] == 0


def test_of_an_odd_side_the_last_pixels_are_left_out():
    odd = replace(wall(), depth=wall().depth[:47, :63], confidence=wall().confidence[:47, :63])
    kept = compute_consistent_depths([odd, replace(odd, name="again")])[odd.name]
    assert kept.shape == (23, 31) and (kept > 0).all()


def test_the_share_of_consistent_depth_is_of_the_pixels_that_are_used():
    left, right = wall(-0.2), wall(0.2)
    masks = find_consistent_pixels([left, right])
    half = np.zeros((HEIGHT, WIDTH), bool)
    half[:, 32:] = True  # of the left view the half that both see
    every, none = np.ones_like(half), np.zeros_like(half)
    whole, seen, nothing = (compute_consistent_shares([masks[0]], [used])[0] for used in (every, half, none))
    assert whole == masks[0].mean() and seen == masks[0][:, 32:].mean() > 1.2 * whole and nothing == 0.0
