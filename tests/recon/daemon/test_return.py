"""A camera that is carried to another place and back: the first place is recognised, also by the next process."""

from __future__ import annotations

import json
from contextlib import closing, contextmanager

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame
from splatnode.capture.messaging.messages import ReceivedFrame
from splatnode.capture.status import read_heartbeats
from splatnode.extras.evaluate.protocol import compare_cameras
from splatnode.recon.daemon import checkpoint, ledger
from splatnode.recon.daemon import loop_closure as module
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.loop_closure import LoopDetector, compute_global_descriptors, make_descriptors_message
from splatnode.recon.daemon.submap_index import SubmapIndex
from splatnode.recon.daemon.worker import InactiveSubmaps
from splatnode.recon.estimation import prepare
from splatnode.recon.geometry import Similarity
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.result.export import read_cameras
from splatnode.recon.threads import BACKGROUND
from tests.capture.messaging.test_sockets import wait_for
from tests.recon.daemon.test_daemon import PATIENCE_S, config, finished, peer, running
from tests.support.synthetic import SMALL, photographs, places

__all__ = ["config", "peer"]

THERE = msgspec.structs.replace(SMALL, views=3)  # as tests/support/synthetic.py photographs each of two places
AGAIN = synthetic.evaluation_cameras(msgspec.structs.replace(SMALL, views=4))


def walk() -> list[Frame]:
    """Three photographs of one place, three of another, three of the first from elsewhere."""
    photographs = [synthetic.render_image(SMALL, camera, 20 + index) for index, camera in enumerate(AGAIN)]
    again = [Frame(6 + index, f"again_{index}.png", 0, image, None) for index, image in enumerate(photographs)]
    return [*places(seeds=(0, 1)), *again]


def offer_walk(peer) -> None:
    """Until the daemon has shown all three scenes."""
    for number, begin in enumerate((0, 3, 6), 1):
        for frame in walk()[begin : begin + 3]:
            peer.server.offer(frame)
        peer.wait(
            lambda scene, number=number: scene.scene_id == f"scene-{number:04d}" and finished(3)(scene),
            f"scene {number}",
        )
    peer.wait_for_acknowledgements()


@contextmanager
def walked(config, peer):
    """The daemon, once it has shown all three scenes and finished the two that were left."""
    with running(config):
        offer_walk(peer)
        wait_for(lambda: read_heartbeats(config.network, only="recon")["recon"]["unfinished"] == 0, PATIENCE_S)
        yield


def places_file(config) -> dict:
    return json.loads((config.out / "places.json").read_text())


@pytest.fixture
def kidnapped(config):
    return replace(config, new_submap_after=3)


def test_a_place_that_the_camera_comes_back_to_is_recognised(kidnapped, peer):
    with walked(kidnapped, peer):
        wait_for(lambda: places_file(kidnapped)["links"], PATIENCE_S)
        wait_for(lambda: read_heartbeats(kidnapped.network, only="recon")["recon"]["loops"] == 1, PATIENCE_S)
        status = read_heartbeats(kidnapped.network, only="recon")["recon"]
        assert (status["scenes"], status["maps"]) == (3, 2)
    (link,) = places_file(kidnapped)["links"]
    assert (link["kind"], link["scene"], link["other"]) == ("loop", "scene-0001", "scene-0003")
    assert "pairs of photographs show the same" in link["why"] and link["retracted"] is None
    poses = {pose["scene"]: pose for pose in places_file(kidnapped)["poses"]}
    assert [poses[f"scene-000{number}"]["map"] for number in (1, 2, 3)] == ["scene-0001", "scene-0002", "scene-0001"]

    cameras = {}
    for scene in ("scene-0001", "scene-0003"):
        pose = poses[scene]
        there = Similarity(pose["scale"], np.array(pose["rotation"]), np.array(pose["translation"]))
        for camera in read_cameras(kidnapped.out / scene / "cameras.json"):
            cameras[camera.name] = there.camera(camera.T_world_camera)
    true = [T for T, _ in (*synthetic.scene_cameras(THERE), *AGAIN)]
    K = np.stack([AGAIN[0][1]] * len(true))
    names = [frame.name for frame in (*walk()[:3], *walk()[6:])]
    errors = compare_cameras(np.stack([cameras[name] for name in names]), np.stack(true), K, K)
    assert errors.rotation_deg < 1.5 and errors.centre_pct < 8, errors


def test_it_is_recognised_before_any_scene_is_made_and_the_loop_stays_when_they_are(kidnapped, peer, monkeypatch):
    with monkeypatch.context() as patch, running(kidnapped):
        patch.setattr(InactiveSubmaps, "finalize_next", lambda *_: False)
        offer_walk(peer)
        wait_for(lambda: places_file(kidnapped)["links"], PATIENCE_S)
        wait_for(lambda: read_heartbeats(kidnapped.network, only="recon")["recon"]["scenes"] == 3, PATIENCE_S)
    drafts = places_file(kidnapped)
    assert [place["judged"] for place in drafts["places"]] == [True] * 3
    assert [folder.name for folder in ledger.list_left_folders(kidnapped.checkpoint)] == ["scene-0001", "scene-0002"]
    with running(kidnapped):
        wait_for(lambda: not ledger.list_left_folders(kidnapped.checkpoint), PATIENCE_S)
        wait_for(lambda: read_heartbeats(kidnapped.network, only="recon")["recon"]["unfinished"] == 0, PATIENCE_S)
    whole = places_file(kidnapped)
    assert not any(place["provisional"] for place in whole["places"])
    (before,), (link,) = drafts["links"], whole["links"]
    assert (link["kind"], link["scene"], link["other"], link["why"]) == (
        "loop",
        "scene-0001",
        "scene-0003",
        before["why"],
    )


def test_it_is_recognised_by_the_next_process_where_the_first_one_was_killed(kidnapped, peer, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(
            LoopDetector, "detect_loops", lambda _, scene, graph, run: compute_global_descriptors(graph.keyframes)
        )  # with no other
        with walked(kidnapped, peer):
            pass
    assert places_file(kidnapped)["links"] == []
    assert [folder.name for folder in ledger.list_finished_folders(kidnapped.checkpoint)] == [
        "scene-0001",
        "scene-0002",
    ]
    with running(kidnapped):
        wait_for(lambda: places_file(kidnapped)["links"], PATIENCE_S)
    (link,) = places_file(kidnapped)["links"]
    assert (link["kind"], link["scene"], link["other"]) == ("loop", "scene-0001", "scene-0003")


@pytest.mark.parametrize("file", ["graph", "ledger", "codes"])
def test_a_finished_place_whose_files_are_damaged_is_not_recognised_and_stops_nothing(kidnapped, tmp_path, file):
    """Other places are recognised: here one with the same photographs."""
    config = msgspec.structs.replace(kidnapped.reconstruction)
    frames = list(photographs())[:4]
    for place in ("scene-0001", "scene-0002"):
        with closing(Store(tmp_path / "checkpoint" / "left" / place)) as store:
            work = IncrementalReconstruction(config)
            for number, frame in enumerate(frames):
                store.add_frame(ReceivedFrame("0" * 32, number, frame))
                work.add_keyframe(prepare(frame, config))
            work.match_pending_pairs()
            checkpoint.save(store, work, final=False)
            store.save(
                "codes",
                *make_descriptors_message(work.graph.keyframes, compute_global_descriptors(work.graph.keyframes)),
            )
            store.finalize()
    damaged = ledger.make_finished_path(tmp_path / "checkpoint", "scene-0001") / file
    damaged.write_bytes(damaged.read_bytes()[:-100])
    index = SubmapIndex(tmp_path, "0" * 32)
    atlas = LoopDetector(tmp_path / "checkpoint", config, index)
    seen = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "verify_loop", lambda one, *_: seen.append(one.scene_id) or "for the test")
        atlas.detect_loops("scene-0003", work.graph, BACKGROUND)
    assert seen == ["scene-0002"] and index.links == ()
