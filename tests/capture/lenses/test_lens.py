"""Rays to pixels and back, by every lens model; OpenCV says what is right."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.capture import lenses
from splatnode.capture.frame import Intrinsics
from splatnode.capture.lenses import project, unproject

OPENCV = Intrinsics(640, 480, 500, 510, 322, 238, "calibration", (-0.2, 0.05, 0.001, -0.002, 0.01))
FISHEYE = Intrinsics(640, 480, 210, 212, 322, 238, "calibration", (0.03, -0.01, 0.002, -0.0005), "fisheye")

SKEWED = replace(OPENCV, skew=0.07)


def rays(most_deg: float) -> np.ndarray:
    """(M, 3) of unit length, up to so far from the axis."""
    angle, around = np.meshgrid(np.radians(np.linspace(0, most_deg, 9)), np.linspace(0, 6, 7))
    parts = np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)
    return np.stack(parts, -1).reshape(-1, 3)


@pytest.mark.parametrize(
    ("lens", "most_deg"), [(OPENCV, 35), (SKEWED, 35), (FISHEYE, 100)], ids=["opencv", "skew", "fisheye"]
)
def test_there_and_back(lens, most_deg):
    given = rays(most_deg)
    pixels = project(5.0 * given, lens)
    assert np.isfinite(pixels).all() and np.allclose(unproject(pixels, lens), given, atol=1e-6)


def test_a_skew_moves_rows_across_after_the_distortion():
    given = rays(35)
    plain = project(given, OPENCV)
    y_distorted = (plain[:, 1] - OPENCV.cy) / OPENCV.fy
    moved = plain + np.column_stack([OPENCV.fx * 0.07 * y_distorted, np.zeros(len(plain))])
    assert np.allclose(project(given, SKEWED), moved, atol=1e-9)
    pinhole = replace(SKEWED, distortion=())
    by_K = given @ pinhole.K.T
    assert np.allclose(project(given, pinhole), by_K[:, :2] / by_K[:, 2:], atol=1e-9)


def test_a_fisheye_is_that_of_opencv():
    given = rays(80)
    K = FISHEYE.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    expected, _ = cv2.fisheye.projectPoints(
        given[:, None] / given[:, None, 2:], np.zeros(3), np.zeros(3), K, np.array(FISHEYE.distortion)
    )
    assert np.allclose(project(given, FISHEYE), expected[:, 0] + 0.5, atol=1e-6)


def test_a_pinhole_does_not_see_what_is_behind_it_and_a_fisheye_does():
    behind = np.array([[1.0, 0.0, -0.1]])
    assert np.isnan(project(behind, OPENCV)).all()
    assert project(behind, FISHEYE)[0, 0] > FISHEYE.cx + 210 * math.radians(90)


def test_terms_that_turn_back_end_where_they_do():
    turning = Intrinsics(640, 480, 200, 200, 320, 240, "given", (-0.25,), "fisheye")  # 1 - 0.75 t^2 = 0
    assert abs(lenses.largest_angle(turning) - math.sqrt(1 / 0.75)) < 1e-9
    assert np.isnan(project(np.array([[1.0, 0.0, 0.1]]), turning)).all()
    assert np.isnan(unproject(np.array([[639.0, 240.0]]), turning)).all()
    assert lenses.largest_angle(FISHEYE) > math.radians(100)


def test_shapes_are_told():
    with pytest.raises(ValueError, match=r"rays must be \(M, 3\), got \(3,\)"):
        project(np.zeros(3), OPENCV)
    with pytest.raises(ValueError, match=r"pixels must be \(M, 2\), got \(1, 3\)"):
        unproject(np.zeros((1, 3)), OPENCV)
