"""From matches to cameras, on points with known answers: noise, wrong matches, an unknown focal length, doubles."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from splatnode.recon.geometry import align_cameras
from splatnode.recon.matching import pair_matching
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration import (
    bundle_adjustment,
    incremental_mapper,
    mapping_problem,
    multiview_geometry,
    self_calibration,
)
from splatnode.recon.registration.mapping_problem import Lens, MapperInput, MapperView, OwnLens, SparseModel

FOCAL = 900.0
SIZE = (1024, 768)
NOISE_PX = 0.3


@dataclass(frozen=True, eq=False)
class Photographed:
    """Points seen by cameras on an arc: feature k of every view is point k, or clutter where it is not visible."""

    rotations: np.ndarray  # (C, 3, 3) world to camera
    translations: np.ndarray  # (C, 3)
    pixels: list[np.ndarray]  # C times (N, 2) relative to the middle
    visible: np.ndarray  # (C, N)

    @property
    def Ts_world_camera(self) -> np.ndarray:
        return np.stack([_inverse(R, t) for R, t in zip(self.rotations, self.translations, strict=True)])


def _inverse(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.T, -rotation.T @ translation
    return T


def photographed(
    num_views: int = 5,
    step_deg: float = 9.0,
    num_points: int = 400,
    seed: int = 0,
    radials: tuple[float, float] = (0.0, 0.0),
) -> Photographed:
    generator = np.random.default_rng(seed)
    points = generator.uniform(-1.0, 1.0, (num_points, 3)) * [2.0, 1.4, 1.2]
    rotations, translations, pixels, visible = [], [], [], []
    for view in range(num_views):
        angle = np.radians(step_deg * (view - num_views / 2))
        rotation = cv2.Rodrigues(np.array([0.03 * view, angle, 0.02]))[0]
        translation = np.array([0.1 * view, -0.05 * view, 6.0])
        in_camera = points @ rotation.T + translation
        straight = in_camera[:, :2] / in_camera[:, 2:]
        squared = (straight**2).sum(1, keepdims=True)
        bent = straight * (1.0 + radials[0] * squared + radials[1] * squared**2)
        seen = FOCAL * bent + generator.normal(size=(num_points, 2)) * NOISE_PX
        inside = (np.abs(seen) < np.array(SIZE) / 2).all(1) & (generator.random(num_points) < 0.8)
        clutter = (generator.random((num_points, 2)) - 0.5) * SIZE
        rotations.append(rotation)
        translations.append(translation)
        pixels.append(np.where(inside[:, None], seen, clutter))
        visible.append(inside)
    return Photographed(np.stack(rotations), np.stack(translations), pixels, np.stack(visible))


def compared(taken: Photographed, share_wrong: float = 0.2) -> dict[tuple[int, int], TwoView]:
    """All pairs, verified, when every common point is matched and a share of the matches is wrong."""
    generator = np.random.default_rng(5)
    pairs = {}
    for i in range(len(taken.pixels)):
        for j in range(i + 1, len(taken.pixels)):
            (common,) = np.nonzero(taken.visible[i] & taken.visible[j])
            wrong = generator.integers(0, len(taken.pixels[i]), (int(share_wrong * len(common)), 2))
            matches = np.concatenate([np.stack([common, common], 1), wrong])
            points1, points2 = taken.pixels[i][matches[:, 0]], taken.pixels[j][matches[:, 1]]
            pair, _ = pair_matching.estimate(points1, points2, matches, SIZE, pair_matching.TwoViewConfig())
            if pair is not None:
                pairs[i, j] = pair
    return pairs


def built(
    taken: Photographed, pairs: dict[tuple[int, int], TwoView], focals: tuple[float, ...]
) -> incremental_mapper.MapperResult:
    views = [MapperView(points, 0, max(SIZE)) for points in taken.pixels]
    found = incremental_mapper.build_model(views, [Lens(focals, 0.3)], pairs, incremental_mapper.MapperConfig())
    assert found is not None
    return found


def errors(taken: Photographed, found: incremental_mapper.MapperResult) -> tuple[float, float]:
    """Largest error of a relative rotation, degrees, and the largest of a centre, relative to their spread."""
    members = sorted(found.views)
    state = found.estimate
    estimated = np.stack([_inverse(state.rotations[i], state.translations[i]) for i in members])
    true = taken.Ts_world_camera[members]
    first, second = np.triu_indices(len(members), 1)
    relative = [T[first, :3, :3].transpose(0, 2, 1) @ T[second, :3, :3] for T in (estimated, true)]
    cosine = ((relative[0] * relative[1]).sum((1, 2)) - 1.0) / 2.0
    alignment = align_cameras(estimated, true)
    moved = np.stack([alignment.camera(T)[:3, 3] for T in estimated])
    spread = np.sqrt(((true[:, :3, 3] - true[:, :3, 3].mean(0)) ** 2).sum(1).mean())
    return (
        float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max()),
        float(np.linalg.norm(moved - true[:, :3, 3], axis=1).max() / spread),
    )


@pytest.fixture(scope="module")
def taken() -> Photographed:
    return photographed()


@pytest.fixture(scope="module")
def pairs(taken) -> dict[tuple[int, int], TwoView]:
    return compared(taken)


def test_a_pair_keeps_its_matches_and_drops_the_wrong_ones(taken, pairs):
    assert len(pairs) == 10
    for (i, j), pair in pairs.items():
        common = int((taken.visible[i] & taken.visible[j]).sum())
        right = pair.matches[:, 0] == pair.matches[:, 1]
        assert right.sum() > 0.9 * common
        assert right.mean() > 0.97
        assert not pair.is_pure_rotation
        assert pair.num_homography < 0.7 * len(pair.matches)


def test_unrelated_points_are_no_pair():
    generator = np.random.default_rng(0)
    points1, points2 = ((generator.random((300, 2)) - 0.5) * SIZE for _ in range(2))
    matches = np.stack([np.arange(300)] * 2, 1)
    assert pair_matching.estimate(points1, points2, matches, SIZE, pair_matching.TwoViewConfig())[0] is None


def test_a_camera_that_only_turned_is_told():
    generator = np.random.default_rng(0)
    rays = np.column_stack([generator.uniform(-0.4, 0.4, (300, 2)), np.ones(300)])
    turned = rays @ cv2.Rodrigues(np.array([0.02, 0.15, 0.0]))[0].T
    points1, points2 = rays[:, :2] * FOCAL, turned[:, :2] / turned[:, 2:] * FOCAL
    points2 = points2 + generator.normal(size=points2.shape) * NOISE_PX
    matches = np.stack([np.arange(300)] * 2, 1)
    pair, _ = pair_matching.estimate(points1, points2, matches, SIZE, pair_matching.TwoViewConfig())
    assert pair is not None
    assert pair.is_pure_rotation
    count, focal = pair_matching.fit_rotation(points1, points2, 2.0, SIZE[0])
    assert count >= 0.9 * len(points1) and focal == pytest.approx(FOCAL, rel=0.1)


def test_false_alarms_fall_with_every_match_that_agrees():
    assert pair_matching.log10_number_of_false_alarms(100, 7, 7, 0.01) == 0.0
    alarms = [pair_matching.log10_number_of_false_alarms(100, k, 7, 0.01) for k in (10, 20, 40)]
    assert alarms == sorted(alarms, reverse=True)
    assert alarms[-1] < -25.0


def test_the_number_of_false_alarms_by_hand():
    """(10 - 7) choices of a model, C(10, 8) sets of 8 inliers, C(8, 7) samples among them, and .1 for the eighth."""
    assert pair_matching.log10_number_of_false_alarms(10, 8, 7, 0.1) == pytest.approx(np.log10(3 * 45 * 8 * 0.1))
    assert pair_matching.log10_number_of_false_alarms(10, 7, 7, 0.1) == 0.0  # a sample agrees with itself


def test_pairs_vote_for_the_focal_length(pairs):
    votes = self_calibration.vote(list(pairs.values()), num_candidates=3)
    assert min(abs(np.log(vote * SIZE[0] / FOCAL)) for vote in votes) < 0.08


@pytest.mark.parametrize("focals", [(FOCAL,), (1.15 * FOCAL, 0.8 * FOCAL)])
def test_cameras_are_found_whatever_the_first_focal_length(taken, pairs, focals):
    found = built(taken, pairs, focals)
    assert sorted(found.views) == [0, 1, 2, 3, 4]
    rotation_deg, centre = errors(taken, found)
    assert rotation_deg < 0.15
    assert centre < 0.01
    assert np.exp(found.estimate.log_focals[0]) == pytest.approx(FOCAL, rel=0.01)
    assert found.rms_px == pytest.approx(NOISE_PX * np.sqrt(2.0), rel=0.25)
    assert min(found.inlier_ratios.values()) > 0.95


def photographed_from_the_side(zooms: tuple[float, ...], seed: int) -> Photographed:
    """Steps aside before a deep scene, as with a camera that is moved by hand; each image enlarged by its zoom."""
    generator, count = np.random.default_rng(seed), 500
    depth = generator.uniform(3.0, 14.0, count)
    points = np.stack(
        [generator.uniform(-0.55, 0.55, count) * depth, generator.uniform(-0.4, 0.4, count) * depth, depth], 1
    )
    rotations, translations, pixels, visible = [], [], [], []
    for view, zoom in enumerate(zooms):
        rotation = cv2.Rodrigues(np.array([0.01 * view, np.radians(1.5 * (view - 1)), 0.01]))[0]
        translation = -rotation @ np.array([0.12 * (view - 1), 0.03 * view, 0.02 * view])
        in_camera = points @ rotation.T + translation
        seen = zoom * FOCAL * in_camera[:, :2] / in_camera[:, 2:] + generator.normal(size=(count, 2)) * NOISE_PX
        inside = (np.abs(seen) < np.array(SIZE) / 2).all(1) & (generator.random(count) < 0.85)
        clutter = (generator.random((count, 2)) - 0.5) * SIZE
        rotations.append(rotation)
        translations.append(translation)
        pixels.append(np.where(inside[:, None], seen, clutter))
        visible.append(inside)
    return Photographed(np.stack(rotations), np.stack(translations), pixels, np.stack(visible))


@pytest.mark.parametrize(("zoom", "seed"), [(1.06, 0), (1.06, 1), (1.03, 0), (1.03, 2), (1.0, 0)])
def test_a_small_zoom_does_not_pass_for_one_long_lens(zoom, seed):
    """One lens two to three times as long fits three such images nearly, with cameras that are 4 to 7 degrees off."""
    taken = photographed_from_the_side((1.0, zoom, 1.0), seed)
    pairs = compared(taken)
    votes = self_calibration.vote(list(pairs.values()), num_candidates=3)
    views = [MapperView(points, 0, max(SIZE)) for points in taken.pixels]
    lens = Lens(tuple(vote * SIZE[0] for vote in votes), 0.3, typical=float(SIZE[0]))
    found = incremental_mapper.build_model(views, [lens], pairs, incremental_mapper.MapperConfig())
    assert found is not None and sorted(found.views) == [0, 1, 2]
    rotation_deg, centre = errors(taken, found)
    assert rotation_deg < 0.15 and centre < 0.03
    focals = np.exp(found.estimate.log_focals[found.estimate.lens_of_camera])
    assert focals == pytest.approx(FOCAL * np.array([1.0, zoom, 1.0]), rel=0.05)


def test_a_long_lens_stays_what_it_is(monkeypatch):
    """A typical focal length is tried beside it, and explains the matches less well."""
    long = photographed_from_the_side((3.0, 3.0, 3.0), 0)
    pairs = compared(long)
    tried = []
    real = incremental_mapper.grow
    monkeypatch.setattr(incremental_mapper, "grow", lambda *given: tried.append(given[1]) or real(*given))
    views = [MapperView(points, 0, max(SIZE)) for points in long.pixels]
    lens = Lens((3.0 * FOCAL,), 0.3, typical=float(SIZE[0]))
    found = incremental_mapper.build_model(views, [lens], pairs, incremental_mapper.MapperConfig())
    assert [float(SIZE[0])] in tried
    assert found is not None and np.exp(found.estimate.log_focals[0]) == pytest.approx(3.0 * FOCAL, rel=0.3)


@pytest.mark.parametrize(("radial", "num_points"), [(-0.3, 400), (-0.2, 400), (0.1, 1200)])
def test_a_lens_that_bends_lines_much_more_than_others_do_is_found(radial, num_points):
    taken = photographed(num_views=6, num_points=num_points, radials=(radial, 0.0))
    found = built(taken, compared(taken), (FOCAL,))
    assert found.estimate.radials[0, 0] == pytest.approx(radial, abs=0.04)
    assert np.exp(found.estimate.log_focals[0]) == pytest.approx(FOCAL, rel=0.015)


@pytest.mark.parametrize("second", [0.3, 0.0])
def test_where_lines_bend_much_a_second_coefficient_is_found(second):
    taken = photographed(num_views=6, num_points=1600, radials=(-0.4, second))
    found = built(taken, compared(taken), (FOCAL,))
    corner = float(np.hypot(*SIZE)) / 2 / FOCAL
    expected, moved = (corner**2 * (k1 + k2 * corner**2) for k1, k2 in ((-0.4, second), found.estimate.radials[0]))
    assert moved == pytest.approx(expected, abs=0.015)  # it is .04 off with the first one alone
    assert np.exp(found.estimate.log_focals[0]) == pytest.approx(FOCAL, rel=0.015)


def test_a_lens_of_which_little_is_told_is_taken_for_one_that_bends_no_lines(taken, pairs):
    found = built(taken, pairs, (FOCAL,))
    assert np.abs(found.estimate.radials[0]).max() < 0.01


def test_what_is_known_of_a_lens_stays(taken, pairs):
    views = [MapperView(points, 0, max(SIZE)) for points in taken.pixels]
    found = incremental_mapper.build_model(views, [Lens((FOCAL,), 0.0)], pairs, incremental_mapper.MapperConfig())
    assert found is not None
    assert np.exp(found.estimate.log_focals[0]) == pytest.approx(FOCAL, rel=1e-12)
    assert not found.estimate.radials.any() and np.abs(found.estimate.shifts).max() == 0.0


def test_a_pair_that_shows_a_double_does_not_bend_the_map(taken, pairs):
    """Views 0 and 4 match as strongly as they can on a copy of the scene elsewhere."""
    elsewhere = photographed(seed=11)
    lying = compared(elsewhere)[0, 4]
    points = [np.concatenate([own, other]) for own, other in zip(taken.pixels, elsewhere.pixels, strict=True)]
    spoiled = {**pairs, (0, 4): replace(lying, matches=lying.matches + len(taken.pixels[0]))}
    views = [MapperView(of_view, 0, max(SIZE)) for of_view in points]
    found = incremental_mapper.build_model(views, [Lens((FOCAL,), 0.3)], spoiled, incremental_mapper.MapperConfig())
    assert found is not None
    rotation_deg, centre = errors(taken, found)
    assert rotation_deg < 0.3 and centre < 0.02


def test_a_view_that_shares_a_handful_of_points_is_placed_by_its_pair():
    """Views 0-1 and 1-2 overlap in different points but for about ten, fewer than a pose from points needs."""
    taken = photographed(num_views=3, num_points=600)
    point = np.arange(600)
    seen = taken.visible & np.stack([point < 310, point >= 0, point >= 290])
    assert 5 <= seen.all(0).sum() < mapping_problem.ResectionConfig().min_points
    apart = Photographed(taken.rotations, taken.translations, taken.pixels, seen)
    chain = {key: pair for key, pair in compared(apart, share_wrong=0.0).items() if key != (0, 2)}
    found = built(taken, chain, (FOCAL,))
    assert sorted(found.views) == [0, 1, 2]
    rotation_deg, centre = errors(taken, found)
    assert rotation_deg < 1.0 and centre < 0.05


@pytest.mark.parametrize("radial", [0.0, -0.25])
def test_a_view_is_placed_as_well_through_a_lens_that_is_known_to_bend_lines(radial):
    taken = photographed(num_views=1, radials=(radial, 0.0))
    (seen,) = np.nonzero(taken.visible[0])
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (400, 3)) * [2.0, 1.4, 1.2]  # those of `photographed`
    still, lens = np.zeros((1, 3)), (np.log([FOCAL]), np.array([[radial, 0.0]]), np.zeros((1, 2)))
    bare = bundle_adjustment.make_empty_problem(np.eye(3)[None], still, np.zeros(1, int), *lens)
    prior = bundle_adjustment.focal_prior(lens[0], np.ones(1))
    partial = SparseModel((), replace(bare, points=points), prior, np.arange(400))
    observed = multiview_geometry.Tracks(np.zeros(len(seen), int), seen, taken.pixels[0][seen], 400)
    problem = MapperInput((), (), {}, np.ones(1), observed, observed)
    found = mapping_problem.resect(problem, partial, 0, mapping_problem.ResectionConfig())
    assert found is not None and found.inlier_ratio > 0.99
    assert np.linalg.norm(found.rotation.T @ found.translation + taken.Ts_world_camera[0, :3, 3]) < 0.02


def test_sampson_errors_are_the_noise_and_infinite_behind(taken, pairs):
    found = built(taken, pairs, (FOCAL,))
    ahead = multiview_geometry.sampson_errors(found.estimate, (0, 3), pairs[0, 3])
    assert np.median(ahead) == pytest.approx(0.67 * NOISE_PX, rel=0.4)
    rotations, translations = found.estimate.rotations, found.estimate.translations
    towards = rotations[3] @ rotations[0].T @ translations[0]
    flipped = bundle_adjustment.replace_pose(found.estimate, 3, rotations[3], 2 * towards - translations[3])
    behind = multiview_geometry.sampson_errors(flipped, (0, 3), pairs[0, 3])
    assert np.isinf(behind).mean() > 0.9


def test_no_pair_gives_no_map(taken):
    views = [MapperView(points, 0, max(SIZE)) for points in taken.pixels]
    assert incremental_mapper.build_model(views, [Lens((FOCAL,), 0.3)], {}, incremental_mapper.MapperConfig()) is None


def test_tracks_join_matches_and_drop_what_contradicts_itself():
    points = [np.arange(8, dtype=float).reshape(4, 2) + 10 * view for view in range(3)]

    def pair(*matches: tuple[int, int]) -> TwoView:
        index = np.array(matches)
        return TwoView(index, points[0][index[:, 0]], points[0][index[:, 1]], 0, 0.0, 0, 0, 1.0)

    matched = {(0, 1): pair((0, 0), (1, 1), (2, 2)), (1, 2): pair((0, 0), (1, 3)), (0, 2): pair((1, 1))}
    joined = multiview_geometry.build(points, matched)
    members = [
        {int(camera) for camera in joined.camera_of[joined.track_of == track]} for track in range(joined.num_tracks)
    ]
    # 0-0-0 is whole; 1-1 reaches two features of view 2, which both go; 2-2 is seen twice.
    assert sorted(map(sorted, members)) == [[0, 1], [0, 1], [0, 1, 2]]
    thinned = multiview_geometry.thin(joined, per_camera=1)
    assert thinned.num_tracks == 1
    assert sorted(thinned.camera_of) == [0, 1, 2]


def test_points_that_two_cameras_see_under_less_than_a_degree_are_not_kept():
    """Two cameras .02 apart: at depth 1 their rays meet under 1.15 degrees, at depth 1.3 under .88."""
    state = bundle_adjustment.make_empty_problem(
        rotations=np.tile(np.eye(3), (2, 1, 1)),
        translations=np.array([[0.0, 0, 0], [-0.02, 0, 0]]),
        lens_of_camera=np.zeros(2, np.int64),
        log_focals=np.log([500.0]),
        radials=np.zeros((1, 2)),
        shifts=np.zeros((1, 2)),
    )
    depths = np.array([1.0, 1.3])
    pixels = np.array([[500 * (0.01 - x) / depth, 0.0] for depth in depths for x in (0.0, 0.02)])
    tracks = multiview_geometry.Tracks(np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1]), pixels, 2)
    config = multiview_geometry.TriangulationConfig()
    found, kept = multiview_geometry.retriangulate(state, tracks, (0, 1), np.ones(2), config, 1.0)
    assert kept.tolist() == [0]
    np.testing.assert_allclose(found.points, [[0.01, 0.0, 1.0]], atol=1e-9)


def test_triangulated_points_are_where_they_were(taken):
    state_matrices = np.concatenate([taken.rotations, taken.translations[:, :, None]], 2)
    world = np.array([[0.2, -0.3, 0.1], [1.0, 0.5, -0.7]])
    camera, track = np.tile(np.arange(5), 2), np.repeat(np.arange(2), 5)
    in_camera = np.einsum("oij,oj->oi", taken.rotations[camera], world[track]) + taken.translations[camera]
    rays = in_camera[:, :2] / in_camera[:, 2:]
    points = multiview_geometry.triangulate(state_matrices, rays, camera, track, num_tracks=3)
    np.testing.assert_allclose(points[:2], world, atol=1e-9)
    assert np.isnan(points[2]).all()
    centres = -np.einsum("cji,cj->ci", taken.rotations, taken.translations)
    widest = multiview_geometry.largest_angles(centres, points[:2], camera, track)
    first, last = centres[0] - world[0], centres[4] - world[0]
    expected = np.degrees(np.arccos(first @ last / np.linalg.norm(first) / np.linalg.norm(last)))
    assert widest[0] == pytest.approx(expected, abs=1e-6)


def test_wrong_matches_do_not_hide_how_far_a_pair_moved():
    """8 of 25 points are right: less than the share that must agree, unless those that fit no length are left out."""
    generator = np.random.default_rng(4)
    turned = generator.uniform([-1.0, -1.0, 4.0], [1.0, 1.0, 6.0], (25, 3))
    direction = np.array([1.0, 0.0, 0.1]) / np.sqrt(1.01)
    moved = turned + 0.7 * direction
    rays = moved[:, :2] / moved[:, 2:]
    rays[8:, 1] += generator.choice([-1.0, 1.0], 17) * generator.uniform(0.05, 0.3, 17)
    assert mapping_problem._length(turned, direction, rays, 0.002, min_points=5) == pytest.approx(0.7, rel=1e-6)
    assert mapping_problem._length(turned, direction, rays, 0.002, min_points=9) is None


def test_views_are_placed_on_points_that_the_last_adjustment_has_not_renumbered(taken, pairs, monkeypatch):
    """Where pixels are not square, views that are left are tried again; points were dropped by then."""
    apart = {pair: found for pair, found in pairs.items() if 4 not in pair}
    views = [MapperView(points, 0, max(SIZE)) for points in taken.pixels]
    extended = []

    def free_aspects(partial: SparseModel, *_: object) -> SparseModel:
        kept = partial.estimate.point_of >= 10
        return replace(partial, estimate=bundle_adjustment.keep_observations(partial.estimate, kept))

    def extend(problem: MapperInput, partial: SparseModel, config: object) -> SparseModel:
        extended.append((len(partial.estimate.points), len(partial.track_of_point), len(partial.registered)))
        return real(problem, partial, config)

    real = incremental_mapper.extend
    monkeypatch.setattr(self_calibration, "free_aspects", free_aspects)
    monkeypatch.setattr(incremental_mapper, "extend", extend)
    assert incremental_mapper.build_model(views, [Lens((FOCAL,), 0.3)], apart, incremental_mapper.MapperConfig())
    assert extended[-1][2] == 4, "one view is left"
    assert all(points == tracks for points, tracks, _ in extended)


@pytest.mark.parametrize("zoom", [1.0, 1.03])
def test_a_lens_of_its_own_that_comes_out_as_the_common_one_is_none(taken, pairs, monkeypatch, zoom):
    """As where wrong matches alone are why a view hardly fits."""
    pixels = [zoom * points if view == 2 else points for view, points in enumerate(taken.pixels)]
    views = [MapperView(points, 0, max(SIZE)) for points in pixels]
    tried = OwnLens(1.07 * FOCAL, np.array([0.0, 0.07 * max(SIZE)]))
    monkeypatch.setattr(incremental_mapper, "_find_doubtful_views", lambda *_: [2])
    monkeypatch.setattr(mapping_problem, "find_own_lens", lambda *_: tried)
    monkeypatch.setattr(incremental_mapper, "score", lambda problem, *_: float(len(problem.lenses)))
    found = incremental_mapper.build_model(views, [Lens((FOCAL,), 0.3)], pairs, incremental_mapper.MapperConfig())
    assert found is not None
    focals = np.exp(found.estimate.log_focals[found.estimate.lens_of_camera])
    assert (found.estimate.lens_of_camera[2] == 0) == (zoom == 1.0)
    np.testing.assert_allclose(focals[2] / focals[1], zoom, rtol=0.003)
