"""How keys, clicks and new moments change what the viewer shows."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon.result.export.limits import Selection
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.verdict import Scale
from splatnode.viewer.analysis import Analyst
from splatnode.viewer.session import Session
from splatnode.viewer.sources import FixedSource
from splatnode.viewer.state import (
    BINDINGS,
    Colouring,
    Engine,
    Moment,
    ViewerState,
    current_moment,
    go_to_moment,
    help_lines,
    moment_index,
    open3d_draws,
    orbit,
    press,
    project,
)
from tests.viewer.test_scene import camera, moment, wall


def moments(count: int) -> tuple[Moment, ...]:
    cameras = camera(0.0), camera(0.3, frame_id=1), camera(0.6, frame_id=2)
    return tuple(moment(wall(5), *cameras, received_s=float(second)) for second in range(count))


def test_every_key_does_something_and_only_its_own():
    history = moments(3)
    start = ViewerState(camera="1.png", blend=0.5, help=True, held=history[1], edits=(Selection(only_seen=True),))
    for binding in BINDINGS:
        after = press(start, history, binding.key)
        assert after is not start and any(getattr(after, name) is not getattr(start, name) for name in vars(start))
    assert press(start, history, "?") is start
    assert len({binding.key for binding in BINDINGS}) == len(BINDINGS)
    assert len(help_lines()) > len(BINDINGS)


def test_keys_go_round():
    state = ViewerState()
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
    state = press(ViewerState(), history, "left")
    assert current_moment(state, history) is history[2] and moment_index(state, history) == 2
    assert current_moment(press(state, history, "right"), history) is history[3]
    assert go_to_moment(state, history, -5).held is history[0] and go_to_moment(state, history, 99).held is None
    paused = press(ViewerState(), history, "space")
    longer = (*history, moments(5)[4])
    assert current_moment(paused, longer) is history[3] and current_moment(ViewerState(), longer) is longer[4]
    assert current_moment(press(paused, longer, "space"), longer) is longer[4]
    assert moment_index(ViewerState(held=history[1]), (history[0], *history[2:])) == 1  # it was thinned out


def test_open3d_draws_what_it_draws_whole():
    asked = ViewerState(engine=Engine.OPEN3D)
    assert open3d_draws(asked, software=False) and not open3d_draws(asked, software=True)
    assert open3d_draws(replace(asked, as_points=True), software=True)
    assert not open3d_draws(ViewerState(), software=False)


class Feed:
    """A source that the test fills."""

    age_s = 0.5
    live_camera: CameraEstimate | None = None

    def __init__(self) -> None:
        self.waiting: list[Moment] = []

    def take(self) -> Moment | None:
        return self.waiting.pop() if self.waiting else None

    def close(self) -> None:
        pass


def test_a_session_from_the_first_moment_to_a_click():
    feed = Feed()
    session = Session(feed, ViewerState())
    assert not session.receive() and session.paint(100, 80) is None and not session.click(1, 1, 100, 80)
    session.press("n")
    first, second = moments(2)
    feed.waiting.append(first)
    assert session.receive() and session.moment is first
    image = session.paint(100, 80)
    assert image is not None and image.shape == (80, 100, 3)
    assert np.array_equal(session.viewpoint().T_world_camera, first.snapshot.cameras[1].T_world_camera)

    session.whole_scene()
    view = session.viewpoint()
    centre = project(first.snapshot.cameras[1].T_world_camera[None, :3, 3], view, 100, 80)[0]
    assert session.click(centre[0], centre[1], 100, 80) and session.state.camera == "1.png"
    assert np.array_equal(session.viewpoint().T_world_camera, first.snapshot.cameras[1].T_world_camera)
    session.move(orbit(session.viewpoint_to_move(), 0.1, 0.0))
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


def metric(of: Moment, factor: float, along: float = 0.0) -> Moment:
    """The moment in metres, `factor` of them a unit, in a world that begins so far along x."""
    to_metres = np.diag([factor, factor, factor, 1.0])
    cameras = []
    for each in of.snapshot.cameras:
        T_world_camera = each.T_world_camera.copy()
        T_world_camera[:, 3] = to_metres @ T_world_camera[:, 3] + [along, 0.0, 0.0, 0.0]
        cameras.append(replace(each, T_world_camera=T_world_camera))
    return replace(of, snapshot=replace(of.snapshot, cameras=tuple(cameras), scale=Scale(True, "a ruler")))


@pytest.mark.parametrize(("factor", "along"), [(4.0, 0.0), (1.0, 100.0), (1.0, 0.0)])
def test_what_was_said_in_another_world_is_taken_back(factor, along):
    feed = Feed()
    first, second = moments(2)
    feed.waiting += [first]
    session = Session(feed, ViewerState())
    session.receive()
    session.state = replace(session.state, measured=(np.zeros(3), np.ones(3)), edits=(Selection(only_seen=True),))
    session.move(orbit(session.viewpoint_to_move(), 0.1, 0.0))
    chosen = session.viewpoint()
    feed.waiting += [second]
    session.receive()
    assert session.viewpoint() is chosen and len(session.state.measured) == 2 and session.state.edits  # the same world
    feed.waiting += [metric(second, factor, along)]
    session.receive()
    assert session.viewpoint() is not chosen and not session.state.measured and not session.state.edits
    assert np.array_equal(session.viewpoint().T_world_camera, session.moment.snapshot.cameras[1].T_world_camera)
    session.close()


def test_what_is_held_keeps_its_edits_and_its_viewpoint_until_it_is_let_go():
    feed = Feed()
    first, second = moments(2)
    feed.waiting += [first]
    session = Session(feed, ViewerState())
    session.receive()
    session.state = replace(session.state, held=first, edits=(Selection(only_seen=True),))
    session.move(orbit(session.viewpoint_to_move(), 0.1, 0.0))
    chosen = session.viewpoint()
    feed.waiting += [replace(second, scene_id="another")]
    session.receive()
    assert session.moment is first and session.viewpoint() is chosen and session.state.edits
    session.state = replace(session.state, held=None)
    session.receive()
    assert session.moment.scene_id == "another" and session.viewpoint() is not chosen and not session.state.edits
    session.close()


def test_the_live_camera_moves_between_moments():
    feed = Feed()
    session = Session(feed, ViewerState())
    feed.waiting.append(moments(1)[0])
    session.receive()
    lines = len(session.shapes().lines)
    feed.live_camera = camera(0.4, frame_id=9)
    assert session.receive() and not session.receive()
    assert len(session.shapes().lines) == lines + 1 and len(session.history) == 1
    session.press("f")
    assert np.array_equal(session.viewpoint().T_world_camera, feed.live_camera.T_world_camera)
    feed.live_camera = None
    assert session.receive() and session.camera().name == "2.png"  # lost: the newest photograph's camera
    session.close()


def test_the_look_at_the_whole_scene_makes_room_for_advice_only_where_it_is_shown():
    for advice in (True, False):
        session = Session(FixedSource(moments(1)[0]), ViewerState(advice=advice))
        session.receive()
        session.whole_scene()
        before = session.viewpoint()
        deadline = time.monotonic() + 60
        while session.analysis() is None and time.monotonic() < deadline:
            time.sleep(0.005)
        assert session.analysis() is not None and (session.viewpoint() is not before) == advice
        session.close()


def test_gaussians_are_painted_again_only_where_they_look_different():
    feed = Feed()
    session = Session(feed, ViewerState(advice=False))
    feed.waiting.append(moments(1)[0])
    session.receive()
    without = session.paint(60, 40)
    feed.live_camera = camera(0.4, frame_id=9)
    session.receive()
    assert not np.array_equal(session.paint(60, 40), without) and session.paintings == 1
    feed.live_camera = None
    session.receive()
    assert np.array_equal(session.paint(60, 40), without) and session.paintings == 1  # nothing was left behind
    session.press("g")
    session.paint(60, 40)
    session.move(orbit(session.viewpoint_to_move(), 0.1, 0.0))
    session.paint(60, 40)
    session.paint(30, 20)
    assert session.paintings == 4
    coarse = session.paint(60, 40, 3)
    assert session.paintings == 5 and coarse.shape == (40, 60, 3)
    assert np.abs(coarse.astype(int) - session.paint(60, 40)).mean() < 25
    session.close()


def test_a_camera_that_is_gone_from_the_next_moment_leaves_a_free_viewpoint():
    session = Session(FixedSource(moment(wall(5), camera(0.0))), ViewerState(camera="gone.png"))
    session.receive()
    assert session.camera() is None and session.paint(50, 40) is not None
    session.close()


def test_the_analyst_answers_for_the_moment_that_is_asked_for():
    analyst = Analyst()
    first, second = moments(2)
    analyst.request_analysis(first)
    deadline = time.monotonic() + 60
    while (answer := analyst.request_analysis(second)) is None and time.monotonic() < deadline:
        time.sleep(0.005)
    assert answer is not None and answer.moment is second and answer.support.sizes.shape == (25, 3)
    analyst.close()
