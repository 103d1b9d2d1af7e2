"""Where the viewer looks from, what it paints there, and how keys, clicks and new moments change it."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from recon.snapshot import CameraEstimate, GaussianArrays
from tests.test_viewer_scene import K, camera, moment, wall
from viewer.analysis import Analyst, analyse
from viewer.canvas import BACKGROUND, project
from viewer.moment import Moment
from viewer.paint import blended, caption, paint, paint_gaussians
from viewer.session import Session
from viewer.shapes import Lines, Photograph, Shapes, arrow, frustum, frustum_depth, image_corners, path, shapes
from viewer.sources import Finished
from viewer.state import (
    BINDINGS,
    Colouring,
    Engine,
    State,
    go_to_moment,
    help_lines,
    moment_index,
    press,
    shown_moment,
)
from viewer.viewpoint import Viewpoint, at_camera, look_at, orbited, overview, panned, swing, zoomed

UP = np.array([0.0, -1.0, 0.0])
NOTHING = Shapes((), ())
RED, GREEN = np.array([255, 0, 0]), np.array([0, 255, 0])


def viewpoint(distance: float = 1.0) -> Viewpoint:
    """At the world's origin, looking along z, with the lens of `camera`."""
    return Viewpoint(np.eye(4), distance, UP, (K, 100.0, 80.0))


# ---- Viewpoints ---------------------------------------------------------------------------------------------------


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
    right = orbited(view, np.radians(90), 0.0)
    assert np.allclose(right.pivot, view.pivot) and np.allclose(right.T_world_camera[:3, 3], [2.0, 0.0, 2.0])
    above = orbited(view, 0.0, np.radians(30))
    assert np.allclose(above.T_world_camera[:3, 3], [0.0, -1.0, 2.0 - np.sqrt(3.0)])
    highest = orbited(view, 0.0, np.radians(170))
    assert np.degrees(np.arcsin(-highest.T_world_camera[1, 3] / 2.0)) == pytest.approx(85.0)


def test_what_is_dragged_stays_under_the_pointer():
    view = viewpoint(1.0)
    focal = float(view.K(100, 80)[0, 0])
    before = project(view.pivot[None], view, 100, 80)[0]
    after = project(view.pivot[None], panned(view, 10.0, -4.0, focal), 100, 80)[0]
    assert np.allclose(after[:2] - before[:2], [10.0, -4.0])


def test_zooming_goes_to_the_pivot():
    near = zoomed(viewpoint(2.0), 0.25)
    assert np.allclose(near.pivot, [0, 0, 2.0]) and np.allclose(near.T_world_camera[:3, 3], [0, 0, 1.5])
    assert zoomed(near, 0.0).distance > 0


def test_the_lens_fits_into_every_window():
    for width, height, scale in ((200, 160, 2.0), (400, 160, 2.0), (100, 400, 1.0)):
        fitted = viewpoint().K(width, height)
        corners = np.array([[0, 0], [100, 80]]) * scale + [fitted[0, 2] - 50 * scale, fitted[1, 2] - 40 * scale]
        assert fitted[0, 0] == pytest.approx(100 * scale)
        assert (corners >= 0).all() and (corners <= [width, height]).all()


def test_the_overview_shows_all_cameras_and_the_swing_goes_around():
    there = moment(wall(), camera(-0.3), camera(0.0, frame_id=1), camera(0.3, frame_id=2))
    centres = np.array([one.T_world_camera[:3, 3] for one in there.snapshot.cameras])
    pixels = project(centres, overview(there), 100, 80)
    assert (pixels[:, 2] > 0).all() and (pixels[:, :2] > 0).all() and (pixels[:, :2] < [100, 80]).all()
    aside = np.array([1.5, 0.0, 0.3])
    assert (np.abs(project(aside[None], overview(there), 100, 80)[0, :2] - [50, 40]) > [50, 40]).any()
    wider = project(np.array([aside, *centres]), overview(there, [aside]), 100, 80)
    assert (wider[:, :2] > 0).all() and (wider[:, :2] < [100, 80]).all()
    tour = swing(there, 8)
    assert len(tour) == 8 and all(np.allclose(view.pivot, tour[0].pivot) for view in tour)
    assert max(view.T_world_camera[0, 3] for view in tour) > 0.15 > -0.15 > min(v.T_world_camera[0, 3] for v in tour)
    for bare in (moment(wall()), moment(GaussianArrays.empty()), moment(wall(), camera(0.0))):
        assert all(np.isfinite(view.T_world_camera).all() for view in swing(bare, 3))


# ---- Pictures -----------------------------------------------------------------------------------------------------


def test_gaussians_cover_the_background_and_can_be_hidden():
    image = paint(wall(half=0.2), NOTHING, viewpoint(), State(), 100, 80)
    assert image.shape == (80, 100, 3) and image.dtype == np.uint8
    assert (image[40, 50] > 150).all() and (image[2, 2] == BACKGROUND).all()
    assert (paint(wall(), NOTHING, viewpoint(), State(gaussians=False), 100, 80) == BACKGROUND).all()
    assert (paint(GaussianArrays.empty(), NOTHING, viewpoint(), State(), 100, 80) == BACKGROUND).all()


def test_points_are_squares_and_the_nearest_is_on_top():
    far, near = wall(2, depth=2.0, half=0.0), wall(2, depth=1.0, half=0.0)
    gaussians = replace(
        far,
        means=np.concatenate([far.means[:1], near.means[:1]]),
        sh=np.array([[[-2.0] * 3], [[2.0] * 3]], np.float32),
        **{name: getattr(far, name)[:2] for name in ("quats", "scales", "opacities", "source_frame")},
    )
    canvas = paint_gaussians(gaussians, np.eye(4), K, State(as_points=True, point_size=4), 100, 80)
    white = (canvas.image == 255).all(2)
    assert np.array_equal(np.argwhere(white)[[0, -1]], [[38, 48], [41, 51]]) and white.sum() == 16
    assert (canvas.depth[white] == 1.0).all() and np.isinf(canvas.depth[~white]).all()
    at_corner = replace(gaussians, means=gaussians.means + np.array([-0.5, -0.4, 0], np.float32))
    clipped = paint_gaussians(at_corner, np.eye(4), K, State(as_points=True, point_size=4), 100, 80)
    assert (clipped.image[:2, :2] == 255).all() and np.isfinite(clipped.depth).sum() > 4


def test_lines_are_bright_before_a_wall_and_dim_behind_it():
    def line(z: float) -> Shapes:
        return Shapes((Lines(np.array([[[-0.2, 0.0, z], [0.2, 0.0, z]]]), (1.0, 0.0, 0.0), 3),), ())

    gaussians = wall(half=0.4)
    before = paint(gaussians, line(0.5), viewpoint(), State(), 100, 80)
    behind = paint(gaussians, line(1.5), viewpoint(), State(), 100, 80)
    assert np.abs(before[40, 50].astype(int) - RED).max() < 30
    assert behind[40, 50, 0] < 150
    passing = Shapes((Lines(np.array([[[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]]), (1.0, 0.0, 0.0), 3),), ())
    paint(gaussians, passing, viewpoint(), State(), 100, 80)  # through the eye: no crash


def test_a_photograph_lies_where_its_rectangle_is():
    picture = np.zeros((10, 20, 3), np.uint8)
    picture[:, :10], picture[:, 10:] = RED, GREEN
    rectangle = np.array([[-0.2, -0.1, 1], [0.2, -0.1, 1], [0.2, 0.1, 1], [-0.2, 0.1, 1]])
    image = paint(
        GaussianArrays.empty(), Shapes((), (Photograph("a", rectangle, (picture,)),)), viewpoint(), State(), 100, 80
    )
    assert (image[32:48, 32:48] == RED).all() and (image[32:48, 53:68] == GREEN).all()
    assert (image[:28] == BACKGROUND).all() and (image[:, :28] == BACKGROUND).all()
    hidden = Photograph("a", rectangle + [0, 0, 1.0], (picture,))
    assert (paint(wall(half=0.5), Shapes((), (hidden,)), viewpoint(), State(), 100, 80)[40, 40] > 150).all()


def test_a_photograph_that_is_drawn_small_does_not_flicker():
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::2] = 255
    there = moment(wall(), camera(0.0), images={"0.png": stripes})
    levels = there.photographs["0.png"]
    assert [level.shape for level in levels] == [(64, 64, 3), (32, 32, 3), (16, 16, 3)]
    assert (np.abs(levels[1].astype(int) - 128) <= 1).all() and there.num_bytes > moment(wall()).num_bytes
    rectangle = np.array([[-0.08, -0.08, 1], [0.08, -0.08, 1], [0.08, 0.08, 1], [-0.08, 0.08, 1]])
    image = paint(
        GaussianArrays.empty(), Shapes((), (Photograph("a", rectangle, levels),)), viewpoint(), State(), 100, 80
    )
    assert (np.abs(image[36:44, 46:54].astype(int) - 128) <= 2).all()


def test_a_photograph_covers_the_render_pixel_by_pixel():
    one = camera(0.0)
    view = at_camera(viewpoint(), one)
    picture = np.random.default_rng(0).integers(0, 255, (80, 100, 3), dtype=np.uint8)
    render = np.full((80, 100, 3), 100, np.uint8)
    assert np.array_equal(blended(render, picture, one, view.K(100, 80), 1.0), picture)
    half = blended(render, picture, one, view.K(100, 80), 0.5)
    assert np.abs(half - (picture / 2 + 50)).max() <= 0.5
    wide = blended(np.full((80, 200, 3), 7, np.uint8), picture, one, view.K(200, 80), 1.0)
    assert np.array_equal(wide[:, 50:150], picture) and (wide[:, :49] == 7).all()
    grey = np.full((8, 10, 3), 100, np.uint8)  # a small one has soft edges: they must not be dark
    assert (np.abs(blended(render, grey, one, view.K(100, 80), 1.0).astype(int) - 100) <= 1).all()


def test_captions_stand_below():
    image = caption(np.zeros((20, 300, 3), np.uint8), ["a line of 12°", "another"])
    assert image.shape[0] > 50 and image.shape[1] == 300 and image[20:].max() > 200
    wrapped = caption(np.zeros((20, 300, 3), np.uint8), ["words " * 30])
    assert wrapped.shape[0] > image.shape[0] and (wrapped[20:, -4:] == BACKGROUND).all()


# ---- Shapes -------------------------------------------------------------------------------------------------------


def test_frusta_end_at_the_corners_of_the_image():
    one = camera(0.0)
    corners = image_corners(one, np.eye(4), 2.0)
    assert np.allclose(corners, [[-1, -0.8, 2], [1, -0.8, 2], [1, 0.8, 2], [-1, 0.8, 2]])
    lines = frustum(np.eye(4), corners)
    assert lines.shape == (10, 2, 3) and np.allclose(lines[:4, 0], 0) and np.allclose(lines[:4, 1], corners)
    assert lines[8:, 1, 1].max() < corners[0, 1]  # the roof points up
    assert frustum_depth((camera(0.0), camera(0.1, frame_id=1))) == pytest.approx(0.05)
    assert frustum_depth((one,)) == frustum_depth(())


def test_the_path_follows_the_frames_and_the_arrow_ends_where_it_points():
    route = path((camera(0.2, frame_id=2), camera(0.0, frame_id=0), camera(0.1, frame_id=1)))
    assert np.allclose(route[:, :, 0], [[0.0, 0.1], [0.1, 0.2]])
    lines = arrow(np.zeros(3), np.array([1.0, 0, 0]), np.array([1.0, 0, 5.0]))
    assert np.allclose(lines[0], [[0, 0, 0], [1, 0, 0]]) and np.allclose(lines[1:, 0], [1, 0, 0])
    assert np.allclose(lines[-1, 1], [1, 0, 1])


def test_switches_decide_what_stands_in_the_scene():
    cameras = camera(0.0), camera(0.5, frame_id=1)
    images = {"0.png": np.zeros((8, 10, 3), np.uint8)}
    there, tracked = moment(wall(), *cameras, images=images), camera(0.25, frame_id=9)
    advice = analyse(there).advice
    assert advice.arrow is not None
    every = shapes(there, State(), advice, tracked)
    assert len(every.lines) == 1 + 2 + 1 + 1 and [one.name for one in every.photographs] == ["0.png"]
    for switch, left in (("path", 4), ("cameras", 3), ("tracked", 4), ("advice", 4)):
        assert len(shapes(there, State(**{switch: False}), advice, tracked).lines) == left, switch
    assert not shapes(there, State(photographs=False), advice).photographs
    assert len(shapes(there, State(), advice, eye=np.zeros(3)).photographs) == 0  # it would fill the window


# ---- Keys, the time axis, the session -----------------------------------------------------------------------------


def moments(count: int) -> tuple[Moment, ...]:
    cameras = camera(0.0), camera(0.3, frame_id=1), camera(0.6, frame_id=2)
    return tuple(moment(wall(5), *cameras, received_s=float(second)) for second in range(count))


def test_every_key_does_something_and_only_its_own():
    history = moments(3)
    start = State(camera="1.png", blend=0.5, help=True, held=history[1])
    for binding in BINDINGS:
        after = press(start, history, binding.key)
        assert after is not start and any(getattr(after, name) is not getattr(start, name) for name in vars(start))
    assert press(start, history, "?") is start
    assert len({binding.key for binding in BINDINGS}) == len(BINDINGS)
    assert len(help_lines()) > len(BINDINGS)


def test_keys_go_round():
    state = State()
    for _ in Colouring:
        state = press(state, (), "c")
    assert state.colouring is Colouring.PHOTOGRAPH
    assert press(state, (), "e").engine is Engine.OPEN3D
    names = []
    for _ in range(4):
        state = press(state, moments(1), "n")
        names.append(state.camera)
    assert names == ["0.png", "1.png", "2.png", "0.png"]
    assert press(state, moments(1), "p").camera == "2.png"
    for _ in range(9):
        state = press(press(state, (), "."), (), "]")
    assert state.blend == 1.0 and state.point_size == 12


def test_time_goes_back_and_forth_and_a_pause_holds_it():
    history = moments(4)
    state = press(State(), history, "left")
    assert shown_moment(state, history) is history[2] and moment_index(state, history) == 2
    assert shown_moment(press(state, history, "right"), history) is history[3]
    assert go_to_moment(state, history, -5).held is history[0] and go_to_moment(state, history, 99).held is None
    paused = press(State(), history, "space")
    longer = (*history, moments(5)[4])
    assert shown_moment(paused, longer) is history[3] and shown_moment(State(), longer) is longer[4]
    assert shown_moment(press(paused, longer, "space"), longer) is longer[4]
    assert moment_index(State(held=history[1]), (history[0], *history[2:])) == 1  # it was thinned out


class Feed:
    """A source that the test fills."""

    age_s = 0.5
    tracked: CameraEstimate | None = None

    def __init__(self) -> None:
        self.waiting: list[Moment] = []

    def take(self) -> Moment | None:
        return self.waiting.pop() if self.waiting else None

    def close(self) -> None:
        pass


def test_a_session_from_the_first_moment_to_a_click():
    feed = Feed()
    session = Session(feed, State())
    assert not session.receive() and session.paint(100, 80) is None and not session.click(1, 1, 100, 80)
    session.press("n")
    first, second = moments(2)
    feed.waiting.append(first)
    assert session.receive() and session.moment is first
    image = session.paint(100, 80)
    assert image is not None and image.shape == (80, 100, 3)

    view = session.viewpoint()
    centre = project(first.snapshot.cameras[1].T_world_camera[None, :3, 3], view, 100, 80)[0]
    assert session.click(centre[0], centre[1], 100, 80) and session.state.camera == "1.png"
    assert np.array_equal(session.viewpoint().T_world_camera, first.snapshot.cameras[1].T_world_camera)
    session.move(orbited(session.grasped(), 0.1, 0.0))
    assert session.state.camera is None
    chosen = session.viewpoint()
    feed.waiting.append(second)
    session.receive()
    assert session.viewpoint() is chosen and len(session.history) == 2  # the person's viewpoint stays
    feed.waiting.append(replace(moments(3)[2], scene_id="another"))
    session.receive()
    assert session.viewpoint() is not chosen  # another place: nothing carries over
    session.press("f")
    assert np.array_equal(session.viewpoint().T_world_camera, first.snapshot.cameras[2].T_world_camera)
    session.whole_scene()
    assert not session.state.follow
    session.close()


def test_the_live_camera_moves_between_moments():
    feed = Feed()
    session = Session(feed, State())
    feed.waiting.append(moments(1)[0])
    session.receive()
    lines = len(session.shapes().lines)
    feed.tracked = camera(0.4, frame_id=9)
    assert session.receive() and not session.receive()
    assert len(session.shapes().lines) == lines + 1 and len(session.history) == 1
    session.press("f")
    assert np.array_equal(session.viewpoint().T_world_camera, feed.tracked.T_world_camera)
    feed.tracked = None
    assert session.receive() and session.camera().name == "2.png"  # lost: the newest photograph's camera
    session.close()


def test_a_camera_that_is_gone_from_the_next_moment_leaves_a_free_viewpoint():
    session = Session(Finished(moment(wall(5), camera(0.0))), State(camera="gone.png"))
    session.receive()
    assert session.camera() is None and session.paint(50, 40) is not None
    session.close()


def test_the_analyst_answers_for_the_moment_that_is_asked_for():
    analyst = Analyst()
    first, second = moments(2)
    analyst.of(first)
    deadline = time.monotonic() + 20
    while (answer := analyst.of(second)) is None and time.monotonic() < deadline:
        time.sleep(0.005)
    assert answer is not None and answer.moment is second and answer.support.sizes.shape == (25, 3)
    analyst.close()
