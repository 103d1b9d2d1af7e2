"""Observations made exact, on a textured slope photographed by known cameras."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.recon.registration import bundle_adjustment, subpixel
from splatnode.recon.registration.subpixel import PatchImage
from tests.recon.registration.test_patch_alignment import texture

FOCAL = 300.0
SIZE = (320, 240)
# A slope in front of the cameras: points a + u * across + v * down for u in [0, 400], v in [0, 300].
CORNER, ACROSS, DOWN = np.array([-1.3, -1.0, 2.2]), np.array([0.0065, 0.0, 0.003]), np.array([0.0, 0.0065, 0.0005])
NORMAL = np.cross(ACROSS, DOWN) / np.linalg.norm(np.cross(ACROSS, DOWN))


def cameras() -> tuple[np.ndarray, np.ndarray]:
    """Three cameras side by side, the outer ones turned inwards."""
    centres = np.array([[-0.5, 0.0, 0.0], [0.0, 0.05, 0.0], [0.5, -0.05, 0.1]])
    rotations = np.stack([cv2.Rodrigues(np.array([0.02, turn, 0.03]))[0] for turn in (-0.15, 0.0, 0.15)])
    return rotations, -np.einsum("cij,cj->ci", rotations, centres)


def photographs() -> list[np.ndarray]:
    """The slope as each camera sees it, (240, 320, 3) RGB."""
    rotations, translations = cameras()
    image = texture()
    images = []
    for rotation, translation in zip(rotations, translations, strict=True):
        K = np.array([[FOCAL, 0.0, SIZE[0] / 2 - 0.5], [0.0, FOCAL, SIZE[1] / 2 - 0.5], [0.0, 0.0, 1.0]])
        plane = np.column_stack([rotation @ ACROSS, rotation @ DOWN, rotation @ CORNER + translation])
        seen = cv2.warpPerspective(image, K @ plane, SIZE, flags=cv2.INTER_CUBIC)
        images.append(np.repeat(np.clip(np.rint(seen), 0, 255).astype(np.uint8)[:, :, None], 3, axis=2))
    return images


def problem(noise_px: float, views: tuple[int, ...] = (0, 1, 2)) -> bundle_adjustment.Problem:
    """Points of the slope, observed by `views`; camera 1's observations are exact, the others' are not."""
    generator = np.random.default_rng(0)
    place = generator.uniform([120, 90], [280, 210], (80, 2))
    points = CORNER + place @ np.stack([ACROSS, DOWN])
    rotations, translations = cameras()
    camera_of, point_of = np.tile(views, len(points)), np.repeat(np.arange(len(points)), len(views))
    true = bundle_adjustment.Problem(
        rotations=rotations,
        translations=translations,
        lens_of_camera=np.zeros(3, np.int64),
        log_focals=np.log([FOCAL]),
        radials=np.zeros((1, 2)),
        shifts=np.zeros((1, 2)),
        points=points,
        camera_of=camera_of,
        point_of=point_of,
        pixels=np.zeros((len(camera_of), 2)),
    )
    pixels, _ = bundle_adjustment.project(true)
    noise = generator.normal(size=pixels.shape) * noise_px * (camera_of != 1)[:, None]
    return replace(true, pixels=pixels + noise)


@pytest.fixture(scope="module")
def images() -> list[PatchImage]:
    middle = np.array(SIZE) / 2.0
    return [subpixel.patch_image(image, middle, subpixel.PatchImageConfig()) for image in photographs()]


def test_noisy_observations_become_exact(images):
    noisy = problem(noise_px=0.5)
    refined = subpixel.refine(noisy, (0, 1, 2), images, subpixel.SubpixelConfig())
    assert len(refined.points) > 70
    assert np.median(bundle_adjustment.reprojection_errors(noisy)[noisy.camera_of != 1]) > 0.4
    aligned = bundle_adjustment.reprojection_errors(refined)[refined.camera_of != 1]
    assert np.median(aligned) < 0.05


def test_points_are_found_in_a_view_that_had_not_matched_them(images):
    refined = subpixel.refine(problem(0.3, views=(0, 1)), (0, 1, 2), images, subpixel.SubpixelConfig())
    in_third = refined.camera_of == 2
    assert in_third.sum() > 60
    # The reference is camera 0 or 1: where that observation is noisy, the point itself is.
    assert np.median(bundle_adjustment.reprojection_errors(refined)[in_third]) < 0.5
    not_registered = subpixel.refine(problem(0.3, views=(0, 1)), (0, 1), images, subpixel.SubpixelConfig())
    assert (not_registered.camera_of != 2).all()


def test_observations_of_something_else_are_left_out(images):
    start = problem(noise_px=0.1)
    generator = np.random.default_rng(3)
    wrong = (start.camera_of == 2) & (start.point_of < 40)
    pixels = np.where(wrong[:, None], generator.uniform(-80, 80, start.pixels.shape), start.pixels)
    refined = subpixel.refine(replace(start, pixels=pixels), (0, 1, 2), images, subpixel.SubpixelConfig())
    assert (bundle_adjustment.reprojection_errors(refined) < 1.0).mean() > 0.97
    assert (np.diff(refined.point_of) >= 0).all()
    assert np.bincount(refined.point_of).min() >= 2


def test_the_affine_of_a_plane_is_the_derivative_of_its_projection():
    of = problem(noise_px=0.0)
    source, target = np.zeros(80, np.int64), np.full(80, 2)
    affine = subpixel.plane_affines(of, of.points, np.tile(NORMAL, (80, 1)), source, target)
    centre = -of.rotations[0].T @ of.translations[0]

    def carried(pixel: np.ndarray) -> np.ndarray:
        """The pixel of camera 2 that shows what camera 0 sees of the slope at `pixel`."""
        ray = of.rotations[0].T @ np.array([*pixel / FOCAL, 1.0])
        point = centre + ray * (NORMAL @ (CORNER - centre)) / (NORMAL @ ray)
        in_camera = of.rotations[2] @ point + of.translations[2]
        return FOCAL * in_camera[:2] / in_camera[2]

    pixels = of.pixels[of.camera_of == 0]
    for index in range(0, 80, 16):
        numeric = np.stack(
            [(carried(pixels[index] + d) - carried(pixels[index] - d)) / 2e-4 for d in np.eye(2) * 1e-4], axis=1
        )
        np.testing.assert_allclose(affine[index], numeric, atol=1e-6)


def test_large_images_are_shrunk_and_pixels_with_them():
    image = np.zeros((1000, 2000, 3), np.uint8)
    shrunk = subpixel.patch_image(image, np.array([990.0, 505.0]), subpixel.PatchImageConfig(max_longer_side=500))
    assert shrunk.grey.shape == (250, 500)
    np.testing.assert_allclose(shrunk.map_to_grey(np.array([[10.0, -5.0]])), [[250.0, 125.0]])
    np.testing.assert_allclose(shrunk.map_from_grey(np.array([[250.0, 125.0]])), [[10.0, -5.0]])
