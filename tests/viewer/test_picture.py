"""What the viewer paints: Gaussians, points, lines, photographs, captions, and the shapes in the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.recon.result.verdict import Bounds, Scale, make_ball
from splatnode.viewer.analysis import analyse, source_colour
from splatnode.viewer.shapes import (
    ImageQuad,
    Lines,
    Shapes,
    add_caption,
    advice_lines,
    blend_image,
    ellipsoid,
    frustum,
    frustum_depth,
    image_corners,
    paint,
    paint_gaussians,
    path,
    shapes,
)
from splatnode.viewer.state import BACKGROUND, ViewerState, move_to_camera
from tests.viewer.test_scene import K, camera, moment, wall
from tests.viewer.test_viewpoint import viewpoint

NOTHING = Shapes((), ())
RED, GREEN = np.array([255, 0, 0]), np.array([0, 255, 0])


def test_gaussians_cover_the_background_and_can_be_hidden():
    image = paint(wall(half=0.2), NOTHING, viewpoint(), ViewerState(), 100, 80)
    assert image.shape == (80, 100, 3) and image.dtype == np.uint8
    assert (image[40, 50] > 150).all() and (image[2, 2] == BACKGROUND).all()
    assert (paint(wall(), NOTHING, viewpoint(), ViewerState(gaussians=False), 100, 80) == BACKGROUND).all()
    assert (paint(GaussianArrays.empty(), NOTHING, viewpoint(), ViewerState(), 100, 80) == BACKGROUND).all()


def test_points_are_squares_and_the_nearest_is_on_top():
    far, near = wall(2, depth=2.0, half=0.0), wall(2, depth=1.0, half=0.0)
    gaussians = replace(
        far,
        means=np.concatenate([far.means[:1], near.means[:1]]),
        sh=np.array([[[-2.0] * 3], [[2.0] * 3]], np.float32),
        **{name: getattr(far, name)[:2] for name in ("quats", "scales", "opacities", "source_frame")},
    )
    canvas = paint_gaussians(gaussians, np.eye(4), K, ViewerState(as_points=True, point_size=4), 100, 80)
    white = (canvas.image == 255).all(2)
    assert np.array_equal(np.argwhere(white)[[0, -1]], [[38, 48], [41, 51]]) and white.sum() == 16
    assert (canvas.depth[white] == 1.0).all() and np.isinf(canvas.depth[~white]).all()
    at_corner = replace(gaussians, means=gaussians.means + np.array([-0.5, -0.4, 0], np.float32))
    clipped = paint_gaussians(at_corner, np.eye(4), K, ViewerState(as_points=True, point_size=4), 100, 80)
    assert (clipped.image[:2, :2] == 255).all() and np.isfinite(clipped.depth).sum() > 4


def test_lines_are_bright_before_a_wall_and_dim_behind_it():
    def line(z: float) -> Shapes:
        return Shapes((Lines(np.array([[[-0.2, 0.0, z], [0.2, 0.0, z]]]), (1.0, 0.0, 0.0), 3),), ())

    gaussians = wall(half=0.4)
    before = paint(gaussians, line(0.5), viewpoint(), ViewerState(), 100, 80)
    behind = paint(gaussians, line(1.5), viewpoint(), ViewerState(), 100, 80)
    assert np.abs(before[40, 50].astype(int) - RED).max() < 30
    assert behind[40, 50, 0] < 150
    passing = Shapes((Lines(np.array([[[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]]), (1.0, 0.0, 0.0), 3),), ())
    paint(gaussians, passing, viewpoint(), ViewerState(), 100, 80)  # through the eye: no crash


def test_a_photograph_lies_where_its_rectangle_is():
    picture = np.zeros((10, 20, 3), np.uint8)
    picture[:, :10], picture[:, 10:] = RED, GREEN
    rectangle = np.array([[-0.2, -0.1, 1], [0.2, -0.1, 1], [0.2, 0.1, 1], [-0.2, 0.1, 1]])
    image = paint(
        GaussianArrays.empty(),
        Shapes((), (ImageQuad("a", rectangle, (picture,)),)),
        viewpoint(),
        ViewerState(),
        100,
        80,
    )
    assert (image[32:48, 32:48] == RED).all() and (image[32:48, 53:68] == GREEN).all()
    assert (image[:28] == BACKGROUND).all() and (image[:, :28] == BACKGROUND).all()
    hidden = ImageQuad("a", rectangle + [0, 0, 1.0], (picture,))
    assert (paint(wall(half=0.5), Shapes((), (hidden,)), viewpoint(), ViewerState(), 100, 80)[40, 40] > 150).all()


def test_a_photograph_that_is_drawn_small_does_not_flicker():
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::2] = 255
    there = moment(wall(), camera(0.0), images={"0.png": stripes})
    levels = there.photographs["0.png"]
    assert [level.shape for level in levels] == [(64, 64, 3), (32, 32, 3), (16, 16, 3)]
    assert (np.abs(levels[1].astype(int) - 128) <= 1).all() and there.num_bytes > moment(wall()).num_bytes
    rectangle = np.array([[-0.08, -0.08, 1], [0.08, -0.08, 1], [0.08, 0.08, 1], [-0.08, 0.08, 1]])
    image = paint(
        GaussianArrays.empty(), Shapes((), (ImageQuad("a", rectangle, levels),)), viewpoint(), ViewerState(), 100, 80
    )
    assert (np.abs(image[36:44, 46:54].astype(int) - 128) <= 2).all()


def test_a_photograph_covers_the_render_pixel_by_pixel():
    one = camera(0.0)
    view = move_to_camera(viewpoint(), one)
    picture = np.random.default_rng(0).integers(0, 255, (80, 100, 3), dtype=np.uint8)
    render = np.full((80, 100, 3), 100, np.uint8)
    assert np.array_equal(blend_image(render, picture, one, view.K(100, 80), 1.0), picture)
    half = blend_image(render, picture, one, view.K(100, 80), 0.5)
    assert np.abs(half - (picture / 2 + 50)).max() <= 0.5
    wide = blend_image(np.full((80, 200, 3), 7, np.uint8), picture, one, view.K(200, 80), 1.0)
    assert np.array_equal(wide[:, 50:150], picture) and (wide[:, :49] == 7).all()
    grey = np.full((8, 10, 3), 100, np.uint8)  # a small one has soft edges: they must not be dark
    assert (np.abs(blend_image(render, grey, one, view.K(100, 80), 1.0).astype(int) - 100) <= 1).all()


def test_captions_stand_below():
    image = add_caption(np.zeros((20, 300, 3), np.uint8), ["a line of 12°", "another"])
    assert image.shape[0] > 50 and image.shape[1] == 300 and image[20:].max() > 200
    wrapped = add_caption(np.zeros((20, 300, 3), np.uint8), ["words " * 30])
    assert wrapped.shape[0] > image.shape[0] and (wrapped[20:, -4:] == BACKGROUND).all()


def test_frusta_end_at_the_corners_of_the_image():
    one = camera(0.0)
    corners = image_corners(one, np.eye(4), 2.0)
    assert np.allclose(corners, [[-1, -0.8, 2], [1, -0.8, 2], [1, 0.8, 2], [-1, 0.8, 2]])
    lines = frustum(np.eye(4), corners)
    assert lines.shape == (10, 2, 3) and np.allclose(lines[:4, 0], 0) and np.allclose(lines[:4, 1], corners)
    assert lines[8:, 1, 1].max() < corners[0, 1]  # the roof points up
    assert frustum_depth(moment(wall(3), camera(0.0), camera(0.1, frame_id=1))) == pytest.approx(0.05)
    assert frustum_depth(moment(wall(3), one)) == frustum_depth(moment(wall(3)))


def test_frusta_are_as_large_in_the_picture_in_metres_as_without():
    def depth(metres: float, **changes: object) -> float:
        gaussians = wall(3)
        far = replace(gaussians, means=(metres * gaussians.means).astype(np.float32))
        return frustum_depth(moment(far, camera(0.0), camera(0.4 * metres, frame_id=1), **changes))

    assert depth(50.0, scale=Scale(True, "a ruler")) == pytest.approx(50.0 * depth(1.0), rel=0.2)


def test_the_path_follows_the_frames_and_the_hint_is_a_camera_that_looks_where_it_should():
    route = path((camera(0.2, frame_id=2), camera(0.0, frame_id=0), camera(0.1, frame_id=1)))
    assert np.allclose(route[:, :, 0], [[0.0, 0.1], [0.1, 0.2]])
    frame, way = advice_lines((camera(0.0),), np.zeros(3), np.array([1.0, 0, 0]), np.array([1.0, 0, 5.0]), 0.1)
    assert np.allclose(way.ends, [[[0, 0, 0], [1, 0, 0]]]) and np.allclose(frame.ends[:4, 0], [1, 0, 0])
    assert np.allclose(frame.ends[:4, 1, 2], 0.1) and np.allclose(frame.ends[:4, 1].mean(0), [1.0, 0.0, 0.1])


def test_an_ellipsoid_ends_at_its_semi_axes_and_nowhere_beyond():
    axes = np.array([[0.0, 0.0, 0.3], [0.1, 0.0, 0.0], [0.0, 0.05, 0.0]])
    one = camera(0.5, target=(0.5, 0.0, 1.0))
    ends = ellipsoid(one, axes).reshape(-1, 3) - one.T_world_camera[:3, 3]
    assert np.allclose(ends.max(0), [0.1, 0.05, 0.3]) and np.allclose(ends.min(0), [-0.1, -0.05, -0.3])
    np.testing.assert_allclose(((ends / [0.1, 0.05, 0.3]) ** 2).sum(1), 1.0)


def test_an_ellipsoid_has_the_colour_of_its_camera_and_is_drawn_where_it_is_more_than_a_dot():
    sizes = {0: 0.05, 1: 0.001}
    cameras = [
        replace(camera(0.5 * i, frame_id=i), bounds=Bounds(0.1, r, r, 1.0, make_ball(r))) for i, r in sizes.items()
    ]
    there = moment(wall(), *cameras, camera(1.0, frame_id=2))

    def drawn(**how: object) -> list:
        state = ViewerState(cameras=False, path=False, advice=False, uncertainty=bool(how.pop("uncertainty", True)))
        return [lines.colour for lines in shapes(there, state, None, **how).lines]

    assert drawn() == [source_colour(0), source_colour(1)]  # nothing is known of the third
    assert drawn(eye=np.array([0.25, 0.0, -3.0])) == [source_colour(0)]
    assert drawn(eye=np.array([0.5, 0.0, -0.02])) == [source_colour(0), source_colour(1)]  # where frusta are not drawn
    assert drawn(eye=np.array([-0.03, 0.0, 0.0])) == []  # from within
    assert drawn(uncertainty=False) == []


def test_switches_decide_what_stands_in_the_scene():
    cameras = camera(0.0), camera(0.5, frame_id=1)
    images = {"0.png": np.zeros((8, 10, 3), np.uint8)}
    there, tracked = moment(wall(), *cameras, images=images), camera(0.25, frame_id=9)
    advice = analyse(there).advice
    assert advice.arrow is not None
    every = shapes(there, ViewerState(), advice, tracked)
    assert len(every.lines) == 1 + 2 + 1 + 2 and [one.name for one in every.photographs] == ["0.png"]
    for switch, left in (("path", 5), ("cameras", 4), ("tracked", 5), ("advice", 4)):
        assert len(shapes(there, ViewerState(**{switch: False}), advice, tracked).lines) == left, switch
    assert not shapes(there, ViewerState(photographs=False), advice).photographs
    assert len(shapes(there, ViewerState(), advice, eye=np.zeros(3)).photographs) == 0  # it would fill the window
