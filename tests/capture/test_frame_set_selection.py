"""Live, what one camera takes is taken of all: before or after it came, in one process or in several."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode.capture.config import CaptureConfig
from splatnode.capture.daemon import CaptureSession
from splatnode.capture.frame import Clock, Frame, Stamp
from splatnode.capture.keyframe_selection import MOST_HELD, TOGETHER, FrameSetSelection
from splatnode.capture.messaging.keyframe_queue import KeyframeServer, Spool
from splatnode.capture.process.config import parse_config
from splatnode.capture.reader import ReaderState
from splatnode.capture.rig import form_frame_sets

SMALL = np.zeros((12, 16, 3), np.uint8)


def frame(camera_id: str, ms: int, image: np.ndarray = SMALL) -> Frame:
    at = Stamp(ms * 1_000_000, Clock.UTC)
    return Frame(0, f"{camera_id}_{ms}", ms * 1_000_000, image, None, captured_at=at, camera_id=camera_id)


def stamp(ms: int) -> Stamp:
    return Stamp(ms * 1_000_000, Clock.UTC)


def test_what_came_before_is_the_nearest_of_each_camera_that_took_none():
    selection = FrameSetSelection(0.02)
    for each in (frame("right", 85), frame("right", 98), frame("right", 115), frame("rear", 130)):
        selection.hold(each)
    (found,) = selection.want(stamp(100), "left")
    assert found.name == "right_98"
    selection.mark_taken(found)
    assert selection.want(stamp(100), "front") == [], "right has given one"
    assert selection.want(Stamp(130_000_000, Clock.RECORDING)) == [], "another clock"
    assert selection.is_wanted(frame("rear", 110)) and not selection.is_wanted(frame("right", 110))


def test_what_comes_after_is_wanted_once_and_not_where_the_camera_took_one_by_itself():
    selection = FrameSetSelection(0.02)
    selection.mark_taken(frame("right", 95))
    assert selection.want(stamp(100), "left") == []
    assert not selection.is_wanted(frame("right", 105)) and not selection.is_wanted(frame("left", 105))
    assert selection.is_wanted(frame("rear", 105)) and not selection.is_wanted(frame("rear", 125))
    selection.mark_taken(frame("rear", 105))
    assert not selection.is_wanted(frame("rear", 106))


def test_memory_is_bounded_and_a_tolerance_of_zero_wants_nothing():
    selection, off = FrameSetSelection(10.0), FrameSetSelection(0.0)
    for ms in range(1000):
        selection.hold(frame("right", ms))
        off.hold(frame("right", ms))
        selection.want(stamp(ms), "right")
    assert len(selection._held["right"]) == MOST_HELD and len(selection._wanted) <= 32
    assert off.want(stamp(5)) == [] and not off.is_wanted(frame("left", 5)) and not off._held


@pytest.fixture
def texture() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (45, 400, 3)).astype(np.uint8)
    return cv2.GaussianBlur(np.kron(noise, np.ones((6, 6, 1), np.uint8)), (5, 5), 1.0)


def photograph(texture: np.ndarray, offset: int) -> np.ndarray:
    return np.ascontiguousarray(texture[:, offset : offset + 320])


def open_session(folder: Path, camera_id: str, resources: ExitStack, most: int = 200, **selection) -> CaptureSession:
    given = {
        "camera": {"kind": "synthetic"}, "camera_id": camera_id, "selection": selection, "preview": {"fps": 0.0},
        "spool": {"directory": str(folder / "state"), "max_frames": most},
        "network": {"directory": str(folder / "run")},
    }  # fmt: skip
    config = parse_config(given, CaptureConfig)
    server = KeyframeServer(config.network, Spool(config.spool, camera_id), camera_id)
    return CaptureSession(config, resources.enter_context(server), resources)


def walk(texture: np.ndarray) -> Iterator[tuple[Frame, Frame]]:
    """The left camera's image moves 30 pixels a step, the right one's 9: by itself it would be taken every third."""
    for step in range(12):
        ms = 200 * step
        yield (
            frame("left", ms, photograph(texture, 30 * step)),
            frame("right", ms + 4, photograph(texture[::-1], 9 * step)),
        )


def record(offer: Callable[[Frame], object], taken: list[Frame]) -> Callable[[Frame], object]:
    """Makes `offer` write down what it gets."""

    def offer_and_record(item: Frame) -> object:
        taken.append(item)
        return offer(item)

    return offer_and_record


@pytest.mark.parametrize("right_first", [False, True])
def test_two_captures_take_whole_frame_sets(texture, tmp_path, monkeypatch, right_first):
    taken: dict[str, list[Frame]] = {"left": [], "right": []}
    with ExitStack() as resources:
        sessions = {each: open_session(tmp_path, each, resources) for each in taken}
        for each, session in sessions.items():
            offer = session._server.offer
            monkeypatch.setattr(session._server, "offer", record(offer, taken[each]))
        for left, right in walk(texture):
            for each in (right, left) if right_first else (left, right):
                sessions[each.camera_id].serve()
                sessions[each.camera_id].take(each, ReaderState.STREAMING)
            for session in sessions.values():
                session.serve()
    everyone = [each for of in taken.values() for each in of]
    sets = form_frame_sets([(each.name, each.camera_id, each.captured_at) for each in everyone if each.captured_at])
    assert len(sets) > 5 and all(len(each.names) == 2 for each in sets)


def test_one_process_with_two_cameras_takes_whole_frame_sets(texture, tmp_path, monkeypatch):
    taken, reasons = list[Frame](), set[str]()
    with ExitStack() as resources:
        session = open_session(tmp_path, "", resources)
        offer = session._server.offer
        monkeypatch.setattr(session._server, "offer", record(offer, taken))
        for pair in walk(texture):
            decisions = [session.push(each) for each in pair]
            assert decisions[0].take == decisions[1].take
            reasons.add(decisions[1].reason)
    assert len(taken) > 10 and TOGETHER in reasons


def test_each_camera_selects_by_itself_where_it_is_told_to(texture, tmp_path):
    with ExitStack() as resources:
        sessions = {
            each: open_session(tmp_path, each, resources, frame_set_tolerance_s=0.0) for each in ("left", "right")
        }
        for pair in walk(texture):
            for each in pair:
                sessions[each.camera_id].take(each, ReaderState.STREAMING)
                sessions[each.camera_id].serve()
    assert sessions["right"].keyframes < sessions["left"].keyframes


def test_no_part_of_a_frame_set_is_kept_where_one_camera_has_no_room(texture, tmp_path):
    """The left spool holds three keyframes; nobody takes them. Once one is taken, whole sets are kept again."""
    with ExitStack() as resources:
        left, right = (open_session(tmp_path, each, resources, most=most) for each, most in (("left", 3), ("right", 9)))
        pairs = list(walk(texture))

        def take(pair):
            for each, session in zip(pair, (left, right), strict=True):
                session.take(each, ReaderState.STREAMING)
                session.serve()
                (right if session is left else left).serve()

        for pair in pairs[:8]:
            take(pair)
        assert left._server.num_queued == 3 and right._server.num_queued <= 4 and right.not_taken > 0
        assert "another camera is full" in right._spool_full
        left._server.spool.remove(next(iter(left._server.spool)))
        left.serve()
        right._link._full_s = -math.inf  # two seconds later
        before = right._server.num_queued
        take((frame("left", 60_000, photograph(texture, 600)), frame("right", 60_004, photograph(texture, 900))))
        assert left._server.num_queued == 3 and right._server.num_queued == before + 1
