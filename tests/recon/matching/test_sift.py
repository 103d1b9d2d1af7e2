"""Our SIFT beside OpenCV's: the same features, whatever the size of the image, the threads and the instruction set."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from splatnode.recon import core
from splatnode.recon.matching import features
from splatnode.recon.matching.features import root_sift

CONTRAST = 0.01


def picture(width: int, height: int, seed: int = 0) -> np.ndarray:
    """(H, W) noise of several scales, with edges."""
    generator = np.random.default_rng(seed)
    grey = np.zeros((height, width), np.float32)
    for size in (3, 7, 19, 45):
        coarse = generator.random((height // size + 2, width // size + 2)).astype(np.float32)
        layer = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        grey += np.where(layer > 0.5, layer, 0) if size == 19 else layer
    return np.clip(255 * (grey - grey.min()) / (grey.max() - grey.min()), 0, 255).astype(np.uint8)


def by_opencv(grey: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (M, 2), RootSIFT descriptors (M, 128) and responses (M,), the strongest first."""
    detector = cv2.SIFT.create(nfeatures=most, contrastThreshold=CONTRAST, enable_precise_upscale=True)
    keypoints, raw = detector.detectAndCompute(grey, None)
    response = np.array([keypoint.response for keypoint in keypoints])
    order = np.argsort(-response, kind="stable")
    points = np.array([keypoint.pt for keypoint in keypoints])[order]
    return points, root_sift(np.asarray(raw, np.float32)[order]), response[order]


def share_found_again(points1, descriptors1, points2, descriptors2) -> float:
    """The share of the first features of which the second ones have one at the same place that looks the same."""
    _, candidates = KDTree(points2).query(points1, k=6, distance_upper_bound=0.05)
    padded = np.concatenate([descriptors2, np.full((1, 128), 255, np.uint8)]).astype(int)
    difference = np.linalg.norm(padded[candidates] - descriptors1[:, None].astype(int), axis=2).min(1)
    return float((difference < 12).mean())


@pytest.mark.numerical
@pytest.mark.parametrize(("width", "height"), [(640, 480), (333, 517), (97, 64)])
def test_the_same_features_as_opencv(width, height):
    grey = picture(width, height)
    points, descriptors, _ = by_opencv(grey, 3000)
    ours, our_descriptors = features.detect(grey, 3000, CONTRAST)
    assert abs(len(ours) - len(points)) <= 0.01 * len(points) + 1
    assert share_found_again(points, descriptors, ours, our_descriptors) > 0.98
    assert share_found_again(ours, our_descriptors, points, descriptors) > 0.98


def test_the_strongest_come_first_and_no_more_than_wanted():
    grey = picture(400, 300)
    every, _ = features.detect(grey, 5000, CONTRAST)
    some, _ = features.detect(grey, 200, CONTRAST)
    assert len(every) > 600 and len(some) == 200
    np.testing.assert_array_equal(some, every[:200])
    points, descriptors, response = by_opencv(grey, 5000)
    clearly_stronger = response > 1.01 * response[200]
    assert (
        share_found_again(
            points[clearly_stronger], descriptors[clearly_stronger], *features.detect(grey, 200, CONTRAST)
        )
        > 0.98
    )


def test_the_number_of_threads_changes_nothing():
    grey = picture(500, 400)
    found = []
    for threads in (1, 2, 5):
        core.set_threads(threads)
        found.append(features.detect(grey, 2000, CONTRAST))
    core.set_threads(core.default_threads())
    for points, descriptors in found[1:]:
        np.testing.assert_array_equal(points, found[0][0])
        np.testing.assert_array_equal(descriptors, found[0][1])


@pytest.mark.numerical
def test_a_turned_image_has_the_same_descriptors():
    grey = picture(300, 300)
    points, descriptors = features.detect(grey, 800, CONTRAST)
    turned_points, turned_descriptors = features.detect(np.rot90(grey).copy(), 800, CONTRAST)
    back = np.stack([299 - turned_points[:, 1], turned_points[:, 0]], 1)
    # The image is enlarged towards one corner: a turned one is shifted by half a pixel of the enlarged image.
    _, nearest = KDTree(back).query(points, distance_upper_bound=0.8)
    near = np.asarray(nearest) < len(back)
    similar = np.linalg.norm(descriptors[near].astype(int) - turned_descriptors[np.asarray(nearest)[near]], axis=1) < 60
    assert near.mean() > 0.6 and similar.mean() > 0.6


@pytest.mark.parametrize("shape", [(1, 1), (1, 500), (5, 5), (6, 7), (11, 200), (480, 640)])
def test_small_and_empty_images(shape):
    points, descriptors = features.detect(np.full(shape, 90, np.uint8), 100, CONTRAST)
    assert points.shape == (0, 2) and descriptors.shape == (0, 128)
    noise = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    points, descriptors = features.detect(noise, 100, CONTRAST)
    assert len(points) == len(descriptors) <= 100
    assert (points >= 0).all() and (points <= [shape[1], shape[0]]).all()


@pytest.mark.parametrize(
    "bad", [np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), np.zeros((0, 4), np.uint8)]
)
def test_other_arrays_are_refused(bad):
    with pytest.raises(ValueError, match="uint8"):
        features.detect(bad, 10, CONTRAST)
