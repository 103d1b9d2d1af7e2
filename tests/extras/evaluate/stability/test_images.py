"""Changed photographs and changed cameras belong together: a dot in the image is where the new camera sees it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.extras.evaluate.dataset import TrueCamera
from splatnode.extras.evaluate.stability import perturbations
from splatnode.extras.evaluate.stability.perturbations import TrialImage

WIDTH, HEIGHT = 320, 240
K = np.array([[300.0, 0.0, 155.0], [0.0, 310.0, 118.0], [0.0, 0.0, 1.0]])
POINT = np.array([0.12, -0.05, 1.3])  # in the frame of the camera


def dotted(pixel: np.ndarray) -> np.ndarray:
    """A soft white dot on black, its middle at `pixel`, where the first pixel's centre is (0.5, 0.5)."""
    down, across = np.mgrid[0:HEIGHT, 0:WIDTH]
    distance = (across + 0.5 - pixel[0]) ** 2 + (down + 0.5 - pixel[1]) ** 2
    return np.repeat(np.rint(255 * np.exp(-distance / 18.0))[..., None], 3, 2).astype(np.uint8)


def dot_in(image: np.ndarray) -> np.ndarray:
    """Where the dot is, to a small part of a pixel."""
    weight = image[..., 0].astype(float)
    weight[weight < 20] = 0.0
    down, across = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    return np.array([((across + 0.5) * weight).sum(), ((down + 0.5) * weight).sum()]) / weight.sum()


def project(K: np.ndarray, point: np.ndarray) -> np.ndarray:
    homogeneous = K @ point
    return homogeneous[:2] / homogeneous[2]


@pytest.fixture
def photo() -> TrialImage:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = cv2.Rodrigues(np.array([0.2, -0.5, 0.1]))[0]
    T_world_camera[:3, 3] = [1.0, 2.0, 3.0]
    return TrialImage("a.png", dotted(project(K, POINT)), TrueCamera(T_world_camera, K, WIDTH, HEIGHT), "here")


def seen_at(photo: TrialImage, p_world: np.ndarray) -> np.ndarray:
    """The pixel at which the camera of `photo` sees a point of the world."""
    assert photo.camera is not None
    assert (photo.camera.width, photo.camera.height) == photo.image.shape[1::-1]
    p_camera = np.linalg.inv(photo.camera.T_world_camera) @ [*p_world, 1.0]
    return project(photo.camera.K, p_camera[:3])


@pytest.mark.parametrize(
    "change",
    [
        perturbations.rotate_image,
        lambda photo: perturbations.resize_image(photo, 0.6),
        lambda photo: perturbations.resize_image(photo, 1.5),
        lambda photo: perturbations.crop_image(photo, 0.75, 0.3, 0.9),
        lambda photo: perturbations.distort_image(photo, 0.0),
        lambda photo: perturbations.render_turned_crops(photo, np.array([4.0]), np.array([-3.0]))[0],
    ],
    ids=["on its side", "smaller", "larger", "cropped", "not distorted", "turned"],
)
def test_the_dot_is_where_the_new_camera_sees_it(photo, change):
    T_world_camera = photo.camera.T_world_camera
    p_world = T_world_camera[:3, :3] @ POINT + T_world_camera[:3, 3]
    changed = change(photo)
    assert np.allclose(dot_in(changed.image), seen_at(changed, p_world), atol=0.1)


def test_turned_crops_keep_the_centre_and_turn(photo):
    left, right = perturbations.render_turned_crops(photo, np.array([-4.0, 4.0]), np.zeros(2))
    assert np.allclose(left.camera.T_world_camera[:3, 3], right.camera.T_world_camera[:3, 3])
    turn = left.camera.T_world_camera[:3, :3].T @ right.camera.T_world_camera[:3, :3]
    assert np.degrees(np.linalg.norm(cv2.Rodrigues(turn)[0])) == pytest.approx(8.0)


def test_the_mirrored_world_is_mirrored_in_x(photo):
    T_world_camera = photo.camera.T_world_camera
    p_world = T_world_camera[:3, :3] @ POINT + T_world_camera[:3, 3]
    reflected = perturbations.mirror_image(photo)
    assert np.linalg.det(reflected.camera.T_world_camera[:3, :3]) == pytest.approx(1.0)
    assert np.allclose(dot_in(reflected.image), seen_at(reflected, p_world * [-1, 1, 1]), atol=0.1)


def test_a_poster_is_where_its_cameras_see_it():
    poster = TrialImage("poster", dotted(np.array([100.0, 150.0])), None, "here")
    on_plane = np.array([100.0 / 160 - 1, (150.0 - 120) / 160, 0.0])  # as wide as 2, its middle in the origin
    for view in perturbations.render_poster_views(poster, np.array([-25.0, 0.0, 20.0])):
        image = np.where(view.image > 130, view.image, 0)  # beyond the edge it is grey: 128
        assert np.allclose(dot_in(image), seen_at(view, on_plane), atol=0.3)


@pytest.mark.parametrize("k1", [-0.3, -0.1, 0.1, 0.3])
def test_distortion_follows_its_coefficient_and_leaves_no_border(photo, k1):
    changed = perturbations.distort_image(photo, k1)
    true = POINT[:2] / POINT[2]
    seen = true * (1 + k1 * (true @ true))
    assert np.allclose(dot_in(changed.image), project(changed.camera.K, np.array([*seen, 1.0])), atol=0.1)
    # A frame drawn just inside the border of the photograph is still at the border or beyond it.
    framed = np.zeros_like(photo.image)
    framed[:2], framed[-2:], framed[:, :2], framed[:, -2:] = 255, 255, 255, 255
    inner = perturbations.distort_image(replace(photo, image=framed), k1).image[30:-30, 30:-30]
    assert inner.max() == 0


def test_a_rolling_shutter_shifts_the_first_rows_against_the_last(photo):
    rolled = perturbations.apply_rolling_shutter(
        replace(photo, image=np.tile(photo.image[:, :1] * 0, (1, WIDTH, 1))), 0.1
    )
    assert rolled.image.shape == photo.image.shape
    column = np.zeros_like(photo.image)
    column[:, 158:162] = 255
    shifted = perturbations.apply_rolling_shutter(replace(photo, image=column), 0.1).image
    first, last = (np.flatnonzero(shifted[row, :, 0] > 128).mean() for row in (0, HEIGHT - 1))
    assert first - last == pytest.approx(0.1 * WIDTH, abs=0.5)


# --- pixels


def test_pixel_changes_do_what_they_say():
    rng = np.random.default_rng(0)
    grey = np.full((60, 80, 3), 100, np.uint8)
    assert perturbations.add_noise(grey, 3.0, rng).astype(float).std() == pytest.approx(3.0, abs=0.1)
    ones = np.ones(3)
    assert np.array_equal(perturbations.change_exposure(grey, 1.0, 1.0, ones), grey)
    assert (perturbations.change_exposure(grey, 2.0, 1.0, ones) == 200).all() and (
        perturbations.change_exposure(grey, 3.0, 1.0, ones) == 255
    ).all()
    dark = perturbations.apply_vignetting(grey, 0.6)
    assert dark[30, 40, 0] == 100 and dark[0, 0, 0] == 40
    assert perturbations.simulate_low_light(grey, 400.0, rng).mean() == pytest.approx(25.0, abs=0.5)
    assert np.array_equal(perturbations.apply_motion_blur(grey, 11, 30.0), grey)
    noise = perturbations.generate_noise(60, 80, rng)
    smeared = perturbations.apply_motion_blur(noise, 11, 0.0).astype(float)
    assert np.abs(np.diff(smeared, axis=1)).mean() < 0.4 * np.abs(np.diff(smeared, axis=0)).mean()


@pytest.mark.parametrize(
    ("side", "inside"), [(0, np.s_[:, :20]), (1, np.s_[:15]), (2, np.s_[:, -20:]), (3, np.s_[-15:])]
)
def test_texture_is_lost_on_the_side_that_was_asked(side, inside):
    noise = perturbations.generate_noise(60, 80, np.random.default_rng(0))
    flat = perturbations.remove_texture(noise, 0.25, side)
    changed = (flat != noise).any(2)
    assert changed[inside].mean() > 0.95 and changed.sum() == changed[inside].sum()


def test_a_patch_is_pasted_also_over_the_edge():
    black, white = np.zeros((20, 30, 3), np.uint8), np.full((8, 8, 3), 255, np.uint8)
    whole = np.ones((8, 8), np.float32)
    assert (perturbations.paste_patch(black, white, whole, -4, 16)[..., 0] > 0).sum() == 4 * 4
    assert np.array_equal(perturbations.paste_patch(black, white, whole, 30, 0), black)
    assert perturbations.make_ellipse_mask(200, 300).mean() == pytest.approx(np.pi / 4, abs=0.05)
    assert np.array_equal(
        *np.split(
            perturbations.repeat_left_half(perturbations.generate_noise(4, 8, np.random.default_rng(0))), 2, axis=1
        )
    )
