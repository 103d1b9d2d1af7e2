"""The rim of undistorted photographs is told from what is dark in the scene."""

import numpy as np

from splatnode.recon.keyframes import valid_masks, valid_rectangle

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
