"""The turntable: inside the arc that was photographed, above the ground."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.viewer.cli import compute_arc, turntable_views
from splatnode.viewer.shapes import ground
from splatnode.viewer.state import Viewpoint, overview
from tests.viewer.test_scene import UP, camera, moment, wall


def angles(centre, view: Viewpoint) -> tuple[float, float]:
    """Around the view's up, from the world's -z, and above the level."""
    offset, level = centre - view.pivot, np.array([0.0, 0.0, -1.0])
    level = level - (level @ view.up) * view.up
    side = np.cross(view.up, level)
    return np.arctan2(offset @ side, offset @ level), np.arcsin(offset @ view.up / np.linalg.norm(offset))


def test_the_arc_is_where_the_cameras_were():
    cameras = camera(-0.5, -0.1), camera(0.0, frame_id=1), camera(0.5, 0.1, frame_id=2)
    arc = compute_arc(cameras, np.array([0.0, 0.0, 1.0]), UP)
    assert arc.azimuths == pytest.approx((-np.arctan(0.5), np.arctan(0.5)))
    assert arc.elevations[0] < 0 < arc.elevations[1] and arc.distance == pytest.approx(np.sqrt(1.26))


def test_the_tour_stays_inside_the_arc():
    cameras = camera(-0.3, -0.05), camera(0.0, frame_id=1), camera(0.3, -0.2, frame_id=2)
    there = moment(wall(), *cameras)
    tour = turntable_views(there, 24)
    whole = overview(there)
    seen = np.array([angles(one.T_world_camera[:3, 3], whole) for one in cameras])
    shown = np.array([angles(view.T_world_camera[:3, 3], whole) for view in tour])
    assert (shown.min(0) >= seen.min(0) - 1e-9).all() and (shown.max(0) <= seen.max(0) + 1e-9).all()
    assert np.ptp(shown[:, 0]) == pytest.approx(np.ptp(seen[:, 0]))  # all of it
    assert len(tour) == 24 and all(np.allclose(view.pivot, whole.pivot) for view in tour)


def test_the_tour_stays_above_the_ground():
    low = [camera(x, 0.8, frame_id=i, target=(x, 0.8, 1.0)) for i, x in enumerate((-0.3, 0.3))]
    there = moment(wall(), *low)  # y points down, and the wall ends at 0.3
    below = ground(there)
    assert below.height(low[0].T_world_camera[:3, 3]) < 0.0
    assert all(below.height(view.T_world_camera[:3, 3]) > 0.0 for view in turntable_views(there, 12))


def test_a_scene_with_little_known_has_a_tour_too():
    for bare in (moment(wall()), moment(GaussianArrays.empty()), moment(wall(), camera(0.0))):
        views = turntable_views(bare, 3)
        assert all(np.isfinite(view.T_world_camera).all() for view in views)
    alone = [view.T_world_camera[:3, 3] for view in turntable_views(moment(wall(), camera(0.0)), 8)]
    assert 0.05 < np.ptp(alone, axis=0)[0] < 0.5  # a small swing
