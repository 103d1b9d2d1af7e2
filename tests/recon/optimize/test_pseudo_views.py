from __future__ import annotations

import cv2
import numpy as np
import pytest

from splatnode.recon.optimize.regularizers import interpolate, order_cameras, pseudo_views


def camera(x: float, yaw_deg: float = 0.0) -> np.ndarray:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = cv2.Rodrigues(np.array([0.0, np.radians(yaw_deg), 0.0]))[0]
    T_world_camera[0, 3] = x
    return T_world_camera


def test_half_way_of_a_turn_on_a_circle_is_on_the_circle():
    """A camera that orbits the origin at distance 2 by 60 degrees: the screw motion is that orbit."""
    orbit = [camera(0.0, yaw) for yaw in (0.0, 30.0, 60.0)]
    for T_world_camera in orbit:
        T_world_camera[:3, 3] = -2.0 * T_world_camera[:3, 2]
    np.testing.assert_allclose(interpolate(orbit[0], orbit[2], 0.5), orbit[1], atol=1e-9)
    np.testing.assert_allclose(interpolate(orbit[0], orbit[2], 0.0), orbit[0], atol=1e-9)
    np.testing.assert_allclose(interpolate(orbit[0], orbit[2], 1.0), orbit[2], atol=1e-9)


def test_the_path_visits_cameras_in_the_order_of_their_places():
    assert order_cameras([camera(x) for x in (2.0, 0.0, 3.0, 1.0)]) in ([1, 3, 0, 2], [2, 0, 3, 1])


def test_pseudo_views_lie_between_their_neighbours_and_beside_the_path():
    cameras = [camera(0.0), camera(1.0), camera(3.0)]
    Ks = [np.diag([100.0 + i, 100.0 + i, 1.0]) for i in range(3)]
    sizes = [(64, 48)] * 3
    views = pseudo_views(cameras, Ks, sizes, 40, off_path=0.2, rng=np.random.default_rng(0))
    centres = np.array([view.T_world_camera[:3, 3] for view in views])
    gaps = np.where(centres[:, 0] < 1.0, 1.0, 2.0)
    assert ((centres[:, 0] > 0.0) & (centres[:, 0] < 3.0)).all() and np.ptp(centres[:, 0]) > 1.5
    assert (np.abs(centres[:, 1]) <= 0.2 * gaps).all() and np.abs(centres[:, 1]).max() > 0.1
    assert np.abs(centres[:, 2]).max() < 1e-12
    assert all(view.K is Ks[view.nearest] and (view.width, view.height) == (64, 48) for view in views)
    on_path = pseudo_views(cameras, Ks, sizes, 5, off_path=0.0, rng=np.random.default_rng(0))
    assert all(abs(view.T_world_camera[1, 3]) < 1e-12 for view in on_path)


def test_the_nearest_training_view_is_the_one_that_it_stands_nearest_to():
    """Its K and size are taken from that view, and the semantic loss compares with it."""
    cameras, sizes = [camera(0.0), camera(1.0)], [(64, 48), (32, 24)]
    Ks = [np.diag([100.0, 100.0, 1.0]), np.diag([50.0, 50.0, 1.0])]
    views = pseudo_views(cameras, Ks, sizes, 40, off_path=0.0, rng=np.random.default_rng(0))
    assert {view.nearest for view in views} == {0, 1}
    assert all(view.nearest == int(view.T_world_camera[0, 3] > 0.5) for view in views)
    assert all((view.width, view.height) == sizes[view.nearest] for view in views)


def test_one_camera_has_no_neighbours():
    with pytest.raises(ValueError, match="at least 2"):
        pseudo_views([camera(0.0)], [np.eye(3)], [(8, 8)], 1, off_path=0.0, rng=np.random.default_rng(0))
