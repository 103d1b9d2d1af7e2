"""The rim of undistorted photographs is told from what is dark in the scene."""

import numpy as np
import pytest

from splatnode.capture.frame import Frame
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import prepare
from splatnode.recon.keyframes import find_picture, mask_bars, valid_masks, valid_rectangle

HEIGHT, WIDTH = 80, 120


def photographs(count: int = 3, seed: int = 0) -> list[np.ndarray]:
    """Bright noise with another dark square in each, at the left border."""
    generator = np.random.default_rng(seed)
    images = [generator.integers(120, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(count)]
    for index, image in enumerate(images):
        image[20 * index : 20 * index + 10, :10] = 0
    return images


def test_photographs_without_a_rim_show_the_scene_everywhere():
    assert all(mask.all() for mask in valid_masks(photographs()))


def test_a_rim_and_a_pixel_beside_it_are_left_out_in_all_photographs_of_a_size():
    images = photographs()
    for image in images:
        image[:2], image[:, -1:] = 0, 20
        image[-1, :50] = 60  # the last row's rim is narrower than a pixel, and ends
    expected = np.ones((HEIGHT, WIDTH), bool)
    expected[:3], expected[:, -2:], expected[-2:, :51] = False, False, False
    for mask in valid_masks([*images, np.full((50, 50, 3), 200, np.uint8)])[:3]:
        np.testing.assert_array_equal(mask, expected)


def test_what_is_dark_here_and_there_is_no_rim():
    images = photographs()
    for image in images:
        image[:2, 10:20] = 0
    assert all(mask.all() for mask in valid_masks(images))


def test_a_dark_scene_has_no_rim():
    images = photographs()
    for image in images:
        image[:, :20] = 0
    assert all(mask.all() for mask in valid_masks(images))


def test_one_photograph_does_not_tell_a_rim_from_the_scene():
    (image,) = photographs(1)
    image[:2] = 0
    assert valid_masks([image])[0].all()


def test_a_photograph_is_cut_down_to_what_shows_the_scene():
    mask = np.ones((HEIGHT, WIDTH), bool)
    assert valid_rectangle(mask) == (slice(0, HEIGHT), slice(0, WIDTH))
    mask[:2], mask[:, -1], mask[-1, :5] = False, False, False
    assert valid_rectangle(mask) == (slice(2, HEIGHT - 1), slice(0, WIDTH - 1))


def in_bars(rows: slice, columns: slice, level: int = 6) -> np.ndarray:
    """Bright noise between bars that compression has made not quite black."""
    generator = np.random.default_rng(1)
    image = generator.integers(0, level + 1, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[rows, columns] = generator.integers(60, 255, image[rows, columns].shape, dtype=np.uint8)
    return image


@pytest.mark.parametrize(
    ("rows", "columns"),
    [
        (slice(10, 70), slice(0, WIDTH)),  # a wide film
        (slice(0, HEIGHT), slice(16, 104)),  # an upright one
        (slice(10, 70), slice(15, 105)),  # shrunk
        (slice(10, 71), slice(0, WIDTH)),  # bars that differ by a row
    ],
)
def test_a_picture_is_found_between_black_bars(rows, columns):
    assert find_picture(in_bars(rows, columns)) == (rows, columns)


@pytest.mark.parametrize(
    "image",
    [
        photographs()[0],
        in_bars(slice(10, 80), slice(0, WIDTH)),  # below it nothing is black
        in_bars(slice(6, 60), slice(0, WIDTH)),  # not in the middle
        in_bars(slice(1, 79), slice(0, WIDTH)),  # no wider than a rim
        in_bars(slice(35, 45), slice(0, WIDTH)),  # hardly a picture
        in_bars(slice(10, 70), slice(0, WIDTH), level=40),  # grey
        in_bars(slice(0, 0), slice(0, 0)),  # all black
    ],
)
def test_what_is_black_elsewhere_is_no_bar(image):
    assert find_picture(image) is None


def test_a_bright_thing_before_a_black_wall_is_no_picture_between_bars():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    ball = np.hypot(y - HEIGHT / 2 + 0.5, x - WIDTH / 2 + 0.5) < 25
    assert find_picture(np.where(ball[..., None], 200, 0).astype(np.uint8).repeat(3, 2)) is None


def test_bars_are_hidden_beside_what_a_mask_hides():
    image = in_bars(slice(10, 70), slice(0, WIDTH))
    given = np.ones((HEIGHT, WIDTH), bool)
    given[20:30, 40:50] = False
    frame = mask_bars(Frame(0, "a.png", 0, image, None, mask=given))
    expected = given.copy()
    expected[:10], expected[70:] = False, False
    assert frame.mask is not None
    np.testing.assert_array_equal(frame.mask, expected)
    whole = Frame(0, "b.png", 0, photographs()[0], None)
    assert mask_bars(whole) is whole


def test_no_feature_and_no_colour_of_a_keyframe_is_of_a_bar():
    keyframe = prepare(Frame(0, "a.png", 0, in_bars(slice(20, 60), slice(0, WIDTH)), None), ReconstructionConfig())
    assert keyframe.mask is not None and not keyframe.mask[:20].any() and keyframe.mask[20:60].all()
    assert len(keyframe.features.points) > 5
    assert (keyframe.features.points[:, 1] > 20).all() and (keyframe.features.points[:, 1] < 60).all()
