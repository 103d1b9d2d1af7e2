"""A fisheye's picture is brought into the pinhole that holds it; what it did not see is masked, not invented."""

import math

import numpy as np
import pytest

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.lenses import MOST_DEG, project, undistort_frame, unproject

WIDTH, HEIGHT = 640, 480


def equidistant(across_deg: float, terms: tuple[float, ...] = ()) -> Intrinsics:
    focal = WIDTH / math.radians(across_deg)
    return Intrinsics(WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, "calibration", terms, "fisheye")


def seen(lens: Intrinsics) -> Frame:
    """A frame in which each pixel's colour says its ray: red and green grow with its slopes."""
    pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1).reshape(-1, 2)
    rays = unproject(pixels, lens)
    colours = np.full((len(rays), 3), 128.0)
    colours[:, :2] += 100 * rays[:, :2]
    image = np.nan_to_num(colours).reshape(HEIGHT, WIDTH, 3).round().astype(np.uint8)
    return Frame(0, "a.png", 0, image, lens)


@pytest.mark.parametrize("across_deg", [120.0, 170.0])
def test_a_pixel_of_the_pinhole_shows_its_ray(across_deg):
    frame = undistort_frame(seen(equidistant(across_deg)))
    pinhole = frame.intrinsics
    assert pinhole is not None and pinhole.model == "opencv" and pinhole.fx == pinhole.fy and not pinhole.distortion
    assert (frame.width, frame.height) == (pinhole.width, pinhole.height)
    assert abs(frame.width * frame.height / (WIDTH * HEIGHT) - 1) < 0.01
    pixels = np.stack(np.meshgrid(np.arange(frame.width) + 0.5, np.arange(frame.height) + 0.5), -1).reshape(-1, 2)
    rays = unproject(pixels, pinhole)
    shown = (frame.image.reshape(-1, 3)[:, :2].astype(float) - 128) / 100
    assert np.abs(shown - rays[:, :2]).max() < 0.03
    half = math.degrees(math.atan(pinhole.cx / pinhole.fx))
    assert abs(half - min(across_deg / 2, MOST_DEG)) < 0.2
    assert frame.mask is None


def test_the_pinhole_of_120_degrees_keeps_what_the_fisheye_has_up_and_down():
    pinhole = undistort_frame(seen(equidistant(120.0))).intrinsics
    assert pinhole is not None and abs(math.degrees(math.atan(pinhole.cy / pinhole.fy)) - 45.0) < 0.2


def test_what_the_fisheye_did_not_see_is_masked():
    lens = Intrinsics(WIDTH, HEIGHT, 240, 240, WIDTH / 2, HEIGHT / 2, "given", (0.8,), "fisheye")  # a pincushion
    frame = undistort_frame(seen(lens))
    assert frame.mask is not None and 0.5 < frame.mask.mean() < 1 and not frame.mask[0, 0]
    pixels = np.stack(np.meshgrid(np.arange(frame.width) + 0.5, np.arange(frame.height) + 0.5), -1).reshape(-1, 2)
    assert frame.intrinsics is not None
    there = project(unproject(pixels, frame.intrinsics), lens)
    inside = ((there > 0) & (there < (WIDTH, HEIGHT))).all(1).reshape(frame.mask.shape)
    assert (inside == frame.mask).mean() > 0.999


def test_a_mask_goes_with_its_photograph():
    plain = seen(equidistant(120.0))
    used = np.ones((HEIGHT, WIDTH), bool)
    used[:, : WIDTH // 2] = False
    frame = undistort_frame(Frame(0, "a.png", 0, plain.image, plain.intrinsics, mask=used))
    assert frame.mask is not None
    assert not frame.mask[:, : frame.width // 2 - 1].any() and frame.mask[:, frame.width // 2 + 2 :].all()


@pytest.mark.parametrize(
    ("lens", "said"),
    [
        (equidistant(120.0, (-0.4,)), "turn back 52 degrees.*Calibrate"),
        (Intrinsics(WIDTH, HEIGHT, 300, 300, -20, 240, "given", (), "fisheye"), "principal point"),
    ],
    ids=["turns back", "off the picture"],
)
def test_what_no_fisheye_can_be_is_one_sentence(lens, said):
    with pytest.raises(ValueError, match=f"a.png: .*{said}"):
        undistort_frame(Frame(0, "a.png", 0, np.zeros((HEIGHT, WIDTH, 3), np.uint8), lens))
