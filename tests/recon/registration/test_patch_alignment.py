"""Patches found again under known warps."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.recon.core import default_threads, set_threads
from splatnode.recon.registration import subpixel
from splatnode.recon.registration.subpixel import Patches

MATRIX = np.array([[0.9, 0.15], [-0.1, 1.1]])
SHIFT = np.array([30.3, 20.7])


def texture(height: int = 300, width: int = 400, seed: int = 0) -> np.ndarray:
    """Smooth noise of mean 128 and deviation 40."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(height, width)), (0, 0), 2.0)
    return (128.0 + 40.0 * (noise - noise.mean()) / noise.std()).astype(np.float32)


def warped(image: np.ndarray) -> np.ndarray:
    """The image seen through the affine model, darker and with less contrast."""
    matrix = np.column_stack([MATRIX, SHIFT])
    return cv2.warpAffine(image, matrix, (440, 400), flags=cv2.INTER_CUBIC) * 0.8 + 20.0


def true_target(reference: np.ndarray) -> np.ndarray:
    """OpenCV's model is between pixel centres at whole numbers."""
    return (reference - 0.5) @ MATRIX.T + SHIFT + 0.5


def patches(count: int = 200, error_px: float = 1.0) -> Patches:
    generator = np.random.default_rng(1)
    reference = generator.uniform([60, 60], [340, 240], (count, 2))
    return Patches(
        reference_image=np.zeros(count, np.int64),
        reference=reference,
        target_image=np.ones(count, np.int64),
        target=true_target(reference) + generator.normal(size=(count, 2)) * error_px,
        affine=np.tile(np.eye(2), (count, 1, 1)),
    )


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return [texture(), warped(texture())]


def test_a_known_warp_is_found_to_a_fiftieth_of_a_pixel(images):
    given = patches()
    found = subpixel.align(images, given, subpixel.PatchAlignmentConfig())
    aligned = found.correlation > 0.9
    assert aligned.mean() > 0.95
    errors = np.linalg.norm(found.target - true_target(given.reference), axis=1)[aligned]
    assert np.median(errors) < 0.02
    assert np.quantile(errors, 0.95) < 0.05
    np.testing.assert_allclose(np.median(found.affine[aligned], axis=0), MATRIX, atol=0.01)


def test_sigma_is_the_spread_under_noise(images):
    given = patches(count=60, error_px=0.2)
    generator = np.random.default_rng(2)
    errors, sigmas = [], []
    for _ in range(12):
        noisy = [image + generator.normal(size=image.shape).astype(np.float32) * 4.0 for image in images]
        found = subpixel.align(noisy, given, subpixel.PatchAlignmentConfig())
        good = found.correlation > 0.8
        errors.append((found.target - true_target(given.reference))[good])
        sigmas.append(found.sigma[good])
    spread = np.concatenate(errors).std()
    # The sigma is along the worst direction of each patch; the spread is over both.
    assert spread < np.median(np.concatenate(sigmas)) * 1.5
    assert spread > np.median(np.concatenate(sigmas)) * 0.4


def test_without_iterations_nothing_moves_and_the_truth_correlates_best(images):
    given = patches(error_px=0.0)
    right = subpixel.align(
        images,
        replace(given, affine=np.tile(MATRIX, (200, 1, 1))),
        subpixel.PatchAlignmentConfig(max_iterations=0),
    )
    wrong = subpixel.align(images, given, subpixel.PatchAlignmentConfig(max_iterations=0))
    np.testing.assert_allclose(right.target, given.target, atol=1e-4)
    assert np.median(right.correlation) > 0.99
    assert np.median(wrong.correlation) < 0.96


def test_what_shows_nothing_or_leaves_the_image_is_not_aligned(images):
    flat = np.full((300, 400), 90.0, np.float32)
    given = patches(count=20, error_px=0.0)
    assert (subpixel.align([flat, flat], given, subpixel.PatchAlignmentConfig()).correlation == -1.0).all()
    outside = replace(given, target=np.full((20, 2), 3.0))
    found = subpixel.align(images, outside, subpixel.PatchAlignmentConfig())
    assert (found.correlation == -1.0).all()
    assert np.isinf(found.sigma).all()
    np.testing.assert_allclose(found.target, outside.target)


def test_the_number_of_threads_does_not_matter(images):
    results = []
    for threads in (3, 1):
        set_threads(threads)
        results.append(subpixel.align(images, patches(), subpixel.PatchAlignmentConfig()).target)
    set_threads(default_threads())
    np.testing.assert_array_equal(results[0], results[1])


def test_no_patch_is_no_problem(images):
    assert subpixel.align(images, patches(count=0), subpixel.PatchAlignmentConfig()).target.shape == (
        0,
        2,
    )


@pytest.mark.parametrize("radius", [0, 13])
def test_a_radius_out_of_range_is_refused(images, radius):
    with pytest.raises(ValueError, match="1 to 12"):
        subpixel.align(images, patches(), subpixel.PatchAlignmentConfig(radius=radius))


def test_an_image_that_is_not_there_is_refused(images):
    with pytest.raises(ValueError, match="target images"):
        subpixel.align(images[:1], patches(), subpixel.PatchAlignmentConfig())
