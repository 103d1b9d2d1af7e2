"""Images of the built-in place that do not share a lens: each is found with its own, within its bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import msgspec
import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.extras.evaluate.dataset import TrueCamera
from splatnode.extras.evaluate.stability.degradations import (
    KINDS,
    correct_keystone,
    letterbox_image,
    set_intrinsics,
    zoom_image,
)
from splatnode.extras.evaluate.stability.perturbations import TrialImage, crop_image
from splatnode.extras.evaluate.stability.trial import list_registered_cameras, make_frames, make_world, score_cameras
from splatnode.recon import estimation
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import (
    LENS_INSIDE_BARS,
    Reconstruction,
    estimate_cameras,
    find_lenses_inside_bars,
)
from splatnode.recon.fallbacks import run_fallbacks
from splatnode.recon.keyframes import Features, Keyframe
from splatnode.recon.registration import bundle_adjustment, self_calibration
from splatnode.recon.registration.registration import register
from splatnode.recon.result.verdict import Code
from tests.support.synthetic import view_graph

pytestmark = pytest.mark.numerical

PLACE = synthetic.Config(views=6, width=640, height=480)


SMALL = synthetic.Config(views=4, width=320, height=240)


@lru_cache(maxsize=3)
def photographs(place: synthetic.Config = PLACE) -> tuple[TrialImage, ...]:
    cameras = synthetic.scene_cameras(place)
    found = []
    for frame, (T_world_camera, K) in zip(synthetic.stream(place), cameras, strict=True):
        found.append(
            TrialImage(frame.name, frame.image, TrueCamera(T_world_camera, K, place.width, place.height), "built-in")
        )
    return tuple(found)


def estimate(photos: Sequence[TrialImage]) -> Reconstruction:
    return estimate_cameras(view_graph(make_frames(photos)), (), ReconstructionConfig())


def check_within_bounds(photos: Sequence[TrialImage], found: Reconstruction) -> None:
    cameras = list_registered_cameras(found)
    assert found.verdict.publishable, found.verdict.message
    assert len(cameras) == len(photos)
    score = score_cameras(cameras, (make_world(photos),))
    for error in score.errors:
        for what, (size, bound) in error.pair_with_bounds().items():
            assert size <= 1.5 * bound, (error.name, what, size, bound)


def own(found: Reconstruction) -> list[str]:
    assert found.registration is not None
    return [found.graph.names[camera.index] for camera in found.registration.cameras if camera.own_lens]


def test_images_of_one_lens_keep_it():
    found = estimate(photographs())
    check_within_bounds(photographs(), found)
    assert own(found) == []


@pytest.mark.parametrize("factor", [1.05, 1.3, 2.0])
def test_a_digitally_zoomed_image_gets_a_lens_of_its_own(factor):
    photos = [zoom_image(photo, factor) if index == 3 else photo for index, photo in enumerate(photographs())]
    found = estimate(photos)
    check_within_bounds(photos, found)
    assert photos[3].name in own(found)


@pytest.mark.parametrize(("first", "factors"), [(3, (1.09, 1.41, 1.52)), (0, (1.0, 1.93, 1.14))])
def test_three_images_zoomed_each_are_found_with_a_lens_each(first, factors):
    """No search from the model with a common lens finds them."""
    chosen = photographs()[first : first + 3]
    photos = [zoom_image(photo, factor) for photo, factor in zip(chosen, factors, strict=True)]
    found = estimate(photos)
    check_within_bounds(photos, found)


@pytest.mark.parametrize("setting", ["exif", "given"])
def test_an_image_that_contradicts_what_is_told_gets_a_lens_of_its_own(setting):
    told = set_intrinsics(photographs(), setting)
    photos = [zoom_image(photo, 1.1) if index == 2 else photo for index, photo in enumerate(told)]
    found = estimate(photos)
    check_within_bounds(photos, found)
    assert own(found) == [photos[2].name]


def test_an_image_that_was_cropped_elsewhere_is_told_by_its_principal_point():
    photos = [crop_image(photo, 0.85, 1.0 if index == 2 else 0.5, 0.5) for index, photo in enumerate(photographs())]
    found = estimate(photos)
    check_within_bounds(photos, found)
    assert own(found) == [photos[2].name]
    assert f"{photos[2].name} has a lens of its own: its principal point is -" in found.verdict.message


def test_a_picture_of_the_place_that_hangs_elsewhere_is_no_camera():
    """It fits as an image through a displaced lens, to the pixel."""
    other = photographs(msgspec.structs.replace(PLACE, seed=PLACE.seed + 1))[0]
    picture = cv2.resize(photographs()[3].image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    hung = other.image.copy()
    hung[200 : 200 + picture.shape[0], 300 : 300 + picture.shape[1]] = picture
    photos = [*photographs()[:3], replace(other, name="elsewhere.png", image=hung), *photographs()[4:]]
    found = estimate(photos)
    assert (found.verdict.code, found.verdict.frames) == (Code.MOVING_SCENE, ("elsewhere.png",))
    assert "may be a picture in its picture" in found.verdict.message
    left = run_fallbacks(found, (), ReconstructionConfig())
    assert left.verdict.code is Code.OK_PARTIAL and left.camera_names == {photo.name for photo in photos} - {
        "elsewhere.png"
    }


def test_a_sheared_image_is_right_with_its_skew():
    """As by a rolling shutter while the camera turns: it was published far off, later named and left out."""
    image = photographs()[3].image
    height, width = image.shape[:2]
    sheared = np.array([[1.0, 0.03, -0.015 * height], [0.0, 1.0, 0.0]])
    warped = np.asarray(cv2.warpAffine(image, sheared, (width, height)), np.uint8)
    photos = [replace(photo, image=warped) if index == 3 else photo for index, photo in enumerate(photographs())]
    found = estimate(photos)
    check_within_bounds(photos, found)
    assert found.registration is not None and own(found) == [photos[3].name]
    assert found.registration.cameras[3].skew == pytest.approx(0.03, abs=0.005)


def test_an_answer_loses_the_image_that_stands_out_by_its_shear():
    """By 1 % where the image has a lens of its own, which takes the shear up; else by 4 %: telephones shear films."""
    found = estimate(photographs())
    assert found.registration is not None and found.verdict.publishable
    cameras, name = found.registration.cameras, photographs()[3].name
    own = replace(found.registration, cameras=tuple(replace(c, own_lens=c.index == 3) for c in cameras))
    few = replace(found.registration, cameras=cameras[:3])
    for registration, shear, others, named in (
        (found.registration, 0.05, 0.0, True), (found.registration, -0.03, 0.0, False), (own, -0.03, 0.0, True),
        (own, 0.009, 0.0, False), (own, 0.05, 0.05, False), (few, 0.05, 0.0, False),
    ):  # fmt: skip
        limits = estimation._limit_shears(found.graph, registration, found.verdict)
        shears = {photo.name: shear if photo.name == name else others for photo in photographs()}
        verdict = estimation._name_sheared(found.verdict, shears, limits)
        assert (verdict.code is Code.AMBIGUOUS and verdict.frames == (name,)) == named, (shear, others)


def test_exif_that_cropped_images_contradict_is_not_used():
    """An editor that crops leaves EXIF as it was, which then tells too short a focal length of what is left."""
    crops = [crop_image(photo, 0.6, 0.5, 0.5) for photo in photographs()]
    width, height = crops[0].image.shape[1::-1]
    stale = set_intrinsics(photographs(), "exif")[0].intrinsics
    assert stale is not None
    photos = [replace(photo, intrinsics=stale.resized(width, height)) for photo in crops]
    found = estimate(photos)
    check_within_bounds(photos, found)
    assert "EXIF" in found.verdict.message
    assert all(keyframe.frame.intrinsics is not None for keyframe in found.graph.keyframes)


@pytest.mark.parametrize("kind", ["cameras 1 : 1.12", "breathing 2 %", "all keystone", "all off-centre crops"])
def test_what_no_image_shares_is_found(kind):
    photos = KINDS[kind].change(photographs(), np.random.default_rng(0))
    check_within_bounds(photos, estimate(photos))


def test_a_principal_point_that_all_images_have_elsewhere_is_found():
    photos = [correct_keystone(photo, 8.0) for photo in photographs()]
    found = estimate(photos)
    assert found.registration is not None
    for camera in found.registration.cameras:
        true = photos[camera.index].camera
        assert true is not None
        assert np.abs(camera.principal - true.K[:2, 2]).max() < 0.02 * PLACE.width


def test_tied_lenses_share_what_is_not_refuted():
    """The information of a tie is that of the difference of two parameters."""
    count = 3
    sigmas = np.zeros((count, 7))
    sigmas[1, 0] = 0.01
    prior = bundle_adjustment.LensPrior(
        np.zeros(count),
        np.full(count, 0.5),
        np.zeros((count, 2)),
        np.zeros(count),
        ties=bundle_adjustment.LensTies(np.array([-1, 0, -1]), sigmas),
    )
    covariance = np.linalg.inv(prior.information[::7, ::7])
    apart = np.array([1.0, -1.0, 0.0])
    assert apart @ covariance @ apart == pytest.approx(0.01**2, rel=1e-3)
    assert covariance[2, 2] == pytest.approx(0.25)
    fixed = replace(prior, sigmas=np.array([0.0, 0.5, 0.5]))
    assert fixed.information[0, 0] == 0.0
    assert fixed.information[7, 7] == pytest.approx(1 / 0.01**2 + 1 / 0.5**2)


def test_a_group_has_the_covariance_of_common_and_own():
    count, own_sigma, common_sigma = 4, 0.02, 0.3
    common = np.zeros((count, 7))
    common[:, 0] = common_sigma
    prior = bundle_adjustment.LensPrior(
        np.zeros(count),
        np.full(count, own_sigma),
        np.zeros((count, 2)),
        np.zeros(count),
        common=bundle_adjustment.CommonLensPrior(np.zeros(count, np.int64), common),
    )
    covariance = np.linalg.inv(prior.information[::7, ::7])
    assert np.allclose(covariance, own_sigma**2 * np.eye(count) + common_sigma**2)
    assert prior.free[:, 0].all() and not prior.free[:, 1:].any()


def test_a_group_of_which_nothing_but_its_common_part_is_open_has_an_information():
    """A sum of covariances that rounding makes singular ended the run."""
    common = np.zeros((2, 7))
    common[:, 0] = 150.0
    prior = bundle_adjustment.LensPrior(
        np.zeros(2),
        np.zeros(2),
        np.zeros((2, 2)),
        np.zeros(2),
        common=bundle_adjustment.CommonLensPrior(np.zeros(2, np.int64), common),
    )
    information = prior.information[::7, ::7]
    assert np.isfinite(information).all() and information[0, 1] == pytest.approx(-information[0, 0], rel=1e-6)


def test_what_is_not_refuted_widens_the_covariance():
    """A lens that is taken to be common may differ a little from image to image."""
    graph, settings = view_graph(make_frames(photographs(SMALL))), ReconstructionConfig().registration
    tight = msgspec.structs.replace(settings.mapper.own_lenses, focal_sigma=1e-5, shift_sigma=1e-5, radial_sigma=1e-5)
    sure = msgspec.structs.replace(settings, mapper=msgspec.structs.replace(settings.mapper, own_lenses=tight))
    wide, narrow = (register(graph.keyframes, graph.pairs, each) for each in (settings, sure))
    assert wide is not None and narrow is not None
    pairs = list(zip(wide.cameras, narrow.cameras, strict=True))
    assert all(one.centre_sigma_rel > 1.2 * other.centre_sigma_rel for one, other in pairs)
    assert all(one.focal_sigma > 1.2 * other.focal_sigma for one, other in pairs)


def test_images_of_different_cameras_share_no_lens():
    cameras = ("a", "a", "", "b", "b", "")
    photos = photographs(msgspec.structs.replace(SMALL, views=len(cameras)))
    named = [replace(frame, camera=camera) for frame, camera in zip(make_frames(photos), cameras, strict=True)]
    keyframes = [Keyframe(frame, frame.image, Features(*(np.zeros(0),) * 4)) for frame in named]
    lens_of = self_calibration.group(keyframes, across_sizes=True).lens_of
    assert lens_of[0] == lens_of[1] == lens_of[2] and lens_of[3] == lens_of[4] != lens_of[0]


@pytest.mark.parametrize("setting", ["exif", "given"])
def test_the_lens_that_is_told_of_an_image_shrunk_into_black_bars_is_not_used(setting):
    """Three images cannot refute it."""
    told = set_intrinsics(photographs()[1:4], setting)
    photos = [letterbox_image(photo, 0.75) if index == 1 else photo for index, photo in enumerate(told)]
    found = estimate(photos)
    check_within_bounds(photos, found)
    assert LENS_INSIDE_BARS in found.verdict.message and photos[1].name in found.verdict.message
    assert found.registration is not None
    focals = {found.graph.names[camera.index]: camera.focal for camera in found.registration.cameras}
    assert focals[photos[1].name] == pytest.approx(0.75 * focals[photos[0].name], rel=0.05)
    assert all(keyframe.frame.intrinsics is not None for keyframe in found.graph.keyframes)


def test_a_lens_that_is_told_of_images_with_the_same_bars_is_used():
    boxed = [letterbox_image(photo, 0.75) for photo in photographs()[1:4]]
    told = make_frames(set_intrinsics(boxed, "given"))
    assert find_lenses_inside_bars(view_graph(told)) == frozenset()
    # Those of another camera have none: it has a lens of its own.
    beside = [replace(frame, camera_id="left") for frame in make_frames(set_intrinsics(photographs()[4:], "given"))]
    assert find_lenses_inside_bars(view_graph([*told, *beside])) == frozenset()
    same = [replace(frame, camera_id="") for frame in beside]
    assert find_lenses_inside_bars(view_graph([*told, *same])) == frozenset(frame.name for frame in told)
