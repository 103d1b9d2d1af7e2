"""Bounds are said in plain words, and no number is smaller than what is claimed."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatnode.recon.result.snapshot import format_camera_bounds, format_widest_bounds
from splatnode.recon.result.verdict import RELATIVE, Bounds, Scale, make_ball
from tests.support.exported import make_camera

KNOWN = Bounds(0.3, 0.03, 1.2, 0.8, make_ball(0.03))


def test_a_camera_without_a_unit_is_told_in_percent():
    assert format_camera_bounds(KNOWN, RELATIVE) == (
        "direction to 0.3 degrees, position to 1.2 % of the distance to the scene, focal length to 0.8 % (95 % bounds)"
    )


@pytest.mark.parametrize(
    ("metres", "said"), [(0.03, "3 cm"), (0.0301, "3.1 cm"), (1.5, "1.5 m"), (0.0042, "4.2 mm"), (0.0001, "0.1 mm")]
)
def test_where_the_scale_is_metric_the_position_is_a_length_too(metres, said):
    words = format_camera_bounds(replace(KNOWN, centre=metres), Scale(True, "a ruler"))
    assert f"position to 1.2 % of the distance to the scene ({said})," in words


@pytest.mark.parametrize(
    ("degrees", "said"),
    [(0.3, "0.3"), (0.301, "0.31"), (12.1, "13"), (9.99, "10"), (0.0123, "0.013"), (123.0, "130"), (0.0, "0")],
)
def test_a_bound_is_never_rounded_down(degrees, said):
    assert format_camera_bounds(replace(KNOWN, rotation_deg=degrees), RELATIVE).startswith(
        f"direction to {said} degrees"
    )


def test_of_several_cameras_the_widest_is_told():
    cameras = make_camera(0), replace(make_camera(1), bounds=replace(KNOWN, rotation_deg=0.7, centre_percent=0.1))
    words = format_widest_bounds(cameras, RELATIVE)
    assert words.startswith(
        "directions to 0.7 degrees, positions to 2 % of the distance to the scene, focal length to 1.5"
    )


def test_cameras_without_bounds_leave_nothing_to_tell():
    assert (
        format_widest_bounds((), RELATIVE)
        == format_widest_bounds((replace(make_camera(0), bounds=None),), RELATIVE)
        == ""
    )


@pytest.mark.parametrize("metric", [True, False])
@given(number=st.floats(width=64) | st.sampled_from([5e-324, 1e-320, 2.3e-308, 1.7e308, float("nan"), float("inf")]))
def test_every_number_has_words(number, metric):
    said = format_camera_bounds(Bounds(number, number, number, number, make_ball(1.0)), Scale(metric, "a ruler"))
    assert said.isprintable() and "e" not in said.split("degrees")[0].removeprefix("direction to ").replace(
        "more than", ""
    ).replace("an unknown number of", "")
    assert len(said) < 250
