"""`splatnode view --viser`: the picture in a real browser, what is refused, and the end by Ctrl-C."""

from __future__ import annotations

import http.client
import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.extras.viewers.viser import ViserStage, _go, make_splat_arguments
from splatnode.viewer.shapes import frustum_depth, paint_gaussians
from splatnode.viewer.state import ViewerState, move_to_camera, overview
from tests.support.chromium import NAMES, browser, chromium
from tests.support.exported import make_gaussians, make_snapshot, write
from tests.viewer.test_scene import camera, moment
from tests.viewer.web.test_browser import coloured_wall

pytest.importorskip("viser", reason="needs viser")
viser = pytest.importorskip("splatnode.extras.viewers.viser", reason="needs viser")

PATIENCE_S = 30.0


def place(**changes: object):
    return moment(coloured_wall(), camera(-0.1, frame_id=0), camera(0.1, frame_id=1), **changes)


def asked(port: int, path: str = "/", **headers: str) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    connection.request("GET", path, headers=headers)
    return connection.getresponse().status


def websocket_headers(port: int, origin: str) -> dict[str, str]:
    opening = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    key = {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol": "viser-v0"}
    return {**opening, **key, "Host": f"127.0.0.1:{port}", "Origin": origin}


def test_small_gaussians_survive_the_16_bits_in_which_their_covariances_travel():
    gaussians = replace(make_gaussians(), scales=np.full((50, 3), 1e-4, np.float32))
    given = make_splat_arguments(gaussians)
    travelled = given["covariances"].astype(np.float16).astype(np.float64) * given["scale"] ** 2
    assert np.allclose(np.linalg.eigvalsh(travelled), 1e-8, rtol=0.01)
    assert np.allclose(given["centers"] * given["scale"], gaussians.means, rtol=1e-6)
    large = make_splat_arguments(replace(gaussians, scales=np.full((50, 3), 400.0, np.float32)))
    assert np.isfinite(large["covariances"].astype(np.float16)).all()


def test_only_its_own_page_is_answered_and_no_tunnel_is_opened():
    with viser.open_server("127.0.0.1", 0) as server:
        port = server.get_port()
        assert asked(port) == 200
        assert asked(port, Host="evil.example") == 403
        assert asked(port, **websocket_headers(port, "http://evil.example")) == 403
        assert asked(port, **websocket_headers(port, f"http://127.0.0.1:{port}")) == 101
        assert server.request_share_url() is None
        others = {each[4][0] for each in socket.getaddrinfo(socket.gethostname(), port, socket.AF_INET)}
        for address in others - {"127.0.0.1"}:
            with pytest.raises(OSError):
                socket.create_connection((address, port), 1.0).close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), 1.0)


def test_where_it_cannot_listen_it_says_so_and_takes_no_other_port():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        told = pytest.raises(OSError, match="another program listens there. --port takes another port")
        with told, viser.open_server("127.0.0.1", taken.getsockname()[1]):
            raise AssertionError("it served")
    with (
        pytest.raises(OSError, match="cannot listen on 192.0.2.1, port 0: Cannot assign"),
        viser.open_server("192.0.2.1", 0),
    ):
        raise AssertionError("it served")


def test_a_visitor_is_given_the_cameras_where_they_are_with_their_photographs():
    photographs = {"0.png": np.full((80, 100, 3), 200, np.uint8)}
    with viser.open_server("127.0.0.1", 0) as server:
        stage = ViserStage(server)
        stage.draw(place(images=photographs))
        nodes = stage._nodes
        for name, x in (("0.png", -0.1), ("1.png", 0.1)):
            frustum = nodes[f"/cameras/{name}"]
            assert np.allclose(frustum.position, [x, 0.0, 0.0])
            assert np.allclose(
                viser.viser.transforms.SO3(frustum.wxyz).as_matrix()[:, 2] @ [x, 0.0, -1.0], -np.hypot(x, 1)
            )
            assert np.isclose(np.tan(frustum.fov / 2.0), 0.4) and np.isclose(frustum.aspect, 1.25)
            assert (frustum.image is not None) == (name == "0.png")
        assert len(nodes["/gaussians"].buffer) == len(place().snapshot.gaussians)
        stage.photographs.value = False
        stage.apply_client_changes()
        assert nodes["/cameras/0.png"].image is None and nodes["/cameras/0.png"].visible
        stage.cameras.value = False
        stage.apply_client_changes()
        stage.draw(place(cameras=place().snapshot.cameras[:1], images=photographs))
        assert not stage._nodes["/cameras/0.png"].visible and "/cameras/1.png" not in stage._nodes
        stage.track(camera(0.0, frame_id=5))
        assert np.allclose(stage._tracked[1].position, 0.0)
        stage.track(None)
        assert stage._tracked == (None, None)


def test_a_frustum_is_as_deep_as_that_of_the_other_viewers():
    """viser's own rule (CameraFrustumVariants.tsx): the pyramid x, y, 1 over the cube root of a third of x y."""
    with viser.open_server("127.0.0.1", 0) as server:
        stage = ViserStage(server)
        stage.draw(place())
        frustum = stage._nodes["/cameras/0.png"]
        y = np.tan(frustum.fov / 2.0)
        assert np.isclose(frustum.scale / np.cbrt(frustum.aspect * y * y / 3.0), frustum_depth(place()))


@pytest.mark.skipif(chromium() is None, reason=f"needs a browser: one of {', '.join(NAMES)}")
def test_a_browser_shows_what_the_projects_own_rasteriser_does():
    whole = place()
    with viser.open_server("127.0.0.1", 0) as server, browser(900, 600) as page:
        stage = ViserStage(server)
        page.open(f"http://127.0.0.1:{server.get_port()}/")
        deadline = time.monotonic() + PATIENCE_S
        while not server.get_clients() and time.monotonic() < deadline:
            time.sleep(0.1)
        stage.draw(replace(whole, snapshot=replace(whole.snapshot, gaussians=make_gaussians())))
        stage.cameras.value = False
        stage.draw(whole)  # the visitor, who was there before, has been taken to the scene
        stage.apply_client_changes()
        texts = "[...document.querySelectorAll('textarea')].map(each => each.value)"
        assert page.wait(f"{texts}.some(each => each.includes('2 cameras, {len(whole.snapshot.gaussians)}'))")
        width, height = page.value("[document.querySelector('canvas').clientWidth, innerHeight]")
        view = move_to_camera(overview(whole), whole.snapshot.cameras[0])
        (visitor,) = server.get_clients().values()
        _go(visitor, view)
        while visitor.camera.near == 0.01 and time.monotonic() < deadline:
            stage.apply_client_changes()
            time.sleep(0.1)
        assert np.isclose(visitor.camera.near, 2.0 * frustum_depth(whole))
        K = np.array([[height / 0.8, 0, width / 2], [0, height / 0.8, height / 2], [0, 0, 1]])  # of the camera's lens
        ours = paint_gaussians(whole.snapshot.gaussians, view.T_world_camera, K, ViewerState(), width, height).image
        middle = np.s_[height // 4 : -height // 4, width // 4 : width // 2]
        difference = np.inf
        while difference > 8.0 and time.monotonic() < deadline:  # Gaussians are sorted some time after they came
            theirs = cv2.cvtColor(page.picture(), cv2.COLOR_BGR2RGB)[:height, :width]
            difference = np.abs(ours.astype(int) - theirs)[middle].mean()
        assert difference < 8.0 and ours[middle].std() > 30.0
        stage.draw(place(cameras=whole.snapshot.cameras[:1]))  # the same scene: the visitor stays
        assert page.wait(f"{texts}.some(each => each.includes('1 cameras'))")
        time.sleep(0.5)  # a visitor who is moved tells of it
        assert np.allclose(visitor.camera.position, view.T_world_camera[:3, 3], atol=1e-6)
        assert page.complaints == []


def test_ctrl_c_ends_it_without_a_word(tmp_path, interruptible):
    write(make_snapshot(), tmp_path / "out")
    command = [sys.executable, "-m", "splatnode", "view", str(tmp_path / "out"), "--viser", "--port", "0"]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert child.stdout is not None and child.stderr is not None
        line = child.stdout.readline()
        found = re.search(r"open http://127\.0\.0\.1:(\d+)/ ", line)
        assert found and asked(int(found[1])) == 200
        child.send_signal(signal.SIGINT)
        rest, errors = child.communicate(timeout=PATIENCE_S)
        assert child.returncode == 130 and rest == "" and "Traceback" not in errors
    finally:
        child.kill()
        child.wait()
