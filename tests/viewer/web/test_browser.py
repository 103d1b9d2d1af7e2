"""The web viewer's page in a real browser: the drive of a person, and the picture beside the project's own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode.recon.result.export.limits import SH_C0
from splatnode.recon.result.snapshot import GaussianArrays, Snapshot
from splatnode.viewer.shapes import paint_gaussians
from splatnode.viewer.sources import FixedSource
from splatnode.viewer.state import BACKGROUND, ViewerState, Viewpoint, look_at, move_to_camera, orbit, pan, zoom
from splatnode.viewer.web import ListenAddress, describe_session, make_content, open_server
from tests.bench.viewer.drive_web import WINDOW, drive, fact, settle, watched
from tests.support.chromium import NAMES, browser, chromium
from tests.viewer.test_scene import camera, moment, wall
from tests.viewer.web.test_server import scene

pytestmark = pytest.mark.skipif(chromium() is None, reason=f"needs a browser: one of {', '.join(NAMES)}")


def coloured_wall() -> GaussianArrays:
    """A wall of Gaussians of all colours, sizes, rotations and opacities."""
    rng, gaussians = np.random.default_rng(0), wall(24)
    quats = rng.normal(size=(len(gaussians), 4))
    return replace(
        gaussians,
        means=(gaussians.means + 0.02 * rng.normal(size=(len(gaussians), 3))).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=rng.uniform(0.004, 0.02, (len(gaussians), 3)).astype(np.float32),
        opacities=rng.uniform(0.2, 0.99, len(gaussians)).astype(np.float32),
        sh=((rng.random((len(gaussians), 1, 3)) - 0.5) / SH_C0).astype(np.float32),
    )


def place() -> Snapshot:
    """Eight cameras that stand apart, with photographs."""
    cameras = [camera(0.12 * (index - 3.5), frame_id=index) for index in range(8)]
    images = {each.name: np.full((80, 100, 3), 20 * index, np.uint8) for index, each in enumerate(cameras)}
    whole = moment(coloured_wall(), *cameras, images=images).snapshot
    return replace(whole, verdict=replace(whole.verdict, message="All 8 photographs were placed."))


@pytest.fixture(scope="module")
def visit():
    with watched() as parts:
        yield parts


def test_what_a_person_does_shows_what_it_should(visit):
    page, node, viewer = visit
    done = list(drive(page, node, viewer, place()))
    assert [step.name for step in done if step.seconds is None] == [] and len(done) > 20
    pictures = {step.name: step.picture.astype(int) for step in done}
    shown, hidden, again = (pictures[name] for name in ("overview", "cameras_hidden", "cameras_shown"))
    stage = np.s_[:, : WINDOW[0] - 400]
    assert (np.abs(shown - hidden)[stage].max(2) > 30).sum() > 500  # the cameras are something to see
    assert (np.abs(shown - again)[stage].max(2) > 30).sum() < 20
    assert [text for text in page.complaints if "Failed to load resource" not in text] == []  # the viewer was away


def test_the_picture_is_that_of_the_projects_own_rasteriser(visit):
    page, node, viewer = visit
    whole = place()
    node.publish(whole, "another place")
    page.open(viewer.url)
    assert page.wait(f"{fact('camera')} == '4.png' && {fact('gaussians')} == {len(whole.gaussians)}") is not None
    for key in ("2", "4", "6", "7", "9"):
        page.press(key)
    settle(page)
    width, height = page.value("[document.getElementById('picture').clientWidth, innerHeight]")
    view = move_to_camera(start(), whole.cameras[4])
    ours = paint_gaussians(
        whole.gaussians, view.T_world_camera, view.K(width, height), ViewerState(), width, height
    ).image
    theirs = cv2.cvtColor(page.picture()[:height, :width], cv2.COLOR_BGR2RGB)
    assert (np.abs(ours.astype(int) - BACKGROUND).max(2) > 20).mean() > 0.2  # there is something to compare
    difference = np.abs(ours.astype(int) - theirs)
    assert difference.mean() < 1.5 and (difference.max(2) > 16).mean() < 0.01


def test_it_moves_as_the_window_does(visit):
    page, _, _ = visit
    view = start()
    K = view.K(640, 480)
    script = Path(__file__).with_name("moved.js").read_text()
    given = {"T": view.T_world_camera.ravel().tolist(), "distance": view.distance, "up": view.up.tolist()}
    given |= {"lens": {"K": view.lens[0].ravel().tolist(), "size": view.lens[1:]}}
    answer = page.value(f"({script})({json.dumps(given)})")
    for name, ours in (
        ("orbited", orbit(view, 0.3, -0.2)),
        ("high", orbit(view, 0.0, 3.0)),
        ("panned", pan(view, 12.0, -7.0, float(K[0, 0]))),
        ("zoomed", zoom(view, 0.7)),
    ):
        assert np.allclose(np.reshape(answer[name]["T"], (4, 4)), ours.T_world_camera, atol=1e-9), name
        assert answer[name]["distance"] == pytest.approx(ours.distance)
    fitted = [answer["fitted"][name] for name in ("fx", "fy", "cx", "cy")]
    assert np.allclose(fitted, [K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    point = np.array([0.3, 0.2, 0.9])
    local = K @ np.linalg.inv(view.T_world_camera)[:3] @ [*point, 1.0]
    assert np.allclose(answer["projected"], [*(local[:2] / local[2]), local[2]])


def start() -> Viewpoint:
    up = np.array([0.1, -1.0, 0.05])
    up /= np.linalg.norm(up)
    T = look_at(np.array([0.2, -0.3, -1.0]), np.array([0.1, 0.0, 1.0]), up)
    return Viewpoint(T, 1.7, up, (camera(0.0).K, 100.0, 80.0))


def fetched(path: str) -> str:
    """How often the page has got something of this path, as JavaScript asks for it."""
    return f"performance.getEntriesByType('resource').filter(e => e.name.includes('{path}')).length"


def test_a_page_that_stays_open_shows_what_another_viewer_at_that_address_shows():
    """Names, ids and version numbers are those of before, and at first the other viewer has nothing to show."""
    port = 0
    with browser(*WINDOW) as page:
        told = 0
        for number, count in enumerate((15, 24), start=1):
            with open_server(FixedSource(scene(count)), ListenAddress(port=port)) as (server, session):
                if number == 1:
                    port = server.server_address[1]
                    page.open(server.access.url())
                assert page.wait(f"{fetched('/told')} > {told}") is not None
                session.receive()
                server.board.publish(describe_session(session), make_content(session, None), live=False)
                assert page.wait(f"{fact('gaussians')} == {len(wall(count))}") is not None
                assert page.wait(f"{fetched('/thumbnail/')} == {number}") is not None
                told = page.value(fetched("/told"))
