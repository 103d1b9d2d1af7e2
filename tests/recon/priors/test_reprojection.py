"""Points of one view in another: cases worked out by hand, and a general pair of cameras against NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.recon import priors
from splatnode.recon.priors import Pointmap

WIDTH, HEIGHT, FOCAL = 6, 4, 4.0


def view(depth: float = 2.0, x: float = 0.0, focal: float = FOCAL) -> Pointmap:
    """A plane `depth` before a camera at (x, 0, 0) that looks along z."""
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = x
    return Pointmap(
        name="view",
        frame_id=0,
        depth=np.full((HEIGHT, WIDTH), depth, np.float32),
        confidence=np.ones((HEIGHT, WIDTH), np.float32),
        normal=np.zeros((HEIGHT, WIDTH, 3), np.float32),
        T_world_camera=T_world_camera,
        K=np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]]),
    )


def grey(value: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), value, np.uint8)


def test_points_move_by_their_parallax():
    # focal * baseline / depth = 4 * 0.5 / 2 = 1 pixel to the left.
    depth, footprint = priors.project_nearest(view(), view(x=0.5))
    assert (depth[:, :-1] == 2).all() and np.isinf(depth[:, -1]).all()
    np.testing.assert_allclose(footprint[:, :-1], 2 / FOCAL)
    assert np.isinf(footprint[:, -1]).all()


def test_the_nearest_of_several_points_counts_with_its_own_footprint():
    source = view(4.0, focal=2 * FOCAL)
    source.depth[1, 3] = 1.0
    depth, footprint = priors.project_nearest(source, view())
    # Twice the focal length: two columns and rows of the source fall into one of the target.
    assert depth[1, 3] == 1.0 and footprint[1, 3] == pytest.approx(1.0 / (2 * FOCAL))
    assert depth[2, 3] == 4.0 and footprint[2, 3] == pytest.approx(4.0 / (2 * FOCAL))


def test_what_is_behind_the_camera_or_unknown_falls_nowhere():
    behind = view()
    behind.T_world_camera[2, 3] = -5.0
    assert np.isinf(priors.project_nearest(behind, view())[0]).all()
    nothing = view()
    nothing.depth[:] = 0
    assert np.isinf(priors.project_nearest(nothing, view())[0]).all()


def test_a_point_explains_a_pixel_of_its_colour_in_every_channel():
    falls, alike = priors.find_explained(view(), grey(100), view(x=0.5), grey(110), colour_tolerance=10 / 255 + 1e-6)
    expected = np.ones((HEIGHT, WIDTH), bool)
    expected[:, -1] = False
    assert falls.tolist() == expected.tolist() and alike.tolist() == expected.tolist()
    tinted = grey(100)
    tinted[..., 2] = 121
    falls, alike = priors.find_explained(view(), tinted, view(x=0.5), grey(110), colour_tolerance=10 / 255 + 1e-6)
    assert falls.tolist() == expected.tolist() and not alike.any()


def test_one_of_several_points_that_fall_together_may_explain():
    source = view(focal=2 * FOCAL)
    image = grey(200)
    image[::2, [0, 2, 4, 5]] = 50  # columns 0, 1 2, 3 4 and 5 fall into a column each, and the rows in pairs
    falls, alike = priors.find_explained(source, image, view(), grey(50), colour_tolerance=0.0)
    assert falls.any() and alike.tolist() == falls.tolist()


def test_a_point_hides_what_lies_behind_it_by_more_than_the_margin():
    target = view(2.0)
    target.depth[:, :3] = 0  # unknown: nothing there to hide
    for depth, hides in ((1.9, True), (1.98, False), (2.5, False)):
        hiding = priors.find_hiding(view(depth), target, tolerance=0.03)
        assert not hiding[:, :3].any() and hiding[:, 3:].all() == hides and hiding[:, 3:].any() == hides


def test_a_general_pair_of_cameras_agrees_with_numpy():
    random = np.random.default_rng(0)
    source, target = view(focal=5.0), view()
    source = replace(source, depth=random.uniform(1, 4, (HEIGHT, WIDTH)).astype(np.float32))
    source.T_world_camera[:3, :3] = Rotation.from_euler("xyz", [8, -11, 5], degrees=True).as_matrix()
    source.T_world_camera[:3, 3] = 0.3, -0.2, 0.1
    expected = np.full((HEIGHT, WIDTH), np.inf)
    in_target = source.points.reshape(-1, 3) @ np.linalg.inv(target.T_world_camera)[:3, :3].T @ target.K.T
    for x, y, z in in_target:
        column, row = int(np.floor(x / z)), int(np.floor(y / z))
        if 0 <= column < WIDTH and 0 <= row < HEIGHT:
            expected[row, column] = min(expected[row, column], z)
    assert np.isfinite(expected).sum() > 5
    np.testing.assert_allclose(priors.project_nearest(source, target)[0], expected, rtol=1e-5)
