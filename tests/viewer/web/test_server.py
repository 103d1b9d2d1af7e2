"""The web viewer's server: what it gives, to whom, and what visitors cannot do to it."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.capture.frame import DroppedFrame
from splatnode.recon.result.export.formats.splat import decode
from splatnode.recon.result.verdict import Bounds, Code, Scale, Verdict, make_ball
from splatnode.viewer import web as server_module
from splatnode.viewer.sources import FixedSource
from splatnode.viewer.state import Moment
from splatnode.viewer.web import Board, Content, ListenAddress, Server, describe_session, make_content, open_server
from tests.capture.messaging.test_sockets import wait_for
from tests.viewer.test_scene import camera, moment, wall

KEY = "k" * 43
RUBBISH = (
    b"\x16\x03\x01\x02\x00\x01\n\n",
    b"GET\n\n",
    b"GET / HTTP/9.9\r\n\r\n",
    b"A" * 100_000,
    b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 1000,
    b"GET /told?number=" + b"9" * 5000 + b" HTTP/1.0\r\nHost: localhost\r\n\r\n",
)
PICTURE = np.full((300, 400, 3), (200, 90, 20), np.uint8)


def scene(count: int = 15, **changes: object) -> Moment:
    cameras = camera(-0.2), camera(0.2, frame_id=1)
    return moment(wall(count), *cameras, images={"0.png": PICTURE}, final=True, **changes)


@contextlib.contextmanager
def shown(what: Moment, key: str | None = None) -> Iterator[Server]:
    """A server of one moment."""
    with open_server(FixedSource(what), ListenAddress(port=0, key=key)) as (server, session):
        session.receive()
        server.board.publish(describe_session(session), make_content(session, None), live=False)
        yield server


def ask(server: Server, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection(*server.server_address[:2], timeout=20)
    with contextlib.closing(connection):
        connection.request(method, path, headers={name.replace("_", "-"): value for name, value in headers.items()})
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()


def told(server: Server, run: str = "", number: int = -1) -> dict:
    return json.loads(ask(server, f"/told?run={run}&number={number}")[2])


def shapes(server: Server, version: int) -> tuple[dict, np.ndarray]:
    data = ask(server, f"/shapes/{version}")[2]
    length = int.from_bytes(data[:4], "little")
    return json.loads(data[4 : 4 + length]), np.frombuffer(data[4 + length :], "<f4")


def test_the_page_and_its_parts_are_there():
    with shown(scene()) as server:
        status, headers, body = ask(server, "/")
        assert status == 200 and b"/main.js" in body and "default-src 'none'" in headers["Content-Security-Policy"]
        for name in ("main.js", "sort_worker.js", "style.css", "icon.svg", "picture.js"):
            assert ask(server, f"/{name}")[0] == 200
        for path in (
            "/../cli.py",
            "/%2e%2e/cli.py",
            "//etc/passwd",
            "/page/main.js",
            "/gaussians",
            "/shapes/x",
            "/photograph/1",
        ):
            assert ask(server, path)[0] == 404


def test_what_is_drawn_is_the_scene():
    one = scene(dropped=(DroppedFrame("blurred.jpg", "too blurred"),))
    with shown(one) as server:
        now = told(server)
        assert now["gaussians"] == now["shapes"] == 1 and now["age_s"] is None
        gaussians = decode(ask(server, "/gaussians/1")[2])
        assert sorted(map(tuple, gaussians.means)) == sorted(map(tuple, one.snapshot.gaussians.means))
        text, numbers = shapes(server, 1)
        assert [each["name"] for each in text["cameras"]] == ["0.png", "1.png"]
        assert [each["photograph"] for each in text["cameras"]] == [True, False]
        assert np.allclose(np.reshape(text["cameras"][1]["T_world_camera"], (4, 4))[:3, 3], [0.2, 0, 0])
        path = next(lines for lines in text["lines"] if lines["group"] == "path")
        ends = numbers[path["at"] : path["at"] + 6 * path["count"]]
        assert np.allclose(ends, [-0.2, 0, 0, 0.2, 0, 0], atol=1e-6)
        assert {"cameras", "path", "ground"} <= {lines["group"] for lines in text["lines"]}
        small = cv2.imdecode(np.frombuffer(ask(server, "/thumbnail/1/0")[2], np.uint8), cv2.IMREAD_COLOR)
        whole = cv2.imdecode(np.frombuffer(ask(server, "/photograph/1/0")[2], np.uint8), cv2.IMREAD_COLOR)
        assert small.shape == (192, 256, 3) and whole.shape == (300, 400, 3)
        assert np.abs(whole[0, 0, ::-1].astype(int) - PICTURE[0, 0]).max() < 8
        assert [ask(server, f"/thumbnail/1/{index}")[0] for index in (1, 2, 999999999)] == [404] * 3
        assert ["Photographs left out: 1", ["left out blurred.jpg: too blurred"]] in now["said"]["sections"]


def test_what_strangers_named_is_printable_and_stays_json():
    bad = "a\x1b[31m\u202e<script>\udcff\n"
    hostile = replace(camera(0.0), name=bad)
    verdict = Verdict(Code.OK, bad, bad, (bad,), publishable=True)
    one = moment(wall(3), hostile, verdict=verdict, dropped=(DroppedFrame(bad, bad),) * 500)
    with shown(one) as server:
        words, (text, _) = told(server)["said"], shapes(server, 1)
    lines = [*words["verdict"], *(line for _, lines in words["sections"] for line in lines), text["cameras"][0]["name"]]
    assert all(line.isprintable() for line in lines) and len(lines) < 250
    assert "300 photographs were left out before:" in lines


@pytest.mark.parametrize("number", [1e-320, 5e-324, 1e-12, 1e300, 1.7e308])
def test_no_number_of_a_scene_ends_the_viewer(number):
    bounds = Bounds(number, number, number, number, make_ball(number))
    one = moment(wall(3), replace(camera(0.0), bounds=bounds), scale=Scale(True, "a ruler"))
    with shown(one) as server:
        assert "(95 % bounds)" in json.dumps(told(server))


def test_nothing_that_a_visitor_sends_is_an_order():
    with shown(scene()) as server:
        before = told(server)["number"]
        for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS", "CONNECT"):
            assert ask(server, "/told", method)[0] == 501
        assert ask(server, "/told?a=1&b=2&c=3&d=4&e=5")[0] == 400
        assert ask(server, "/", Host="evil.example")[0] == 403  # a name that was made to lead here
        assert told(server)["number"] == before


def test_with_a_key_only_who_has_it_sees_anything():
    with shown(scene(), KEY) as server:
        for path in ("/", "/main.js", "/told", "/gaussians/1", "/photograph/1/0", "/?key=wrong", "/?key="):
            assert ask(server, path)[0] == 401
        status, headers, _ = ask(server, f"/?key={KEY}")
        assert status == 303 and headers["Location"] == "/"
        cookie = headers["Set-Cookie"]
        assert "HttpOnly" in cookie and "SameSite=Lax" in cookie
        assert ask(server, "/", Cookie=cookie.split(";")[0])[0] == 200
        assert ask(server, "/gaussians/1", Authorization=f"Bearer {KEY}")[0] == 200


def test_news_reach_who_waits_and_say_what_is_new():
    board, heard = Board(), []
    server = Server(board, "127.0.0.1", 0, None)
    server.start()
    try:
        first = Content(scene(), None)
        board.publish({"state": "one"}, first, live=True)
        one = told(server)
        waiter = threading.Thread(target=lambda: heard.append(told(server, one["run"], one["number"])))
        waiter.start()
        time.sleep(0.2)
        assert not heard  # nothing is new
        board.publish({"state": "one"}, first, live=True)
        time.sleep(0.1)
        assert not heard  # nor is the same
        board.publish({"state": "two"}, first, live=True)
        waiter.join(5)
        assert heard[0]["said"] == {"state": "two"} and (heard[0]["gaussians"], heard[0]["shapes"]) == (1, 1)
        board.publish({"state": "two"}, Content(first.moment, None), live=True)  # only its advice is another
        assert (told(server)["gaussians"], told(server)["shapes"]) == (1, 2)
        board.publish({"state": "two"}, Content(scene(7), None), live=True)
        now = told(server, "another", one["number"])
        assert (now["gaussians"], now["shapes"]) == (2, 3) and now["age_s"] is not None
        assert ask(server, "/gaussians/1")[0] == 404 and len(ask(server, "/gaussians/2")[2]) == 49 * 32
    finally:
        server.shutdown()
        server.server_close()


def test_visitors_who_misbehave_stop_nothing(monkeypatch, caplog):
    monkeypatch.setattr(server_module, "_HEAD_S", 0.5)
    with shown(scene()) as server, contextlib.ExitStack() as stack:
        address = server.server_address[:2]

        def connect() -> socket.socket:
            return stack.enter_context(socket.create_connection(address, timeout=10))

        for rubbish in RUBBISH:
            connection = connect()
            with contextlib.suppress(OSError):
                connection.sendall(rubbish)
                connection.shutdown(socket.SHUT_WR)
        leaves = connect()
        leaves.sendall(b"GET /gaussians/1 HTTP/1.0\r\nHost: localhost\r\n\r\n")
        leaves.close()
        silent = [connect() for _ in range(100)]  # more than are served at a time
        silent[0].settimeout(5)
        assert silent[0].recv(1) == b""  # it has had its time
        deadline = time.monotonic() + 5
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError, http.client.HTTPException):
                if ask(server, "/told")[0] == 200:
                    break
        assert told(server)["said"]["good"] is True
    assert not caplog.records  # that is nothing to tell anybody


@pytest.mark.parametrize("said", [b"", b"GET /told HTTP/1.1\r\nHost: "], ids=["silent", "slow"])
def test_a_crowd_of_visitors_takes_no_place_of_who_has_the_key(said):
    began = time.monotonic()
    with shown(scene(), KEY) as server, contextlib.ExitStack() as stack:
        for _ in range(2):
            for _ in range(100):
                visitor = stack.enter_context(socket.create_connection(server.server_address[:2], timeout=10))
                with contextlib.suppress(OSError):
                    visitor.sendall(said)
            assert ask(server, "/told", Authorization=f"Bearer {KEY}")[0] == 200
            assert len(server._visitors) <= server_module._MOST_VISITORS
    assert time.monotonic() - began < 15  # nobody waits until strangers have had their time


def test_who_waits_for_news_takes_no_place_of_strangers_and_is_one_of_few(monkeypatch):
    monkeypatch.setattr(server_module, "_MOST_REQUESTS", 1)
    monkeypatch.setattr(server_module, "_WAIT_S", 1.0)
    with shown(scene(), KEY) as server:
        now = json.loads(ask(server, "/told", Authorization=f"Bearer {KEY}")[2])
        waits = threading.Thread(
            target=ask,
            args=(server, f"/told?run={now['run']}&number={now['number']}"),
            kwargs={"Authorization": f"Bearer {KEY}"},
        )
        waits.start()
        time.sleep(0.3)
        assert ask(server, "/told", Authorization=f"Bearer {KEY}")[0] == 503
        assert ask(server, "/told")[0] == 401
        waits.join()
        wait_for(lambda: ask(server, "/told", Authorization=f"Bearer {KEY}")[0] == 200)


def test_visitors_for_whom_no_thread_could_be_started_take_no_place_for_ever(monkeypatch, caplog):
    start, failed = threading.Thread.start, threading.Semaphore(0)

    def none(thread: threading.Thread) -> None:
        if "process_request_thread" in thread.name:
            failed.release()
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(server_module, "_MOST_REQUESTS", 2)
    with shown(scene()) as server:
        with monkeypatch.context() as short:
            short.setattr(threading.Thread, "start", none)
            for _ in range(3):
                with socket.create_connection(server.server_address[:2], timeout=20) as visitor:
                    assert visitor.recv(1) == b""
        assert failed.acquire(timeout=0) and ask(server, "/")[0] == 200
    assert "can't start new thread" in caplog.text


def test_a_port_that_is_taken_is_said():
    with shown(scene()) as server, pytest.raises(OSError, match="another program listens there. --port"):
        Server(Board(), "127.0.0.1", server.server_address[1], None)
