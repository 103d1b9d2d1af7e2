"""A photograph that was not in the set is placed where it was taken, or refused with a reason."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from splatnode.capture.frame import Intrinsics
from splatnode.extras.cameras import building
from splatnode.recon import poselib
from splatnode.recon.locating import Located, NotLocated, Reason, pose_refinement
from splatnode.recon.locating.localize import LocalizationConfig, localize_image, localize_query, prepare_query_image
from tests.support.located import PLACE, errors, known_place, photograph


@pytest.mark.parametrize("index", range(PLACE.views - 1))
def test_photographs_between_those_of_the_scene_are_placed_within_their_claim(index):
    image, camera = photograph(index)
    found = localize_image(known_place().landmarks, image)
    assert isinstance(found, Located)
    degrees, percent = errors(found, camera)
    assert degrees < 1.0 and percent < 1.0
    assert degrees <= found.claim.rotation_deg and percent <= found.claim.centre_percent
    assert found.claim.rotation_deg < 3.0 and found.claim.centre_percent < 5.0  # and it says something
    assert abs(found.K[0, 0] / camera[1][0, 0] - 1.0) <= found.claim.focal_percent / 100.0
    assert not found.metric and np.linalg.eigvalsh(found.covariance).min() > 0.0


def test_a_lens_that_is_given_is_believed():
    image, camera = photograph(2)
    K = camera[1]
    given = Intrinsics(PLACE.width, PLACE.height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], source="given")
    found = localize_image(known_place().landmarks, image, given)
    assert isinstance(found, Located) and np.allclose(found.K, K)
    assert max(errors(found, camera)) < 1.0
    wrong = Intrinsics(PLACE.width, PLACE.height, 3.0 * K[0, 0], 3.0 * K[0, 0], K[0, 2], K[1, 2], source="given")
    assert isinstance(localize_image(known_place().landmarks, image, wrong), NotLocated)


@pytest.mark.parametrize(
    "changed",
    [
        lambda image: cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE),
        lambda image: (0.4 * image).astype(np.uint8),
        lambda image: cv2.resize(image, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA),
    ],
    ids=["turned", "darker", "smaller"],
)
def test_a_photograph_that_was_turned_darkened_or_shrunk_is_placed_at_the_same_spot(changed):
    image, camera = photograph(1)
    found = localize_image(known_place().landmarks, np.ascontiguousarray(changed(image)))
    assert isinstance(found, Located)
    assert errors(found, camera)[1] < 1.0


def test_the_lens_of_a_part_of_a_photograph_looks_beside_its_middle():
    image, camera = photograph(2)
    part = np.ascontiguousarray(image[:, : 3 * PLACE.width // 4])
    found = localize_image(known_place().landmarks, part)
    assert isinstance(found, Located)
    degrees, percent = errors(found, camera)
    assert degrees <= found.claim.rotation_deg and percent <= found.claim.centre_percent and degrees < 1.0
    assert abs(found.K[0, 2] - camera[1][0, 2]) < 0.02 * PLACE.width  # where the whole photograph has it


def test_photographs_of_other_places_are_refused():
    landmarks = known_place().landmarks
    elsewhere = building.render_image(building.Config(width=480, height=360), 3.0)
    mirrored = np.ascontiguousarray(photograph(2)[0][:, ::-1])
    noise = np.random.default_rng(0).integers(0, 255, (360, 480, 3)).astype(np.uint8)
    for image in (elsewhere, mirrored, noise, np.full((360, 480, 3), 99, np.uint8)):
        found = localize_image(landmarks, image)
        assert isinstance(found, NotLocated) and found.code is Reason.NOT_FOUND
        assert found.sentence.startswith("refused: NOT_FOUND: ") and found.advice in found.sentence


def test_what_shows_the_scene_in_one_patch_alone_is_refused():
    image, _ = photograph(2)
    covered = np.full_like(image, 128)
    covered[140:220, 190:290] = image[140:220, 190:290]
    found = localize_image(known_place().landmarks, covered)
    assert isinstance(found, NotLocated)


def test_without_poselib_it_is_placed_as_well(monkeypatch):
    monkeypatch.setattr(pose_refinement.poselib, "estimate_absolute_pose", poselib.estimate_opencv_absolute_pose)
    image, camera = photograph(1)
    found = localize_image(known_place().landmarks, image)
    assert isinstance(found, Located) and max(errors(found, camera)) < 1.0
    mirrored = np.ascontiguousarray(image[:, ::-1])
    assert isinstance(localize_image(known_place().landmarks, mirrored), NotLocated)


def test_a_photograph_is_described_once_for_several_scenes():
    image, _ = photograph(0)
    landmarks, seen = known_place().landmarks, prepare_query_image(image)
    once, again = localize_query(landmarks, seen), localize_query(landmarks, seen, LocalizationConfig())
    assert isinstance(once, Located) and isinstance(again, Located)
    assert np.array_equal(once.T_world_camera, again.T_world_camera)


def test_in_metres_lengths_are_metres():
    image, _ = photograph(2)
    landmarks = known_place().landmarks
    relative = localize_image(landmarks, image)
    metric = localize_image(landmarks.transform(2.5, np.eye(3), np.zeros(3), metric=True), image)
    assert isinstance(relative, Located) and isinstance(metric, Located) and metric.metric
    assert np.allclose(metric.T_world_camera[:3, 3], 2.5 * relative.T_world_camera[:3, 3], atol=1e-3)
    assert metric.claim.centre == pytest.approx(2.5 * relative.claim.centre, rel=0.05)
    assert metric.claim.centre_percent == pytest.approx(relative.claim.centre_percent, rel=0.05)
    assert " m and" not in relative.sentence and " m;" in metric.sentence


def test_an_image_must_be_bytes_in_three_channels():
    with pytest.raises(ValueError, match="uint8"):
        localize_image(known_place().landmarks, np.zeros((9, 9, 3)))  # pyright: ignore[reportArgumentType]
