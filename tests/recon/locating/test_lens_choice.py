"""A query image of another lens than was assumed is placed with its own one, or refused; never with a wrong one."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.capture.frame import Intrinsics
from splatnode.recon.keyframes import Features
from splatnode.recon.locating import LensSource, Located, NotLocated, Reason, pose_refinement
from splatnode.recon.locating.localize import follow, localize_image, prepare_query_image
from splatnode.recon.locating.pose_refinement import (
    PINHOLE,
    CameraModel,
    Correspondences,
    Lens,
    LensAssumption,
    PosePrior,
    assume_lenses,
    make_lens_grid,
    match_landmarks,
    measure_mirror_gain,
)
from splatnode.recon.locating.verification import LensChoice, QueryContext, choose_lens, search_cameras
from splatnode.recon.matching import features as matching_features
from splatnode.recon.result.snapshot import KnownLenses, Landmarks
from splatnode.recon.verification import evidence
from tests.bench.quality import query_warps
from tests.bench.quality.query_warps import WARPS, Query
from tests.support.located import PLACE, errors, known_place, photograph

WIDTH, HEIGHT, FOCAL = 1024, 768, 900.0
MIRROR = np.diag([-1.0, 1.0, 1.0])


def warped(index: int, warp: str) -> tuple[Query, Located | NotLocated, tuple]:
    image, camera = photograph(index)
    query = WARPS[warp](image, camera[1], index)
    return query, localize_image(known_place().landmarks, query.image), camera


def assert_right(query: Query, found: Located | NotLocated, camera: tuple) -> None:
    """Placed, within its bounds, with the focal lengths and the principal point that the image has."""
    assert isinstance(found, Located)
    degrees, percent = errors(found, camera)
    assert degrees <= found.claim.rotation_deg and percent <= found.claim.centre_percent
    assert query.K is not None
    off = np.abs(np.log(np.diag(found.K)[:2] / np.diag(query.K)[:2]))
    assert off.max() <= np.log1p(found.claim.focal_percent / 100.0)
    shift = np.linalg.norm(found.K[:2, 2] - query.K[:2, 2]) / max(query.image.shape)
    assert 100.0 * shift <= found.claim.principal_percent


@pytest.mark.parametrize("index, factor", [(0, 1.05), (2, 1.3), (0, 2.0), (1, 2.0), (2, 2.0), (0, 2.5)])
def test_a_zoomed_image_is_placed_with_a_lens_of_its_own(index, factor):
    query, found, camera = warped(index, f"zoom {factor}")
    assert_right(query, found, camera)
    assert isinstance(found, Located) and found.lens is LensSource.FREE
    assert "its lens is its own" in found.sentence


@pytest.mark.parametrize("warp", ["crop corner 0.8", "cut middle 0.8", "cut corner 0.8", "letterbox 0.75"])
def test_a_part_of_an_image_is_placed_with_the_principal_point_where_the_whole_has_it(warp):
    query, found, camera = warped(2, warp)
    assert_right(query, found, camera)


@pytest.mark.parametrize("warp", ["stretch 1.1", "squeeze 0.75"])
def test_an_image_whose_pixels_are_not_square_is_placed_with_two_focal_lengths(warp):
    query, found, camera = warped(2, warp)
    assert_right(query, found, camera)
    assert isinstance(found, Located) and abs(found.K[0, 0] / found.K[1, 1] - 1.0) > 0.05


@pytest.mark.parametrize("index, share", [(0, 0.667), (1, 0.667), (3, 0.5625), (4, 0.5625)])
def test_an_image_that_was_made_square_is_not_placed_with_square_pixels(index, share):
    """Two of them were placed 11 and 14 bounds off, as if taken from afar through a long lens."""
    image, camera = photograph(index)
    query = query_warps.squeeze(image, camera[1], index, share)
    found = localize_image(known_place().landmarks, query.image)
    assert_right(query, found, camera)


@pytest.mark.parametrize("shear", [0.01, -0.04])
def test_the_shear_of_a_rolling_shutter_is_taken_out(shear):
    """Focal length, aspect and principal point imitate it, and the pose slides along: up to 8 bounds off."""
    image, camera = photograph(2)
    height, width = image.shape[:2]
    sheared = np.array([[1.0, shear, -shear * height / 2.0], [0.0, 1.0, 0.0]])
    found = localize_image(
        known_place().landmarks, np.asarray(cv2.warpAffine(image, sheared, (width, height)), np.uint8)
    )
    assert_right(Query(image, camera[1]), found, camera)
    assert isinstance(found, Located) and found.shear == pytest.approx(shear, abs=0.002)
    assert f"sheared by {100 * abs(found.shear):.1f} %" in found.sentence


def test_an_image_without_shear_has_none():
    _, found, _ = warped(2, "zoom 1.3")
    assert isinstance(found, Located) and found.shear == 0.0


def test_a_lens_that_bends_lines_is_estimated():
    query, found, camera = warped(1, "bend -0.15")
    assert_right(query, found, camera)
    assert isinstance(found, Located) and found.distortion[0] == pytest.approx(-0.15, abs=0.03)


def test_the_scenes_own_lens_is_named_where_the_image_does_not_contradict_it():
    found = localize_image(known_place().landmarks, photograph(1)[0])
    assert isinstance(found, Located) and found.lens is LensSource.SCENE
    assert "its lens is its own" not in found.sentence


@pytest.mark.parametrize("source", ["exif", "given"])
def test_a_lens_that_is_stated_is_tested(source):
    image, camera = photograph(0)
    K = camera[1]
    stated = Intrinsics(PLACE.width, PLACE.height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], source)
    query = WARPS["zoom 1.3"](image, K, 0)
    found = localize_image(known_place().landmarks, query.image, stated)
    assert_right(query, found, camera)
    assert isinstance(found, Located) and found.lens is LensSource.FREE  # the statement is of the whole image
    right = localize_image(known_place().landmarks, image, stated)
    assert isinstance(right, Located) and right.lens in (LensSource.SCENE, LensSource.GIVEN)


def test_a_lens_that_no_crop_makes_of_the_stated_one_is_refused():
    image, camera = photograph(0)
    focal = 2.0 * camera[1][0, 0]
    stated = Intrinsics(PLACE.width, PLACE.height, focal, focal, PLACE.width / 2, PLACE.height / 2, "exif")
    found = localize_image(known_place().landmarks, image, stated)
    assert isinstance(found, NotLocated) and found.code is Reason.LENS and "are stated" in found.message


def test_an_image_that_follows_another_may_zoom():
    image, camera = photograph(1)
    before = localize_image(known_place().landmarks, photograph(0)[0])
    assert isinstance(before, Located)
    query = WARPS["zoom 1.6"](image, camera[1], 1)
    found = follow(known_place().landmarks, query.image, before)
    assert_right(query, found, camera)
    assert isinstance(found, Located)
    next_image, next_camera = photograph(2)
    again = WARPS["zoom 1.6"](next_image, next_camera[1], 2)
    assert_right(again, follow(known_place().landmarks, again.image, found), next_camera)


def symmetric(landmarks: Landmarks, share: float) -> Landmarks:
    """The scene with that share of its points a second time, mirrored left to right, as other images show them."""
    points = np.arange(len(landmarks.points))
    twice = np.random.default_rng(0).random(len(points)) < share
    kept = twice[landmarks.point_of]
    number = len(points) + np.cumsum(twice) - 1
    Ts = landmarks.Ts_world_camera.copy()
    Ts[:, :3, :3] = MIRROR @ Ts[:, :3, :3] @ MIRROR
    Ts[:, :3, 3] = Ts[:, :3, 3] @ MIRROR
    lenses = landmarks.lenses
    return replace(
        landmarks,
        points=np.concatenate([landmarks.points, landmarks.points[twice] @ MIRROR]),
        covariances=np.concatenate([landmarks.covariances, MIRROR @ landmarks.covariances[twice] @ MIRROR]),
        descriptors=np.concatenate([landmarks.descriptors, evidence.mirror_descriptors(landmarks.descriptors[kept])]),
        point_of=np.concatenate([landmarks.point_of, number[landmarks.point_of[kept]]]),
        photograph_of=np.concatenate([landmarks.photograph_of, len(landmarks.names) + landmarks.photograph_of[kept]]),
        names=landmarks.names + tuple(f"mirrored {name}" for name in landmarks.names),
        Ts_world_camera=np.concatenate([landmarks.Ts_world_camera, Ts]),
        lenses=KnownLenses(*(np.concatenate([each, each]) for each in vars(lenses).values())),
        rotation_bounds=np.tile(landmarks.rotation_bounds, 2),
        centre_bounds=np.tile(landmarks.centre_bounds, 2),
        focal_bounds=None if landmarks.focal_bounds is None else np.tile(landmarks.focal_bounds, 2),
    )


def test_a_mirrored_image_of_a_symmetric_place_is_refused():
    image, camera = photograph(2)
    scene = symmetric(known_place().landmarks, 0.4)
    mirrored = localize_image(scene, np.ascontiguousarray(image[:, ::-1]))
    assert isinstance(mirrored, NotLocated) and mirrored.code is Reason.MIRRORED
    found = localize_image(scene, image)
    assert isinstance(found, Located) and max(errors(found, camera)) < 1.0


def test_the_gain_of_mirroring_is_above_0_for_mirrored_images_alone():
    image, _ = photograph(2)
    features = prepare_query_image(image).features
    turned = Features(
        features.points, evidence.mirror_descriptors(features.descriptors), features.point_of, features.tilt
    )
    gains = [
        measure_mirror_gain(each, known_place().landmarks, evidence.ReflectionConfig()) for each in (features, turned)
    ]
    assert gains[0] < -0.3 and gains[1] == pytest.approx(-gains[0])


def seen(lens: Lens, relief: float, count: int = 600, noise_px: float = 0.5) -> Correspondences:
    """Points at depth 4, and before and behind it by `relief`, all over the image of a camera with this lens."""
    draw = np.random.default_rng(1)
    wanted = draw.uniform(-0.5, 0.5, (count, 2)) * [WIDTH, HEIGHT]
    depth = 4.0 + relief * draw.uniform(-1.0, 1.0, (count, 1))
    points = np.column_stack([wanted / lens.focal, np.ones(count)]) * depth
    pixels, _ = CameraModel(np.eye(3), np.zeros(3), lens).project(points)
    index = np.arange(count)
    along = points / np.linalg.norm(points, axis=1, keepdims=True)
    noisy = pixels + draw.normal(0.0, noise_px, pixels.shape)
    return Correspondences(noisy, index, points, np.zeros((count, 3, 3)), index, np.zeros(count, int), along)


def chosen_of(known: Correspondences, assumed: list[LensAssumption]) -> LensChoice:
    judged = QueryContext(known, WIDTH, HEIGHT, 0.5, 4.0, pose_refinement.PoseSearchConfig())
    chosen = choose_lens(judged, search_cameras(judged, assumed, make_lens_grid(judged.side, assumed)), assumed)
    assert chosen is not None
    return chosen


def own(focal: float) -> list[LensAssumption]:
    one = np.ones(1)
    lenses = KnownLenses(focal / WIDTH * one, np.zeros((1, 2)), np.zeros((1, 2)), HEIGHT / WIDTH * one)
    return assume_lenses(lenses, WIDTH, HEIGHT, None)


def focal_sigmas(chosen: LensChoice, focal: float) -> tuple[float, float]:
    """The error of the logarithm of the focal length, and its standard deviation."""
    sigma = float(np.sqrt(chosen.posed.fit.covariance[6, 6]))
    return abs(np.log(chosen.posed.fit.camera.lens.focal / focal)), sigma


def test_before_a_scene_with_depth_an_assumed_lens_is_refuted_and_the_right_one_found():
    lens = Lens(FOCAL, PINHOLE, np.zeros(2), 0.0, 0.0, 0.0)
    known = seen(lens, relief=2.0)
    assert chosen_of(known, own(FOCAL)).source is LensSource.SCENE
    other = chosen_of(known, own(FOCAL / 1.1))
    error, sigma = focal_sigmas(other, FOCAL)
    assert other.source is LensSource.FREE and error < 2.0 * sigma < 0.03


def test_before_a_plane_nothing_confirms_a_lens_and_the_covariance_says_so():
    """Focal length and distance trade off there: the assumed lens stays, and counts as hardly known."""
    lens = Lens(FOCAL, PINHOLE, np.zeros(2), 0.0, 0.0, 0.0)
    flat, deep = (chosen_of(seen(lens, relief), own(FOCAL)) for relief in (0.0, 2.0))
    assert focal_sigmas(flat, FOCAL)[1] > 5.0 * focal_sigmas(deep, FOCAL)[1]
    for factor in (1.02, 1.05, 1.1, 1.2):
        wrong = chosen_of(seen(lens, 0.0), own(FOCAL / factor))
        error, sigma = focal_sigmas(wrong, FOCAL)
        assert error < 2.5 * 1.96 * sigma


def test_a_given_lens_that_fits_stays_as_it_is_and_is_not_taken_for_exact():
    lens = Lens(FOCAL, PINHOLE, np.zeros(2), 0.0, 0.0, 0.0)
    given = Intrinsics(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, "given")
    nothing = KnownLenses(np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    chosen = chosen_of(seen(lens, 1.0), assume_lenses(nothing, WIDTH, HEIGHT, given))
    assert chosen.source is LensSource.GIVEN and chosen.posed.fit.camera.lens.focal == pytest.approx(FOCAL)
    assert focal_sigmas(chosen, FOCAL)[1] > 0.001


def test_a_start_on_which_only_far_points_agree_gives_way_to_one_with_near_points():
    """The far ones, nearly a plane, leave focal length and distance open; a few near ones tell both."""
    right = Lens(FOCAL, PINHOLE, np.zeros(2), 0.0, 0.0, 0.0)
    far, near = seen(right, 0.02, 300), seen(right, 0.0, 12)
    near = replace(
        near, points=0.15 * near.points, feature_of=near.feature_of + 300, landmark_of=near.landmark_of + 300
    )
    known = Correspondences(*(np.concatenate([getattr(far, name), getattr(near, name)]) for name in FIELDS))
    judged = QueryContext(known, WIDTH, HEIGHT, 0.5, 4.0, pose_refinement.PoseSearchConfig())
    short = replace(right, focal=0.9 * FOCAL)
    start = pose_refinement.search_pose(judged.known.select(np.arange(300)), short, judged.scale, judged.settings)
    assert start is not None
    agreeing = pose_refinement.agreement(start, known, judged.settings.search_px * judged.scale)
    assert agreeing[:300].mean() > 0.9 and not agreeing[300:].any()
    chosen = choose_lens(judged, [start], [])
    assert chosen is not None and chosen.posed.agreeing[300:].all()
    error, sigma = focal_sigmas(chosen, FOCAL)
    assert error < 2.0 * sigma < 0.03


FIELDS = tuple(Correspondences.__dataclass_fields__)


def test_landmarks_are_not_looked_for_where_their_camera_leaves_them_open():
    """What agrees with it by chance would be found there, and nothing that speaks against it."""
    landmarks, (image, camera) = known_place().landmarks, photograph(0)
    T = known_place().to_scene.camera(camera[0])
    lens = Lens(float(camera[1][0, 0]), PINHOLE, np.zeros(2), 0.0, 0.0, 0.0)
    model, features = CameraModel(T[:3, :3].T, -T[:3, :3].T @ T[:3, 3], lens), prepare_query_image(image).features
    principal, config = 0.5 * np.array(image.shape[1::-1]), matching_features.NearestNeighbourConfig()
    depths = model.project(landmarks.points)[1]
    found = []
    middle = 5.0 * float(np.median(depths)) / lens.focal  # two of them are the reach at the median depth
    for sigma in (0.0, 0.1 * middle, middle, 100.0 * middle):
        covariance = np.diag([0.0, 0.0, 0.0, sigma, 0.0, 0.0, *[0.0] * 5]) ** 2  # to its right
        near = PosePrior(model, image.shape[1::-1], 10.0, covariance)
        found.append(match_landmarks(features, principal, landmarks, config, near))
    exact = match_landmarks(features, principal, landmarks, config, PosePrior(model, image.shape[1::-1], 10.0))
    assert np.array_equal(found[0].landmark_of, exact.landmark_of)
    assert [len(each) for each in found] == sorted((len(each) for each in found), reverse=True)
    assert len(found[1]) > 0.9 * len(exact) and len(found[3]) == 0
    assert 0 < len(found[2]) < len(exact) and depths[found[2].landmark_of].min() >= 0.999 * np.median(depths)
