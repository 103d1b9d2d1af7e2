"""Levels of detail keep the moments of what they merge, and suffice from where they say."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.result.levels_of_detail import concatenate_gaussians, make_detail_levels, merge_by_voxel
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import GaussianArrays
from tests.recon.result.test_whole import random_gaussians
from tests.support.walk import far_shell, wall


def test_two_equal_gaussians_become_one_with_their_moments():
    one = GaussianArrays(
        means=np.array([[0.1, 0.5, 0.5], [0.5, 0.5, 0.5]], np.float32),
        quats=np.array([[1, 0, 0, 0], [1, 0, 0, 0]], np.float32),
        scales=np.full((2, 3), 0.1, np.float32),
        opacities=np.array([0.2, 0.6], np.float32),
        sh=np.array([[[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]], np.float32),
        source_frame=np.zeros(2, np.int32),
    )
    merged = merge_by_voxel(one, 1.0)
    assert len(merged) == 1
    # Masses .002 and .006: a quarter and three quarters. The variance along x is .01 + 1/4 * 3/4 * .4^2 = .04.
    assert np.allclose(merged.means, [[0.4, 0.5, 0.5]], atol=1e-6)
    assert np.allclose(np.sort(merged.scales), [[0.1, 0.1, 0.2]], atol=1e-5)
    assert np.allclose(merged.sh, [[[0.25, 0.75, 0.0]]], atol=1e-6)
    assert np.allclose(merged.opacities, (0.002 + 0.006) / 0.02, atol=1e-5)


def test_a_level_suffices_from_where_it_says():
    fine = wall(-1.2, 1.2, step=0.02)
    (level, *_) = make_detail_levels(fine)
    assert len(level.gaussians) <= len(fine) / 4
    focal = 300.0
    T = np.eye(4)
    T[2, 3] = 1.0 - level.compute_min_distance(focal)
    K = np.array([[focal, 0, 64], [0, focal, 48], [0, 0, 1]])
    seen, coarse = (render_arrays(each, T, K, 128, 96) for each in (fine, level.gaussians))
    solid = seen.alpha > 0.98
    assert solid.sum() > 500 and np.abs(seen.alpha - coarse.alpha)[solid].mean() < 0.01  # no gaps
    apart = np.abs(seen.rgb - coarse.rgb)[solid].mean()
    by_a_pixel = np.abs(seen.rgb - np.roll(seen.rgb, 1, axis=(0, 1)))[solid].mean()
    assert apart < by_a_pixel


def test_what_is_large_stays_as_it_is_and_does_not_count():
    shell = far_shell((0.0, 0.0, 0.0), 50.0)
    scene = concatenate_gaussians([wall(0.0, 8.0), shell])
    (level, *_) = make_detail_levels(scene)
    assert level.side < 1.0
    large = level.gaussians.scales.max(1) > 1.0
    assert large.sum() == len(shell) and (level.gaussians.source_frame[large] == -1).all()


def test_little_has_no_levels_and_nothing_is_merged_across_voxels():
    assert make_detail_levels(wall(0.0, 1.0)) == () and make_detail_levels(GaussianArrays.empty()) == ()
    random = random_gaussians(40)
    assert len(merge_by_voxel(random, 1e-6)) == 40
    with pytest.raises(ValueError, match="side"):
        merge_by_voxel(random, 0.0)


def test_lower_degrees_are_filled_up_when_scenes_are_joined():
    both = concatenate_gaussians([random_gaussians(3, bases=1), random_gaussians(2, bases=9)])
    assert both.sh.shape == (5, 9, 3) and not both.sh[:3, 1:].any() and len(concatenate_gaussians([])) == 0
