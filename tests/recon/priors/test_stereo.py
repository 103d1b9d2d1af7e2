"""Dense stereo on a scene whose depth is known in closed form: a textured corner of two planes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from splatnode.recon.core import library, set_threads
from splatnode.recon.priors import stereo
from splatnode.recon.priors.stereo import (
    Matching,
    Planes,
    Search,
    SparsePoints,
    StereoConfig,
    StereoStage,
    StereoView,
    estimate_depth_maps,
    estimate_depth_range,
    estimate_further_depth_map,
    estimate_planes,
    make_level,
    rank_partners,
    select_sources,
)
from splatnode.recon.threads import OutOfTime, RunContext
from tests.bench.speed import stereo as bench

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
# (unit normal, distance): n . X = d in the world. A wall that recedes to the right and a floor.
WALL = (np.array([-0.6, 0.0, 0.8]), 3.2)
FLOOR = (np.array([0.0, 1.0, 0.0]), 1.0)


def camera(x: float, turn_deg: float) -> np.ndarray:
    """T_world_camera at (x, 0, 0), turned to the left by `turn_deg`."""
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3], _ = cv2.Rodrigues(np.array([0.0, -np.radians(turn_deg), 0.0]))
    T_world_camera[0, 3] = x
    return T_world_camera


def render(T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image (h, w, 3), depth (h, w) and whether the wall is seen (h, w), by intersecting every ray."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T @ T_world_camera[:3, :3].T
    centre = T_world_camera[:3, 3]
    depths = []
    for normal, distance in (WALL, FLOOR):
        along = rays @ normal
        depths.append(np.where(along > 1e-6, (distance - normal @ centre) / np.where(along > 1e-6, along, 1), np.inf))
    depth = np.minimum(*depths)
    points = rays * depth[..., None] + centre
    return texture(points), depth, depths[0] < depths[1]


def texture(points: np.ndarray) -> np.ndarray:
    """(..., 3) colours of world points: a sum of waves in fixed directions, without repetition in the image."""
    generator = np.random.default_rng(7)
    waves = generator.normal(size=(60, 3)) * 9.0
    phases = generator.uniform(0, 2 * np.pi, 60)
    grey = 128 + 8 * np.sin(points @ waves.T + phases).sum(-1)
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, -1)


CAMERAS = [camera(x, turn) for x, turn in ((-0.4, -6.0), (0.0, 0.0), (0.4, 6.0))]


@pytest.fixture(scope="module")
def views() -> list[StereoView]:
    return [StereoView(render(T)[0], K, T, (1.5, 12.0)) for T in CAMERAS]


@pytest.fixture(scope="module")
def maps(views):
    return estimate_depth_maps(views, StereoConfig(), seed=1)


def test_depth_is_right_and_nearly_complete(maps):
    for T, result in zip(CAMERAS, maps, strict=True):
        _, depth, _ = render(T)
        known = result.depth > 0
        error = np.abs(result.depth[known] / depth[known] - 1)
        assert known.mean() > 0.8
        assert np.median(error) < 0.005
        assert (error < 0.02).mean() > 0.88  # .916 or more


def test_normals_are_those_of_the_planes_and_face_the_camera(maps):
    T_world_camera = CAMERAS[1]
    _, _, is_wall = render(T_world_camera)
    known = maps[1].depth > 0
    for mask, (normal, _) in ((is_wall & known, WALL), (~is_wall & known, FLOOR)):
        towards_camera = -T_world_camera[:3, :3].T @ normal
        assert np.median(maps[1].normal[mask] @ towards_camera) > np.cos(np.radians(8))
    np.testing.assert_allclose(np.linalg.norm(maps[1].normal[known], axis=-1), 1, atol=1e-5)
    assert not maps[1].normal[~known].any()


def test_confidence_is_a_probability_and_ranks_errors(maps):
    _, depth, _ = render(CAMERAS[1])
    confidence, known = maps[1].confidence, maps[1].depth > 0
    assert confidence.min() >= 0 and confidence.max() <= 1
    assert not confidence[~known].any() and (confidence[known] > 0).all()
    error = np.abs(maps[1].depth / depth - 1)
    sure = known & (confidence > np.median(confidence[known]))
    assert error[sure].mean() < error[known].mean()


def test_same_seed_gives_the_same_result_for_any_number_of_threads(views, maps):
    threads = library().core_get_threads()
    try:
        for count in (1, 3):
            set_threads(count)
            for first, second in zip(maps, estimate_depth_maps(views, StereoConfig(), seed=1), strict=True):
                np.testing.assert_array_equal(first.depth, second.depth)
                np.testing.assert_array_equal(first.confidence, second.confidence)
    finally:
        set_threads(threads)


def test_one_view_alone_with_known_depth_of_the_others(views, maps):
    others = [views[0], views[2]]
    planes = estimate_planes(views[1], others, StereoConfig(), seed=1, known={0: maps[0].depth, 1: maps[2].depth})
    _, depth, _ = render(CAMERAS[1])
    error = np.abs(1 / planes.inverse_depth / depth - 1)
    assert np.median(error) < 0.005


def test_a_further_view_is_as_good_and_no_map_but_its_own_is_needed_again(views, maps):
    further = estimate_further_depth_map(views, 1, {0: maps[0].depth, 2: maps[2].depth}, StereoConfig(), seed=1)
    _, depth, _ = render(CAMERAS[1])
    known = further.depth > 0
    assert known.mean() > 0.75
    assert np.median(np.abs(further.depth[known] / depth[known] - 1)) < 0.005
    assert (further.num_consistent[known] > 0).mean() > 0.7


def test_the_work_can_be_abandoned_between_views(views):
    calls = []

    def pause() -> None:
        calls.append(None)
        if len(calls) == 2:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        estimate_depth_maps(views, StereoConfig(), run=RunContext(pause))
    assert len(calls) == 2


def test_when_time_is_over_depth_is_as_fine_as_it_is_by_then(views):
    def over() -> None:
        raise OutOfTime

    for T, early in zip(CAMERAS, estimate_depth_maps(views, StereoConfig(), seed=1, run=RunContext(over)), strict=True):
        _, depth, _ = render(T)
        known = early.depth > 0
        assert early.depth.shape == depth.shape and known.mean() > 0.3
        assert np.median(np.abs(early.depth[known] / depth[known] - 1)) < 0.05


def flat_planes(inverse_depth: float) -> Planes:
    values = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    values[..., 0] = inverse_depth
    return Planes(values, np.zeros((HEIGHT, WIDTH), np.float32))


def check_side_by_side(first: Planes, second: Planes, config: stereo.ConsistencyConfig) -> list[stereo.DepthMap]:
    """Two cameras side by side before a striped wall at z = 4, with the planes given."""
    stripes = np.repeat((np.arange(WIDTH) % 16 * 10).astype(np.uint8)[None, :, None], HEIGHT, 0).repeat(3, 2)
    levels = [make_level(stripes, K, camera(x, 0.0), (1.0, 10.0), 0) for x in (0.0, 0.4)]
    return stereo.cross_check(levels, [first, second], [[1], [0]], Matching(), config)


def test_depth_is_the_mean_of_agreeing_views():
    first, _ = check_side_by_side(flat_planes(1 / 4.0), flat_planes(1 / 4.02), stereo.ConsistencyConfig())
    seen_by_both = first.num_consistent == 1
    assert seen_by_both[:, 20:].all() and not seen_by_both[:, :12].any()
    assert (first.depth[seen_by_both] > 4.001).all() and (first.depth[seen_by_both] < 4.019).all()


def test_views_that_disagree_leave_no_depth():
    first, second = check_side_by_side(flat_planes(1 / 4.0), flat_planes(1 / 6.0), stereo.ConsistencyConfig())
    assert not first.depth.any() and not second.depth.any()


def test_a_wrong_pixel_takes_the_plane_of_its_neighbours_and_counts_as_unconfirmed():
    planes = flat_planes(1 / 4.0)
    planes.values[60, 80, 0] = 1 / 2.0
    first, _ = check_side_by_side(planes, flat_planes(1 / 4.0), stereo.ConsistencyConfig())
    assert first.depth[60, 80] == pytest.approx(4.0, rel=1e-3)
    assert first.num_consistent[60, 80] == 0
    assert 0 < first.confidence[60, 80] < first.confidence[60, 90]


def test_a_surveyed_scene_meets_the_bars(shared):
    names = ["0003.jpg", "0004.jpg", "0005.jpg"]
    case = bench.make_case(shared / "scenes" / "fountain_p11", names, names)
    _, row = bench.run(case, StereoConfig())
    assert row["median_relative_error"] < 0.005
    assert row["coverage"] > 0.7
    assert row["sparsification"][0] > row["sparsification"][-1]
    assert abs(row["mean_confidence"] - row["share_within_1pct"]) < 0.1


def test_sparse_points_replace_the_search_over_the_depth_range(views):
    """A short search at full size only, which never looks at the whole range, starts at infinity without points."""
    config = StereoConfig(stages=(StereoStage(0, Search(iterations=3, perturbation=1.0), geometric=False),))
    sources = [views[0], views[2]]
    _, depth, _ = render(CAMERAS[1])
    y, x = np.mgrid[10:HEIGHT:20, 10:WIDTH:20].reshape(2, -1)
    sparse = SparsePoints(np.stack([x, y], 1) + 0.5, depth[y, x])
    lost, found = estimate_planes(views[1], sources, config), estimate_planes(views[1], sources, config, sparse=sparse)
    assert np.median(np.abs(found.inverse_depth * depth - 1)) < 0.01
    assert np.median(np.abs(lost.inverse_depth * depth - 1)) > 0.1


def test_sources_overlap_and_have_parallax(views):
    behind = StereoView(views[0].image, K, camera(0.0, 180.0), (1.5, 12.0))
    same_place = StereoView(views[0].image, K, camera(0.001, 0.0), (1.5, 12.0))
    partners = rank_partners([views[1], same_place, behind, views[0], views[2]], 0, StereoConfig())
    assert select_sources(partners, StereoConfig())[:2] in ([3, 4], [4, 3])
    assert 2 not in select_sources(partners, StereoConfig())


def test_a_view_without_overlap_has_no_depth(views):
    behind = StereoView(views[0].image, K, camera(0.0, 180.0), (1.5, 12.0))
    first, second, third = estimate_depth_maps([views[0], views[1], behind], StereoConfig())
    assert (first.depth > 0).any() and (second.depth > 0).any()
    assert not third.depth.any() and not third.confidence.any() and not third.normal.any()


def test_depth_range_covers_the_points_and_ignores_outliers():
    depths = np.r_[np.linspace(2.0, 4.0, 998), 1e-3, 1e4]
    near, far = estimate_depth_range(depths)
    assert 1.0 < near < 2.0 and 4.0 < far < 8.0
    with pytest.raises(ValueError, match="at least 3"):
        estimate_depth_range(np.array([1.0, -1.0, np.nan]))


def test_wrong_input_says_what_was_expected(views):
    with pytest.raises(ValueError, match="uint8"):
        StereoView(np.zeros((4, 4, 3), np.float32), K, np.eye(4), (1.0, 2.0))
    with pytest.raises(ValueError, match="near < far"):
        StereoView(np.zeros((4, 4, 3), np.uint8), K, np.eye(4), (2.0, 1.0))
    with pytest.raises(ValueError, match="one entry a view"):
        estimate_depth_maps(views, StereoConfig(), sparse=[None])
    with pytest.raises(ValueError, match="sources are needed"):
        estimate_planes(views[0], [], StereoConfig())


def test_a_view_without_sparse_points_still_finds_its_sources(views):
    none = SparsePoints(np.empty((0, 2)), np.empty(0))
    assert rank_partners(views, 1, StereoConfig(), none) == rank_partners(views, 1, StereoConfig())
