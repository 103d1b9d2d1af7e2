"""Where the viewer looks from: orbits, drags, overviews, tours."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.viewer.state import Viewpoint, first_view, look_at, orbit, overview, pan, project, zoom
from tests.viewer.test_scene import K, camera, moment, wall

UP = np.array([0.0, -1.0, 0.0])


def viewpoint(distance: float = 1.0) -> Viewpoint:
    """At the world's origin, looking along z, with the lens of `camera`."""
    return Viewpoint(np.eye(4), distance, UP, (K, 100.0, 80.0))


def test_looking_at_something_puts_it_in_the_middle_and_up_up():
    T = look_at(np.array([1.0, -2.0, 3.0]), np.array([0.0, 0.0, 1.0]), UP)
    assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3)) and np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    local = np.linalg.inv(T) @ np.array([0.0, 0.0, 1.0, 1.0])
    assert np.allclose(local[:2], 0, atol=1e-12) and local[2] > 0
    assert T[:3, 1] @ UP < 0  # the image's y axis points down
    straight_down = look_at(np.array([0.0, -5.0, 0.0]), np.zeros(3), UP)
    assert np.isfinite(straight_down).all()


def test_an_orbit_keeps_the_pivot_and_its_distance():
    view = viewpoint(2.0)
    right = orbit(view, np.radians(90), 0.0)
    assert np.allclose(right.pivot, view.pivot) and np.allclose(right.T_world_camera[:3, 3], [2.0, 0.0, 2.0])
    above = orbit(view, 0.0, np.radians(30))
    assert np.allclose(above.T_world_camera[:3, 3], [0.0, -1.0, 2.0 - np.sqrt(3.0)])
    highest = orbit(view, 0.0, np.radians(170))
    assert np.degrees(np.arcsin(-highest.T_world_camera[1, 3] / 2.0)) == pytest.approx(85.0)


def test_what_is_dragged_stays_under_the_pointer():
    view = viewpoint(1.0)
    focal = float(view.K(100, 80)[0, 0])
    before = project(view.pivot[None], view, 100, 80)[0]
    after = project(view.pivot[None], pan(view, 10.0, -4.0, focal), 100, 80)[0]
    assert np.allclose(after[:2] - before[:2], [10.0, -4.0])


def test_zooming_goes_to_the_pivot():
    near = zoom(viewpoint(2.0), 0.25)
    assert np.allclose(near.pivot, [0, 0, 2.0]) and np.allclose(near.T_world_camera[:3, 3], [0, 0, 1.5])
    assert zoom(near, 0.0).distance > 0


def test_the_lens_fits_into_every_window():
    for width, height, scale in ((200, 160, 2.0), (400, 160, 2.0), (100, 400, 1.0)):
        fitted = viewpoint().K(width, height)
        corners = np.array([[0, 0], [100, 80]]) * scale + [fitted[0, 2] - 50 * scale, fitted[1, 2] - 40 * scale]
        assert fitted[0, 0] == pytest.approx(100 * scale)
        assert (corners >= 0).all() and (corners <= [width, height]).all()


def test_the_overview_shows_all_cameras():
    there = moment(wall(), camera(-0.3), camera(0.0, frame_id=1), camera(0.3, frame_id=2))
    centres = np.array([one.T_world_camera[:3, 3] for one in there.snapshot.cameras])
    pixels = project(centres, overview(there), 100, 80)
    assert (pixels[:, 2] > 0).all() and (pixels[:, :2] > 0).all() and (pixels[:, :2] < [100, 80]).all()
    aside = np.array([1.5, 0.0, 0.3])
    assert (np.abs(project(aside[None], overview(there), 100, 80)[0, :2] - [50, 40]) > [50, 40]).any()
    wider = project(np.array([aside, *centres]), overview(there, [aside]), 100, 80)
    assert (wider[:, :2] > 0).all() and (wider[:, :2] < [100, 80]).all()


def test_the_first_view_is_a_photographed_one():
    cameras = camera(-0.3), camera(0.05, frame_id=1), camera(0.3, frame_id=2)
    view = first_view(moment(wall(), *cameras))
    assert np.array_equal(view.T_world_camera, cameras[1].T_world_camera)
    assert view.pivot[2] == pytest.approx(1.0, abs=0.05)  # orbits go around the wall
    for bare in (moment(wall()), moment(GaussianArrays.empty())):
        assert np.array_equal(first_view(bare).T_world_camera, overview(bare).T_world_camera)
