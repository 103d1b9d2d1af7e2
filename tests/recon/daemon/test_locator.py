"""Where clients took their images, in a scene that grows: provisional, with bounds, and withdrawn with the scene."""

from __future__ import annotations

import threading
import time
from dataclasses import replace as changed

import numpy as np
import pytest
from msgspec.structs import replace

import splatnode
from splatnode.capture.cameras import synthetic
from splatnode.capture.messaging.messages import Message, WireError, decode, encode, make_jpeg_array
from splatnode.capture.messaging.network import RECON_LOCATE, Network
from splatnode.capture.messaging.pubsub import QueryClient, QueryServer
from splatnode.capture.process.terminal import Problems
from splatnode.recon.daemon import REBUILT, relocalization
from splatnode.recon.daemon.relocalization import LocatableScene, Locator, LocatorConfig
from splatnode.recon.geometry import align_cameras
from splatnode.recon.locating import (
    QUERY_LIMITS,
    LocalizationBounds,
    LocateAnswer,
    Located,
    LocateRequest,
    NotLocated,
    Reason,
    decode_query_image,
    make_outcome_records,
    parse_outcome,
)
from tests.recon.daemon.test_daemon import PATIENCE_S, config, finished, peer, running  # noqa: F401
from tests.support.exported import make_snapshot
from tests.support.synthetic import SMALL, photographs

LIVE = LocatorConfig(live=True)
IMAGE = np.zeros((48, 64, 3), np.uint8)


def located() -> Located:
    claim = LocalizationBounds(0.5, 0.01, 1.0, 2.0)
    return Located(np.eye(4), np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), np.eye(6), claim, 40, False)


def wait_until(peer, what) -> None:  # noqa: F811
    deadline = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < deadline
        peer.server.serve(0.01)
        peer.client.poll(0.02)


def test_an_image_is_located_while_the_scene_grows_and_withdrawn_when_it_is_made_afresh(config, peer):  # noqa: F811
    frames, query = photographs(), synthetic.evaluation_cameras(SMALL)[1]
    image = synthetic.render_image(SMALL, query)
    slow = replace(config, localization=LIVE, idle_finalize_s=3.0)
    with running(slow), splatnode.connect(config.network.directory) as node:
        early = node.localise(image)
        assert early.found is None and "no scene" in early.why and node.find_withdrawal(early) == early.why
        for frame in frames[:3]:
            peer.server.offer(frame)
        scene = peer.wait(lambda scene: len(scene.snapshot.cameras) == 3, "a scene of three")
        assert not scene.snapshot.final
        told = node.localise(image, intrinsics=frames[0].intrinsics)
        assert isinstance(told.found, Located) and told.provisional and told.scene_id == scene.scene_id
        again = node.localise(image, intrinsics=frames[0].intrinsics, follows=True)
        assert isinstance(again.found, Located) and again.revision == told.revision
        assert not node.find_withdrawal(told)
        for each in (told.found, again.found):  # within its bounds of where it was taken, by the scene's own cameras
            shown = {camera.name: camera.T_world_camera for camera in scene.snapshot.cameras}
            numbers = [camera.frame_id for camera in scene.snapshot.cameras]
            true = np.stack([synthetic.scene_cameras(SMALL)[number][0] for number in numbers])
            by = align_cameras(true, np.stack(list(shown.values())))
            off = np.linalg.norm(by.camera(query[0])[:3, 3] - each.T_world_camera[:3, 3])
            assert off < each.claim.centre + 0.02 and each.claim.rotation_deg < 5
        peer.wait(finished(3), "a final scene")
        wait_until(peer, lambda: node.find_withdrawal(told) == REBUILT)
        final = node.localise(image)
        assert isinstance(final.found, Located) and not final.provisional and final.revision > told.revision
        assert not node.find_withdrawal(final)
        black = node.localise(np.zeros_like(image))
        assert isinstance(black.found, NotLocated) and black.found.code is Reason.NOT_FOUND


def test_a_node_that_does_not_offer_it_is_named_with_what_to_set(tmp_path):
    (tmp_path / "run").mkdir(mode=0o700)
    with splatnode.connect(tmp_path / "run") as node, pytest.raises(TimeoutError, match="localization: {live: true}"):
        node.localise(IMAGE, timeout_s=0.1)


@pytest.mark.parametrize("found", [located(), NotLocated(Reason.ONE_PATCH, "One spot.", "Show more.")])
def test_an_answer_tells_the_outcome_as_it_is(found):
    answer = LocateAnswer(7, "scene-0001", "a" * 32, 3, 2, True, **make_outcome_records(found))
    again = parse_outcome(decode(encode(answer), LocateAnswer).header)
    if isinstance(found, NotLocated):
        assert again == found
        return
    assert isinstance(again, Located) and again.claim == found.claim and again.lens is found.lens
    assert np.array_equal(again.K, found.K) and np.array_equal(again.covariance, found.covariance)


def test_a_camera_that_is_none_and_a_request_without_an_image_are_refused():
    with pytest.raises(ValueError, match="rigid motion"):
        make_outcome_records(changed(located(), T_world_camera=2.0 * np.eye(4)))
    with pytest.raises(WireError, match="one array, the bytes of a JPEG file"):
        decode_query_image(Message(LocateRequest(1)))


def test_the_last_image_tells_where_to_look_only_in_the_same_world_and_only_if_it_is_asked(tmp_path, monkeypatch):
    calls: list[str] = []
    monkeypatch.setattr(relocalization, "follow", lambda *_: calls.append("follow") or located())
    monkeypatch.setattr(relocalization, "localize_image", lambda *_: calls.append("anywhere") or located())
    monkeypatch.setattr(relocalization.Locator, "_gather_landmarks", lambda *_: object())
    (tmp_path / "run").mkdir(mode=0o700)
    server = Locator(Network(directory=tmp_path / "run"), Problems(), threading.Event())
    try:
        for revision, follows in ((1, True), (1, True), (1, False), (2, True), (2, True)):
            server.show(LocatableScene(make_snapshot(), "a", "a" * 32, 0, revision, True, None))
            server._answer(b"client", Message(LocateRequest(1, None, follows), (make_jpeg_array(IMAGE, 90),)))
    finally:
        server.close()
    assert calls == ["anywhere", "follow", "anywhere", "anywhere", "follow"]


def test_what_fails_for_one_image_is_told_and_no_other_is_harmed(tmp_path, monkeypatch):
    (tmp_path / "run").mkdir(mode=0o700)
    problems = Problems()
    server = Locator(Network(directory=tmp_path / "run"), problems, threading.Event())
    try:
        server.show(LocatableScene(make_snapshot(), "a", "a" * 32, 0, 1, True, None))
        image = Message(LocateRequest(1), (make_jpeg_array(IMAGE, 90),))
        assert server._answer(b"x", image).why == relocalization.UNKNOWN
        monkeypatch.setattr(relocalization.Locator, "_gather_landmarks", lambda *_: object())
        assert server._answer(b"x", Message(LocateRequest(1), (np.zeros(3, np.uint8),))).why
        monkeypatch.setattr(relocalization, "localize_image", lambda *_: 1 / 0)
        assert server._answer(b"x", image).why == "the node failed; see its log" and "located" in str(problems)
    finally:
        server.close()


def test_an_answer_to_an_earlier_request_is_passed_over_and_of_several_the_newest_is_answered(tmp_path):
    (tmp_path / "run").mkdir(mode=0o700)
    network = Network(directory=tmp_path / "run")
    with QueryServer(RECON_LOCATE, network, LocateRequest, QUERY_LIMITS) as server:
        client = QueryClient(RECON_LOCATE, network, LocateAnswer)
        found: list[LocateAnswer] = []
        asking = threading.Thread(target=lambda: found.append(client.ask(LocateRequest(2), [], 20.0)))
        asking.start()
        try:
            requests = []
            while not requests:
                requests = server.receive(0.2)
            ((identity, message),) = requests
            assert message.header.number == 2
            for number in (1, 2):
                server.reply(identity, LocateAnswer(number, "none", "0" * 32, 0, 0, True))
            server.reply(b"gone", LocateAnswer(3, "none", "0" * 32, 0, 0, True))
        finally:
            asking.join()
            client.close()
    assert [each.number for each in found] == [2]
