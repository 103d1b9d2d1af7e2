"""Measuring: which point of the scene a click means, and how far two are apart."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.result.verdict import RELATIVE, Scale
from splatnode.viewer.session import Session
from splatnode.viewer.shapes import add_point, measurement_lines, measurement_shapes, paint_coarsely, surface_point
from splatnode.viewer.sources import FixedSource
from splatnode.viewer.state import ViewerState, empty_canvas, project
from tests.viewer.test_scene import camera, moment, wall
from tests.viewer.test_viewpoint import viewpoint

SIZE = 200, 160


def test_a_click_means_the_surface_that_is_seen_there():
    view = viewpoint()
    canvas = paint_coarsely(wall(), view, ViewerState(), SIZE, 1)
    for there in ([0.1, -0.05, 1.0], [-0.2, 0.2, 1.0]):
        x, y, _ = project(np.array([there]), view, *SIZE)[0]
        assert surface_point(canvas, view, x, y) == pytest.approx(there, abs=0.01)
    assert surface_point(canvas, view, 2, 2) is None and surface_point(canvas, view, -9, 500) is None
    assert surface_point(empty_canvas(*SIZE), view, 100, 80) is None


def test_two_points_are_measured_and_a_third_begins_anew():
    points = add_point(add_point((), np.zeros(3)), np.array([0.0, 0.3, 0.4]))
    assert len(points) == 2 and len(add_point(points, np.ones(3))) == 1
    said = " ".join(measurement_lines(points, True, RELATIVE))
    assert said.startswith("0.5 relative") and "median depth" in said
    metric = Scale(True, "the distance between a.jpg and b.jpg")
    assert measurement_lines(points, True, metric) == [f"50 cm between the two points ({metric.source})."]
    assert "two points" in measurement_lines((), True, RELATIVE)[0] and measurement_lines((), False, RELATIVE) == []
    assert "second" in measurement_lines(points[:1], True, RELATIVE)[0]


def test_what_is_measured_stands_in_the_scene():
    eye = np.array([0.0, 0.0, -1.0])
    assert measurement_shapes((), eye, RELATIVE).lines == ()
    one = measurement_shapes((np.zeros(3),), eye, RELATIVE)
    assert len(one.lines[0].ends) == 3 and not one.labels
    two = measurement_shapes((np.zeros(3), np.array([0.2, 0.0, 0.0])), eye, Scale(True))
    assert len(two.lines[0].ends) == 7 and [label.text for label in two.labels] == ["20 cm"]


def test_in_a_session_clicks_measure_while_that_is_asked_for():
    session = Session(FixedSource(moment(wall(), camera(0.0), camera(0.1, frame_id=1))), ViewerState(advice=False))
    session.receive()
    session.press("d")
    here, there = np.array([-0.1, 0.0, 1.0]), np.array([0.1, 0.0, 1.0])
    for point in (here, there):
        x, y, _ = project(point[None], session.viewpoint(), *SIZE)[0]
        assert session.click(x, y, *SIZE)
    assert not session.click(1, 1, *SIZE)  # nothing is there
    assert np.linalg.norm(session.state.measured[1] - session.state.measured[0]) == pytest.approx(0.2, abs=0.01)
    assert [label.text[:3] for label in session.shapes().labels] == ["0.2"]
    session.press("d")
    assert not session.state.measured and not session.state.measuring
    session.close()
