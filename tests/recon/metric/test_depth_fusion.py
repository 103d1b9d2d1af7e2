"""What stereo and several depth images tell of a pixel, and where depth steps."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.capture.depth_image import make_depth_image
from splatnode.recon.metric.depth_fit import MeasuredDepth, smooth_depth
from splatnode.recon.metric.depth_fusion import MeasuredView, fuse_depth, smooth_within_outlines, snap_to_outlines
from splatnode.recon.priors import Pointmap

HEIGHT, WIDTH, FOCAL = 48, 64, 60.0
WALL, NEAR = 3.0, 2.0
SHAPE = HEIGHT, WIDTH


def pointmap(depth: np.ndarray, confidence: float | np.ndarray = 0.8, aside: float = 0.0) -> Pointmap:
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    T = np.eye(4)
    T[0, 3] = aside
    sure = np.where(depth > 0, confidence, 0.0).astype(np.float32)
    return Pointmap("a", 0, depth.astype(np.float32), sure, np.zeros((*depth.shape, 3), np.float32), T, K)


def view(depth: np.ndarray, aside: float, sigma: float = 0.02) -> MeasuredView:
    return MeasuredView(pointmap(depth, 1.0, aside), np.where(depth > 0, sigma, 0.0))


def wall(z: float = WALL) -> np.ndarray:
    return np.full(SHAPE, z)


NOTHING = MeasuredDepth(*np.zeros((2, *SHAPE)))


def test_holes_are_filled_by_what_other_images_measured():
    fused = fuse_depth(pointmap(np.zeros(SHAPE)), NOTHING, [view(wall(), 0.1), view(wall(), -0.1)])
    inside = fused.depth[:, 4:-4]
    assert (inside > 0).mean() > 0.95
    assert inside[inside > 0] == pytest.approx(WALL, abs=1e-5)
    assert (fused.confidence[fused.depth > 0] > 0.3).all() and not fused.confidence[fused.depth == 0].any()


def test_measurements_of_several_images_are_averaged_by_their_variances():
    own = MeasuredDepth(wall(WALL + 0.03), np.full(SHAPE, 0.03))
    fused = fuse_depth(pointmap(np.zeros(SHAPE)), own, [view(wall(WALL - 0.01), 0.0, 0.015)])
    assert fused.depth[20, 30] == pytest.approx(WALL - 0.002, abs=1e-4), "four times the weight"


def test_stereo_that_other_images_see_through_gives_way():
    """A wall without anything to match: stereo is half sure of a surface before it."""
    unsure = pointmap(wall(2.7), 0.6)
    assert fuse_depth(unsure, NOTHING).depth[20, 30] == pytest.approx(2.7)
    fused = fuse_depth(unsure, NOTHING, [view(wall(), 0.1), view(wall(), -0.1)])
    assert fused.depth[10:-10, 10:-10] == pytest.approx(WALL, abs=1e-5)


def test_a_thin_thing_that_stereo_is_sure_of_stays_before_what_others_measured_behind_it():
    """Depth cameras have a hole at a table's leg, and measure the wall behind it from both sides."""
    own, left, right = wall(), wall(), wall()
    own[:, 26:38] = left[:, 14:26] = right[:, 38:50] = 0.0  # the leg is 12 pixels aside for those that stand .4 aside
    leg = wall()
    leg[:, 31:33] = NEAR
    measured = MeasuredDepth(own, np.where(own > 0, 0.03, 0.0))
    fused = fuse_depth(pointmap(leg, 0.9), measured, [view(left, 0.4), view(right, -0.4)])
    assert fused.depth[:, 31:33] == pytest.approx(NEAR, rel=1e-3)
    assert fused.depth[:, 4:24] == pytest.approx(WALL, rel=1e-2)


def test_what_is_hidden_by_a_nearer_surface_is_not_seen():
    """From aside others measured the wall behind a thing that one of them measured, too."""
    thing, left, right = wall(), wall(), wall()
    thing[:, 30:34] = NEAR
    left[:, 14:28] = right[:, 36:50] = 0.0
    fused = fuse_depth(pointmap(np.zeros(SHAPE)), NOTHING, [view(thing, 0.0), view(left, 0.4), view(right, -0.4)])
    assert fused.depth[:, 30:34] == pytest.approx(NEAR, rel=1e-3)


def test_depth_steps_where_colours_do():
    """Known left and right of an outline, and unknown beside it."""
    true = wall()
    true[:, 32:] = NEAR
    image = np.full((*SHAPE, 3), 200, np.uint8)
    image[:, 32:] = 60
    told = true.copy()
    told[:, 30:35] = 0.0
    found = snap_to_outlines(pointmap(told, 0.9), image)
    assert found.depth == pytest.approx(true, rel=1e-3)
    fat = true.copy()
    fat[:, 30:32] = NEAR  # as stereo has it, which compares windows
    assert (np.abs(found.depth - true) < 0.01).all()
    snapped = snap_to_outlines(pointmap(fat, np.where(fat != true, 0.3, 0.9)), image)
    assert snapped.depth == pytest.approx(true, rel=1e-3)


def test_a_low_relief_is_not_flattened_and_noise_still_is():
    """A shelf that stands out by twice the noise: windows may lie beside their pixel."""
    z = np.full((240, 320), 3.0)
    z[80:160, 100:220] = 2.82
    noise = 0.074 * np.random.default_rng(0).normal(size=z.shape)
    depth = make_depth_image((z + noise).astype(np.float32))
    sharp, sigma = smooth_within_outlines(depth)
    plain, _ = smooth_depth(depth)
    beside = np.zeros(z.shape, bool)
    beside[76:84, 100:220] = beside[156:164, 100:220] = True
    both = (sharp > 0) & (plain > 0)
    errors = [np.sqrt(np.mean((each - z)[both & beside] ** 2)) for each in (sharp, plain)]
    assert errors[0] < 0.85 * errors[1]
    flat = both & (np.hypot(*(np.indices(z.shape) - 20.0)) < 15)
    assert np.sqrt(np.mean((sharp - z)[flat] ** 2)) < 0.25 * 0.074
    assert np.median(sigma[flat]) < 0.3 * 0.074
