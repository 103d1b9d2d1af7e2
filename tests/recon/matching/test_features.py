"""Features: where they are, what a simulated tilt adds, and that tilted views match what plain ones do not."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.capture.frame import Frame
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching import features, pair_matching
from splatnode.recon.matching import view_graph as matching
from splatnode.recon.matching.pair_matching import TwoView


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    """(480, 640, 3) RGB: soft noise of several scales."""
    generator = np.random.default_rng(0)
    layers = [cv2.resize(generator.random((480 // s, 640 // s)).astype(np.float32), (640, 480)) for s in (6, 12, 30)]
    grey = np.mean(layers, axis=0)
    grey = 255 * (grey - grey.min()) / (grey.max() - grey.min())
    return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)


def test_one_descriptor_a_point_inside_the_image(picture):
    found = features.extract(picture, features.FeatureConfig(max_num_features=500))
    assert 400 < len(found.points) <= 510
    assert found.descriptors.shape == (len(found.points), 128) and found.descriptors.dtype == np.uint8
    np.testing.assert_array_equal(found.point_of, np.arange(len(found.points)))
    assert (found.points > 0).all() and (found.points < [640, 480]).all()


@pytest.mark.parametrize("longer_side", [400, 640, 1600])
def test_points_are_in_full_size_pixels_at_whatever_size_they_are_found(picture, longer_side):
    """A bright dot on black, whose centre is known."""
    dot = np.zeros((480, 640), np.float32)
    y, x = np.mgrid[:480, :640] + 0.5
    dot += 200 * np.exp(-((x - 201.3) ** 2 + (y - 150.8) ** 2) / (2 * 6.0**2))
    image = np.repeat(dot[..., None], 3, axis=2).astype(np.uint8)
    config = features.FeatureConfig(max_image_size=longer_side, min_longer_side=min(longer_side, 1000))
    found = features.extract(image, config)
    np.testing.assert_allclose(found.points[0], [201.3, 150.8], atol=0.25)


def test_an_image_of_one_colour_has_none():
    found = features.extract(np.full((60, 80, 3), 128, np.uint8), features.FeatureConfig())
    assert found.points.shape == (0, 2) and found.descriptors.shape == (0, 128)
    assert (
        len(
            features.add_affine_features(
                found, np.full((60, 80, 3), 128, np.uint8), (1.6,), features.FeatureConfig()
            ).points
        )
        == 0
    )


def test_a_tilt_adds_descriptors_to_known_points_and_points(picture):
    config = features.FeatureConfig(max_num_features=500)
    plain = features.extract(picture, config)
    widened = features.add_affine_features(plain, picture, (1.6,), config)
    added = widened.tilt == 1.6
    assert added.sum() > 200
    np.testing.assert_array_equal(widened.points[: len(plain.points)], plain.points)
    np.testing.assert_array_equal(widened.tilt[~added], 1.0)
    snapped = widened.point_of[added] < len(plain.points)
    assert 0 < snapped.sum() < added.sum()
    assert widened.point_of.max() == len(widened.points) - 1
    again = features.add_affine_features(widened, picture, (1.6,), config)
    assert len(again.descriptors) == len(widened.descriptors)


def test_a_view_from_the_side_is_matched_by_tilted_features(picture):
    """The picture half as wide, as a wall seen from 60 degrees aside is."""
    aside = cv2.resize(cv2.GaussianBlur(picture, (0, 0), sigmaX=1.4, sigmaY=0.01), (320, 480))
    plain, tilted = num_right(picture, aside, 2.0)
    assert tilted > 3 * max(plain, 20)


def test_a_view_from_above_is_matched_by_tilts_below_one(picture):
    """The picture half as high, as a table seen from 60 degrees above its normal is."""
    above = cv2.resize(cv2.GaussianBlur(picture, (0, 0), sigmaX=0.01, sigmaY=1.4), (640, 240))
    plain, tilted = num_right(picture, above, 0.5)
    assert tilted > 3 * max(plain, 20)


def num_right(picture: np.ndarray, shrunk: np.ndarray, tilt: float) -> tuple[int, int]:
    """Right matches of the shrunk picture with plain features of the picture, and with those of this tilt."""
    config = features.FeatureConfig(max_num_features=2000)
    front, side = features.extract(picture, config), features.extract(shrunk, config)
    both = features.add_affine_features(front, picture, (tilt,), config)
    there = np.array(picture.shape[1::-1]) / shrunk.shape[1::-1]

    def count(chosen: np.ndarray) -> int:
        found = features.match(both.descriptors[chosen], side.descriptors, features.NearestNeighbourConfig())
        points = both.points[both.point_of[chosen]][found[:, 0]]
        return int((np.linalg.norm(points - side.points[found[:, 1]] * there, axis=1) < 3.0).sum())

    return count(both.tilt == 1.0), count(both.tilt == tilt)


def test_frames_without_features_are_compared_without_a_pair():
    flat = np.full((60, 80, 3), 128, np.uint8)
    config = matching.MatchingConfig()
    keyframes = [
        Keyframe(Frame(i, f"{i}.png", i, flat, None), flat, features.extract(flat, config.features)) for i in range(2)
    ]
    plain = pair_matching.match_plain(keyframes[0], keyframes[1], config.pair_matching)
    assert plain.geometry is None and plain.log10_nfa == 0.0 and plain.matches.shape == (0, 2)
    assert pair_matching.match_affine(keyframes[0], keyframes[1], plain, (1.6,), config.pair_matching).geometry is None


def test_the_motion_of_a_resized_copy_is_none():
    """A frame beside the same frame at half its size: in pixels of one size, nothing moved."""
    points = np.random.default_rng(0).uniform(-300, 300, (9, 2))
    pair = TwoView(np.zeros((9, 2), np.int64), points, 0.5 * points, 9, -20.0, 9, 9, 1.0)
    assert pair_matching.median_motion_px(pair, 640, 320) == 0.0
    moved = pair.rescale(1.0, 2.0)
    assert pair_matching.median_motion_px(moved, 640, 640) == 0.0
    assert pair_matching.median_motion_px(replace(moved, points2=points + [5.0, 0.0]), 640, 640) == pytest.approx(8.0)


def test_points_that_matches_know_keep_their_numbers_where_a_mask_hides_them():
    """As those of a learned matcher, which are nobody's features: further features came after them."""
    points = np.array([[10.0, 10.0], [90.0, 90.0], [12.0, 10.0], [92.0, 90.0]])
    known = features.Features(points, np.eye(4, dtype=np.uint8), np.arange(4), np.ones(4))
    mask = np.ones((100, 100), bool)
    mask[:50, :50] = False
    found = features.apply_mask(known, mask, first=2)
    np.testing.assert_array_equal(found.points, points[[0, 1, 3]])
    np.testing.assert_array_equal(found.point_of, [0, 1, 2])
    np.testing.assert_array_equal(features.apply_mask(known, mask).points, points[[1, 3]])
