"""Places that the camera leaves: none is lost, none is told to be better than it is, all are finished."""

from __future__ import annotations

import json
import threading
import time
from contextlib import closing

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from splatnode.capture.frame import DroppedFrame, Frame, rename_frame
from splatnode.capture.messaging.messages import ReceivedFrame
from splatnode.capture.messaging.network import RECON_CONTROL
from splatnode.capture.messaging.pubsub import Answer, ask
from splatnode.capture.status import read_heartbeats
from splatnode.recon.daemon import checkpoint, ledger, worker
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.ingest import BATCH, ArrivedKeyframe, Inbox
from splatnode.recon.daemon.loop_closure import LoopDetector
from splatnode.recon.daemon.node import RemoveKeyframe
from splatnode.recon.daemon.output import Output
from splatnode.recon.daemon.submap import ActiveSubmap
from splatnode.recon.daemon.submap_index import SubmapIndex, SubmapState, make_submap_record
from splatnode.recon.daemon.worker import InactiveSubmaps
from splatnode.recon.result.export import read_cameras
from splatnode.recon.result.verdict import Code
from splatnode.recon.threads import BACKGROUND
from tests.capture.messaging.test_sockets import wait_for
from tests.recon.daemon.test_daemon import (
    PATIENCE_S,
    config,
    finished,
    index,
    offer_when_three_are_shown,
    peer,
    report,
    running,
)
from tests.support.exported import make_snapshot
from tests.support.synthetic import SMALL, photographs, places

__all__ = ["config", "peer"]

NEVER_S = 1e6


def is_lost(network):
    return read_heartbeats(network, only="recon")["recon"]["state"] == "lost"


@pytest.fixture
def moving(config):
    """A camera that never rests."""
    return replace(config, idle_finalize_s=NEVER_S)


def never(*_: object) -> bool:
    return False


def test_a_clean_stop_leaves_what_there_is_and_says_that_it_is_provisional(moving, peer):
    frames = photographs()[:3]
    with running(moving):
        for frame in frames:
            peer.server.offer(frame)
        peer.wait(lambda scene: len(scene.snapshot.cameras) == 3, "three cameras")
        peer.wait_for_acknowledgements()
    folder = moving.out / "scene-0001-provisional"
    assert not (moving.out / "scene-0001").exists()
    assert [camera.name for camera in read_cameras(folder / "cameras.json")] == [frame.name for frame in frames]
    verdict = report(folder)["verdict"]
    assert verdict["publishable"] and verdict["provisional"]
    (place,) = index(moving)
    assert (place["state"], place["folder"], place["provisional"]) == ("here", folder.name, True)
    assert 0.1 < place["seconds"] < PATIENCE_S and place["rss_mb"] > 100

    with running(replace(moving, idle_finalize_s=0.2)):
        peer.wait(finished(3), "three cameras, refined")
        wait_for((moving.out / "scene-0001" / "manifest.json").exists, PATIENCE_S)
    assert not report(moving.out / "scene-0001")["verdict"]["provisional"] and not folder.exists()
    (place,) = index(moving)
    assert (place["state"], place["folder"], place["provisional"]) == ("here", "scene-0001", False)


def test_while_the_scene_grows_it_is_written_at_intervals(moving, peer):
    with running(replace(moving, export_interval_s=1e-3)):
        for frame in photographs()[:3]:
            peer.server.offer(frame)
        wait_for(
            lambda: peer.server.serve(0.02) or (moving.out / "scene-0001-provisional" / "manifest.json").exists(),
            PATIENCE_S,
        )


def test_a_place_that_was_left_is_finished_while_the_camera_rests_in_another(config, peer):
    frames = places(seeds=(0, 1))
    with running(replace(config, new_submap_after=3)):
        offer_when_three_are_shown(peer, frames)
        peer.wait(lambda scene: scene.scene_id == "scene-0002" and scene.snapshot.final, "another place, finished")
        peer.wait_for_acknowledgements()
        wait_for(lambda: read_heartbeats(config.network, only="recon")["recon"]["unfinished"] == 0, PATIENCE_S)
        status = read_heartbeats(config.network, only="recon")["recon"]
        assert status["delay_s"] == 0 and status["delay"] == ""
    first, second = index(config)
    assert (first["scene_id"], first["state"], first["folder"]) == ("scene-0001", "finished", "scene-0001")
    assert (second["scene_id"], second["state"]) == ("scene-0002", "here")
    assert first["frames_used"] == [frame.name for frame in frames[:3]]
    told = {name for place in (first, second) for name in place["frames_used"]}
    told |= {dropped["name"] for place in (first, second) for dropped in place["frames_dropped"]}
    assert told == {frame.name for frame in frames}
    assert not report(config.out / "scene-0001")["verdict"]["provisional"]
    assert not (config.out / "scene-0001-provisional").exists() and ledger.list_left_folders(config.checkpoint) == []


def test_a_keyframe_is_taken_out_of_a_place_that_was_left(config, peer):
    here, there = photographs(), photographs(msgspec.structs.replace(SMALL, seed=1))
    mirrored = [replace_image(frame, index) for index, frame in enumerate(there[:3])]
    with running(replace(config, new_submap_after=3)):
        for frame in here[:4]:
            peer.server.offer(frame)
        peer.wait(finished(4), "four cameras, refined")
        for frame in mirrored:
            peer.server.offer(frame)
        peer.wait(lambda scene: scene.scene_id == "scene-0002" and finished(3)(scene), "another place, finished")
        wait_for(lambda: ledger.list_finished_folders(config.checkpoint), PATIENCE_S)
        name = here[3].name
        answer = ask(RECON_CONTROL, config.network, RemoveKeyframe(name), Answer)
        assert answer.done and "scene-0001, which the camera has left" in answer.message
        wait_for(lambda: name not in index(config)[0]["frames_used"], PATIENCE_S)
        wait_for(lambda: read_heartbeats(config.network, only="recon")["recon"]["unfinished"] == 0, PATIENCE_S)
        assert not ask(RECON_CONTROL, config.network, RemoveKeyframe("nothing.png"), Answer).done
    first, second = index(config)
    assert {each["name"]: each["reason"] for each in first["frames_dropped"]} == {name: "retracted"}
    assert first["state"] == "finished" and not first["provisional"] and second["state"] == "here"
    kept = [camera.name for camera in read_cameras(config.out / "scene-0001" / "cameras.json")]
    assert kept == [frame.name for frame in here[:3]]
    assert (
        ledger.list_left_folders(config.checkpoint) == [] and len(ledger.list_finished_folders(config.checkpoint)) == 1
    )


def replace_image(frame, index):
    """The frame seen in a mirror, by a name of its own."""
    image = np.ascontiguousarray(frame.image[:, ::-1])
    return Frame(10 + index, f"there_{index}.png", frame.stamp_ns, image, None)


def test_a_place_that_was_left_is_finished_by_the_next_process(moving, peer, monkeypatch):
    frames = places(seeds=(0, 1))
    with monkeypatch.context() as patch, running(replace(moving, new_submap_after=3)):
        patch.setattr(InactiveSubmaps, "verify_next", never)
        patch.setattr(InactiveSubmaps, "finalize_next", never)
        offer_when_three_are_shown(peer, frames)
        peer.wait(lambda scene: scene.scene_id == "scene-0002", "another place")
        peer.wait_for_acknowledgements()
    assert report(moving.out / "scene-0001-provisional")["verdict"]["provisional"]
    assert index(moving)[0]["state"] == "left" and len(ledger.list_left_folders(moving.checkpoint)) == 1

    with running(replace(moving, idle_finalize_s=0.2, new_submap_after=3)):
        wait_for((moving.out / "scene-0001" / "manifest.json").exists, PATIENCE_S)
        wait_for(lambda: not ledger.list_left_folders(moving.checkpoint), PATIENCE_S)
    kept = read_cameras(moving.out / "scene-0001" / "cameras.json")
    assert {camera.name for camera in kept} == {frame.name for frame in frames[:3]}
    assert report(moving.out / "scene-0001")["iterations"] == moving.reconstruction.optimize.iterations


def test_a_place_whose_finishing_was_killed_is_finished_by_the_next_process(config, peer, monkeypatch):
    def die(*_):
        raise SystemExit

    frames = places(seeds=(0, 1))
    with (
        monkeypatch.context() as patch,
        pytest.raises(AssertionError, match="SystemExit"),
        running(replace(config, new_submap_after=3)) as daemon,
    ):
        patch.setattr(worker, "_refine_to_end", die)
        offer_when_three_are_shown(peer, frames)
        wait_for(lambda: peer.server.serve(0.02) or not daemon.is_alive(), PATIENCE_S)
    assert (config.out / "scene-0001-provisional").exists() and not (config.out / "scene-0001").exists()

    with running(replace(config, new_submap_after=3)):
        wait_for(lambda: not ledger.list_left_folders(config.checkpoint), PATIENCE_S)
    assert [(place["state"], place["provisional"]) for place in index(config)] == [("finished", False), ("here", False)]


def test_a_place_that_cannot_be_finished_keeps_no_other_waiting(config, peer, monkeypatch):
    def fail(*_):
        raise ArithmeticError("for the test")

    frames = places(seeds=(0, 1))
    monkeypatch.setattr(worker, "_refine_to_end", fail)
    with running(replace(config, new_submap_after=3)):
        offer_when_three_are_shown(peer, frames)
        wait_for(
            lambda: (
                peer.server.serve(0.02)
                or "for the test" in read_heartbeats(config.network, only="recon")["recon"]["problem"]
            ),
            PATIENCE_S,
        )
        status = read_heartbeats(config.network, only="recon")["recon"]
        assert status["state"] == "idle" and status["unfinished"] == 1
    assert report(config.out / "scene-0001-provisional")["verdict"]["provisional"]


def test_what_comes_while_a_left_place_is_finished_is_shown_at_once(config, peer, monkeypatch):
    begun, shown = threading.Event(), threading.Event()
    last = worker._refine_to_end

    def slow(work, recipe, run):
        begun.set()
        while not shown.is_set():
            run.pause()
            time.sleep(0.01)
        return last(work, recipe, run)

    monkeypatch.setattr(worker, "_refine_to_end", slow)
    frames = places(msgspec.structs.replace(SMALL, views=8))
    with running(replace(config, new_submap_after=3)):
        offer_when_three_are_shown(peer, [*frames[:3], *frames[4:7]])
        wait_for(lambda: peer.server.serve(0.02) or begun.is_set(), PATIENCE_S)
        peer.server.offer(frames[7])
        scene = peer.wait(lambda scene: frames[7].name in {each.name for each in scene.snapshot.cameras}, "the further")
        assert scene.scene_id == "scene-0002" and not (config.out / "scene-0001").exists()
        shown.set()
        wait_for((config.out / "scene-0001" / "manifest.json").exists, PATIENCE_S)
    assert index(config)[0]["frames_used"] == [frame.name for frame in frames[:3]]


def test_keyframes_are_worked_in_a_few_at_a_time():
    inbox, stopping = Inbox(), threading.Event()
    for number in range(2 * BATCH + 1):
        inbox.enqueue([ArrivedKeyframe(None, float(number))], stopping)  # pyright: ignore[reportArgumentType]
    assert inbox.oldest_s == 0.0
    assert [len(inbox.dequeue(0)) for _ in range(4)] == [BATCH, BATCH, 1, 0]
    assert inbox.oldest_s is None


def test_room_is_made_only_for_what_fits(moving, peer):
    ours, others = photographs()[:4], places(seeds=(0, 1))[3:5]
    with running(replace(moving, max_views=4)):
        for frame in ours:
            peer.server.offer(frame)
        peer.wait(lambda scene: len(scene.snapshot.cameras) == 4, "four cameras")
        for number, frame in enumerate(others):
            peer.server.offer(rename_frame(frame, 4 + number, f"other{number}.png", 4 + number))
        wait_for(
            lambda: peer.server.serve(0.02) or is_lost(moving.network),
            PATIENCE_S,
        )
    (place,) = index(moving)
    assert place["frames_used"] == [frame.name for frame in ours]


def test_a_scene_that_is_full_goes_on_as_the_next_one_and_both_are_linked(config, peer):
    frames = photographs()
    with running(replace(config, max_views=4)):
        for count, frame in enumerate(frames, 1):
            peer.server.offer(frame)
            if count >= 3:
                peer.wait(
                    lambda scene, frame=frame: frame.name in {each.name for each in scene.snapshot.cameras}, frame.name
                )
        peer.wait_for_acknowledgements()
        wait_for(lambda: not ledger.list_left_folders(config.checkpoint) and final(config) == 2, PATIENCE_S)
    first, second = index(config)
    names = [frame.name for frame in frames]
    assert set(first["frames_used"]) | set(second["frames_used"]) == set(names)
    assert not first["frames_dropped"] and not second["frames_dropped"]
    (link,) = json.loads((config.out / "places.json").read_text())["links"]
    assert (link["scene"], link["other"]) == ("scene-0001", "scene-0002")
    assert set(link["shared"]) == set(first["frames_used"]) & set(second["frames_used"]) and len(link["shared"]) >= 3
    assert link["rotation_deg"] < 0.5 and link["centre_percent"] < 3
    cameras = {
        each: {camera.name: camera.T_world_camera[:3, 3] for camera in read_cameras(config.out / each / "cameras.json")}
        for each in ("scene-0001", "scene-0002")
    }
    for name in link["shared"]:
        there = link["scale"] * np.array(link["rotation"]) @ cameras["scene-0002"][name] + link["translation"]
        np.testing.assert_allclose(there, cameras["scene-0001"][name], atol=0.02)


def test_what_was_set_aside_before_stays_with_the_scene_that_is_left(moving, peer, monkeypatch):
    ours, (stranger, *_) = photographs(), places(seeds=(0, 1))[3:]
    came = [*ours[:3], rename_frame(stranger, 3, "stranger.png", 3)]
    came += [rename_frame(frame, 4 + number, frame.name, 4 + number) for number, frame in enumerate(ours[3:])]
    aside: list[list[str]] = []
    monkeypatch.setattr(
        ActiveSubmap,
        "export_provisionally",
        lambda place: aside.append([each.name for each in place._work.keyframes_deferred]),
    )
    with running(replace(moving, max_views=5, export_interval_s=NEVER_S)):
        for count, frame in enumerate(came, 1):
            peer.server.offer(frame)
            if frame.name == "stranger.png":
                wait_for(
                    lambda: peer.server.serve(0.02) or is_lost(moving.network),
                    PATIENCE_S,
                )
            elif count >= 3:
                peer.wait(
                    lambda scene, frame=frame: frame.name in {each.name for each in scene.snapshot.cameras}, frame.name
                )
        peer.wait_for_acknowledgements()
    assert aside == [[]]  # at the stop
    with closing(Store(moving.checkpoint)) as store:
        assert store.scene_id == "scene-0002" and store.names == {frame.name for frame in ours[3:]}
        assert checkpoint.restore(store, moving.reconstruction).work.find_reconstruction() is not None
    with closing(Store(ledger.find_folder(moving.checkpoint, "scene-0001"))) as store:
        assert "stranger.png" in store.names


def test_a_place_that_turns_out_to_be_two_becomes_two(config):
    """Such as one in which there was no scene until the camera was elsewhere."""
    with closing(Store(config.checkpoint)) as store:
        frames = places(seeds=(0, 1))
        for number, frame in enumerate(frames):
            store.add_frame(ReceivedFrame("0" * 32, number, frame))
        store.leave_submap(len(frames))
        output = Output(config, store, lambda _: None, pytest.fail)
        atlas = LoopDetector(store.directory, config.reconstruction, output.index)
        waiting = InactiveSubmaps(store, config.reconstruction, output, atlas)
        assert waiting.verify_next(BACKGROUND)
        first, part = [folder.name for folder in ledger.list_left_folders(config.checkpoint)]
        ours, other = by_id(config)
        assert first == ours["scene_id"] == "scene-0001" and part == other["scene_id"] and ours["judged"]
        assert {each["reason"] for each in ours["frames_dropped"]} == {f"it shows another place: {part}"}
        assert {each["name"] for each in ours["frames_dropped"]} == {each["name"] for each in other["frames_dropped"]}
        assert not other["judged"]
        assert waiting.verify_next(BACKGROUND) and not waiting.verify_next(BACKGROUND)
        ours, other = by_id(config)
        names = [frame.name for frame in frames]
        assert other["judged"] and sorted([ours["frames_used"], other["frames_used"]]) == [names[:3], names[3:]]
        assert output.index.links == ()


def by_id(config) -> list[dict]:
    return sorted(index(config), key=lambda place: place["scene_id"])


def final(config) -> int:
    """How many places are told to be final."""
    return sum(not place["provisional"] for place in index(config)) if (config.out / "places.json").exists() else 0


def test_an_index_of_another_checkpoint_or_a_damaged_one_begins_anew(tmp_path):
    place = make_submap_record(
        "scene-0001", SubmapState.HERE, "scene-0001", make_snapshot(), [], [DroppedFrame("a.png", "blurred")]
    )
    SubmapIndex(tmp_path, "one").update(place)
    SubmapIndex(tmp_path, "one").mark_finished("scene-0001")
    assert '"finished"' in (tmp_path / "places.json").read_text()
    SubmapIndex(tmp_path, "other").update(
        make_submap_record("scene-0007", SubmapState.HERE, None, make_snapshot(), [], [])
    )
    assert "scene-0001" not in (tmp_path / "places.json").read_text()
    (tmp_path / "places.json").write_bytes(np.random.default_rng(0).bytes(100))
    SubmapIndex(tmp_path, "one").update(place)
    assert "blurred" in (tmp_path / "places.json").read_text()


def test_a_node_that_goes_on_in_another_frame_of_reference_says_so(tmp_path, caplog):
    place = make_submap_record("scene-0001", SubmapState.HERE, "scene-0001", make_snapshot(), [], [])
    SubmapIndex(tmp_path, "one", "base").update(place)
    SubmapIndex(tmp_path, "one", "base").mark_finished("scene-0001")
    assert '"base"' in (tmp_path / "places.json").read_text() and not caplog.records
    SubmapIndex(tmp_path, "other")
    assert not caplog.records, "the results of another checkpoint are not its own"
    SubmapIndex(tmp_path, "one").update(place)
    assert "were in the frame base; from now on they are in the default frame: give --frame base" in caplog.text
    assert '"base"' not in (tmp_path / "places.json").read_text()
    caplog.clear()
    SubmapIndex(tmp_path, "one", "upright")
    assert "from now on they are in the frame upright: give no --frame" in caplog.text


def test_a_scene_that_was_refused_has_no_cameras_and_this_is_no_fault(tmp_path, caplog):
    """Such as one whose frame of reference is not known yet: its folder has a report alone."""
    places = SubmapIndex(tmp_path, "one")
    refused = make_snapshot(Code.FRAME_UNKNOWN, publishable=False)
    (tmp_path / "scene-0001-provisional").mkdir()
    places.update(make_submap_record("scene-0001", SubmapState.LEFT, "scene-0001-provisional", refused, [], []))
    assert places.load_cameras("scene-0001") == {} and not caplog.records
    known = make_snapshot()
    places.update(make_submap_record("scene-0001", SubmapState.LEFT, "scene-0001-provisional", known, [], []))
    assert places.load_cameras("scene-0001") == {} and "cannot be read" in caplog.text
