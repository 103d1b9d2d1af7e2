"""Calibrated lenses are taken out of frames before anything is computed from them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.lenses import is_resampled, project, undistort_frame, unproject

WIDTH, HEIGHT = 320, 240


def dots(given: Intrinsics) -> tuple[Frame, np.ndarray]:
    """A frame with white dots where `given` sees points at depth 1, and these points (M, 2)."""
    points = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-0.3, 0.3, 5)), -1).reshape(-1, 2)
    K = given.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV's pixel centres
    at_depth_1 = np.column_stack([points, np.ones(len(points))])
    pixels, _ = cv2.projectPoints(
        at_depth_1, np.zeros(3), np.zeros(3), K, np.array((*given.distortion, 0, 0, 0, 0)[:4], float)
    )
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    for x, y in pixels[:, 0]:
        image[np.hypot(columns - x, rows - y) < 3.0] = 255
    return Frame(0, "a.png", 0, image, given), points


def centres(image: np.ndarray) -> np.ndarray:
    """(M, 2) of white dots, the top-left pixel's centre at (0.5, 0.5)."""
    return cv2.connectedComponentsWithStats((image[..., 0] > 127).astype(np.uint8))[3][1:] + 0.5


@pytest.mark.parametrize(
    "given",
    [
        Intrinsics(WIDTH, HEIGHT, 300.0, 300.0, 160.0, 120.0, "given", (-0.2, 0.05, 0.001, -0.002)),
        Intrinsics(WIDTH, HEIGHT, 300.0, 300.0, 150.0, 125.0, "given", (0.15,)),
        Intrinsics(WIDTH, HEIGHT, 320.0, 260.0, 160.0, 120.0, "calibration"),
        Intrinsics(2 * WIDTH, 2 * HEIGHT, 640.0, 520.0, 320.0, 240.0, "calibration"),  # of the frame at twice its size
    ],
)
def test_points_are_where_the_pinhole_says(given: Intrinsics):
    frame, points = dots(given.resized(WIDTH, HEIGHT))
    frame = Frame(0, "a.png", 0, frame.image, given)
    straight = undistort_frame(frame)
    pinhole = straight.intrinsics
    assert pinhole is not None and pinhole.fx == pinhole.fy and not pinhole.distortion
    assert (pinhole.width, pinhole.height) == (WIDTH, HEIGHT) == (straight.width, straight.height)
    assert pinhole.source == given.source
    expected = points * pinhole.fx + (pinhole.cx, pinhole.cy)
    inside = ((expected > 6) & (expected < (WIDTH - 6, HEIGHT - 6))).all(1)
    found = centres(straight.image)
    nearest = np.linalg.norm(found[:, None] - expected[inside], axis=2).min(0)
    assert inside.sum() >= 9
    assert nearest.max() < 0.6  # a dot's centre moves a little when its shape is stretched


def smooth(pixels: np.ndarray) -> np.ndarray:
    """(..., 3) uint8 colours of waves at pixels (..., 2) of the pinhole UPRIGHT."""
    x, y = (pixels - (WIDTH / 2, HEIGHT / 2))[..., 0] / 9.0, (pixels - (WIDTH / 2, HEIGHT / 2))[..., 1] / 11.0
    waves = np.stack([np.sin(x), np.cos(y), np.sin(x + y)], -1)
    return (128 + 90 * waves).round().astype(np.uint8)


UPRIGHT = Intrinsics(WIDTH, HEIGHT, 300.0, 300.0, 150.0, 125.0, "estimated")


def shown_by(lens: Intrinsics) -> Frame:
    """The waves as `lens` sees them; UPRIGHT sees them as they are."""
    pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1).reshape(-1, 2)
    image = smooth(project(unproject(pixels, lens), UPRIGHT)).reshape(HEIGHT, WIDTH, 3)
    return Frame(0, "a.png", 0, image, lens)


def sheared_by_hand(skew: float) -> Frame:
    """The waves, sheared: each row is moved by as many pixels as the skew moves it, whatever the lens models say."""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    image = smooth(np.stack([columns - skew * (rows - UPRIGHT.cy), rows], -1))
    return Frame(0, "a.png", 0, image, replace(UPRIGHT, skew=skew))


@pytest.mark.parametrize(
    "frame",
    [
        sheared_by_hand(0.05),
        sheared_by_hand(-0.05),
        shown_by(replace(UPRIGHT, skew=0.05, fy=320.0)),
        shown_by(replace(UPRIGHT, skew=0.05, distortion=(-0.15, 0.02, 0.001, 0.0))),
    ],
    ids=["sheared", "other way", "and tall pixels", "and bent"],
)
def test_a_sheared_picture_becomes_upright(frame):
    assert is_resampled(frame)
    straight = undistort_frame(frame)
    pinhole = straight.intrinsics
    assert pinhole is not None and pinhole.fx == pinhole.fy
    assert (pinhole.skew, pinhole.distortion, pinhole.source) == (0.0, (), "estimated")
    pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1).reshape(-1, 2)
    expected = smooth(project(unproject(pixels, pinhole), UPRIGHT)).reshape(HEIGHT, WIDTH, 3)
    off = np.abs(straight.image.astype(float) - expected)[4:-4, 4:-4]
    assert off.mean() < 0.6 and off.max() < 4
    assert np.abs(frame.image.astype(float) - expected).mean() > 10  # it was sheared


def test_no_corner_of_a_sheared_picture_is_invented():
    lens = replace(UPRIGHT, skew=0.05)
    pinhole = undistort_frame(sheared_by_hand(0.05)).intrinsics
    assert pinhole is not None and pinhole.fx < 1.1 * UPRIGHT.fx
    corners = np.array([[0.0, 0.0], [WIDTH, 0.0], [0.0, HEIGHT], [WIDTH, HEIGHT]])
    there = project(unproject(corners, pinhole), lens)
    assert (there > -0.01).all() and (there < np.array([WIDTH, HEIGHT]) + 0.01).all()


def test_a_mask_goes_with_a_sheared_picture():
    used = np.ones((HEIGHT, WIDTH), bool)
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    used[columns - 0.05 * (rows - UPRIGHT.cy) < UPRIGHT.cx] = False  # left of an upright line, before the shear
    straight = undistort_frame(replace(sheared_by_hand(0.05), mask=used))
    assert straight.mask is not None and straight.intrinsics is not None
    line = straight.intrinsics.cx
    assert not straight.mask[:, : round(line) - 2].any() and straight.mask[:, round(line) + 3 :].all()


def test_a_skew_that_leaves_no_rectangle_is_named():
    lens = Intrinsics(HEIGHT, WIDTH, 300.0, 300.0, HEIGHT / 2, WIDTH / 2, "estimated", skew=0.9)
    with pytest.raises(ValueError, match="a.png: without its skew of 0.9 the picture of 240 x 320 pixels has no"):
        undistort_frame(Frame(0, "a.png", 0, np.zeros((WIDTH, HEIGHT, 3), np.uint8), lens))


def test_no_corner_is_invented():
    given = Intrinsics(WIDTH, HEIGHT, 300.0, 300.0, 160.0, 120.0, "given", (0.2, 0.0, 0.0, 0.0))
    grey = Frame(0, "a.png", 0, np.full((HEIGHT, WIDTH, 3), 90, np.uint8), given)
    assert (undistort_frame(grey).image == 90).all()
    pinhole = undistort_frame(grey).intrinsics
    assert pinhole is not None
    corner = np.array([-pinhole.cx / pinhole.fx, -pinhole.cy / pinhole.fy])
    distorted = corner * (1 + 0.2 * (corner**2).sum()) * 300.0 + (160.0, 120.0)
    assert (distorted >= -0.01).all()


def test_what_is_straight_stays_as_it_is():
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    unknown = Frame(0, "a.png", 0, image, None)
    assert undistort_frame(unknown) is unknown
    pinhole = Frame(0, "a.png", 0, image, Intrinsics(WIDTH, HEIGHT, 300.0, 300.0, 160.0, 120.0, "exif"))
    assert undistort_frame(pinhole) is pinhole


def test_coefficients_that_cannot_be_are_named():
    given = Intrinsics(WIDTH, HEIGHT, 200.0, 200.0, 160.0, 120.0, "given", (-2.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="a.png.*alibrat"):
        undistort_frame(Frame(0, "a.png", 0, np.zeros((HEIGHT, WIDTH, 3), np.uint8), given))
