"""The daemon as a whole, over its sockets: keyframes in, a scene out, killed and gone on, a frame taken back."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
from msgspec.structs import replace

from splatnode.capture.messaging.keyframe_queue import KeyframeServer, Spool, SpoolConfig
from splatnode.capture.messaging.network import RECON_CONTROL, RECON_SCENE, AlreadyRunning, Network
from splatnode.capture.messaging.pubsub import StateClient, ask
from splatnode.capture.process.files import LOCK
from splatnode.capture.status import read_heartbeats
from splatnode.recon.config import PREVIEW
from splatnode.recon.config import ReconstructionConfig as Reconstruction
from splatnode.recon.daemon import submap, worker
from splatnode.recon.daemon.config import DaemonConfig
from splatnode.recon.daemon.node import Answer, Daemon, RemoveKeyframe
from splatnode.recon.daemon.relocalization import TrackingConfig as Tracking
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.locating import Located
from splatnode.recon.locating.localize import localize_image
from splatnode.recon.optimize import training
from splatnode.recon.result.export import read_cameras
from splatnode.recon.result.export.staged import FolderInUse
from splatnode.recon.result.message import LiveScene, SceneHeader, decode_snapshot
from splatnode.recon.result.snapshot import format_widest_bounds
from splatnode.recon.result.stored_snapshot import read_depths, read_landmarks
from splatnode.recon.result.verdict import RELATIVE, Code
from tests.capture.messaging.test_sockets import wait_for
from tests.support.synthetic import photographs, places

QUICK = Reconstruction(
    size=160,
    preview=replace(PREVIEW, iterations=2),
    optimize=training.RefinementConfig(iterations=20, checkpoints=(10,)),
)
PATIENCE_S = 120.0


@pytest.fixture
def config(tmp_path) -> DaemonConfig:
    (tmp_path / "run").mkdir(mode=0o700)
    return DaemonConfig(
        network=Network(directory=tmp_path / "run"),
        reconstruction=QUICK,
        tracking=Tracking(interval_s=0),
        checkpoint=tmp_path / "checkpoint",
        out=tmp_path / "out",
        idle_finalize_s=0.2,
        status_interval_s=0.2,
    )


@contextmanager
def running(config: DaemonConfig) -> Iterator[threading.Thread]:
    """The daemon in a thread of its own, which is yielded, until the block ends."""
    stopping, errors = threading.Event(), []

    def run() -> None:
        try:
            with Daemon(config, stopping) as daemon:
                daemon.run()
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield thread
    finally:
        stopping.set()
        thread.join(PATIENCE_S)
    assert not thread.is_alive() and not errors, errors


def index(config: DaemonConfig) -> list[dict]:
    return json.loads((config.out / "places.json").read_text())["places"]


def report(folder: Path) -> dict:
    return json.loads((folder / "report.json").read_text())


class Peer:
    """Capture and viewer at once: offers keyframes and hears scenes."""

    def __init__(self, config: DaemonConfig, folder: Path) -> None:
        self.server = KeyframeServer(config.network, Spool(SpoolConfig(directory=folder)))
        self.client = StateClient(RECON_SCENE, config.network, SceneHeader)
        self.heard: list[LiveScene] = []

    def close(self) -> None:
        self.server.close()
        self.client.close()

    def wait(self, until: Callable[[LiveScene], bool], what: str) -> LiveScene:
        """The first scene from now on for which `until` holds."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            self.server.serve(0.01)
            message = self.client.poll(0.02)
            if message is not None:
                self.heard.append(decode_snapshot(message))
                if until(self.heard[-1]):
                    return self.heard[-1]
        raise AssertionError(
            f"no scene with {what} in {PATIENCE_S} s; heard {[h.snapshot.verdict for h in self.heard]}"
        )

    def wait_for_acknowledgements(self) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while self.server.num_queued and time.monotonic() < deadline:
            self.server.serve(0.02)
        assert self.server.num_queued == 0


@pytest.fixture
def peer(config, tmp_path) -> Iterator[Peer]:
    opened = Peer(config, tmp_path / "spool")
    yield opened
    opened.close()


def finished(cameras: int) -> Callable[[LiveScene], bool]:
    return lambda scene: scene.snapshot.final and len(scene.snapshot.cameras) == cameras


def test_keyframes_become_a_scene_that_survives_the_process_and_forgets_what_it_must(config, peer):
    frames = photographs()[:4]
    with running(config):
        for frame in frames[:3]:
            peer.server.offer(frame)
        first = peer.wait(lambda scene: len(scene.snapshot.cameras) == 3, "three cameras")
        assert first.scene_id == "scene-0001" and first.snapshot.verdict.code == Code.OK
        assert len(first.snapshot.gaussians) > 100
        peer.server.offer(frames[3])
        scene = peer.wait(finished(4), "four cameras, refined")
        assert scene.snapshot.iterations == 20
        peer.wait_for_acknowledgements()
        with pytest.raises(AlreadyRunning):
            Daemon(config, threading.Event())
        status = read_heartbeats(config.network, only="recon")["recon"]
        assert status["keyframes"] == 4
        assert status["bounds"] == format_widest_bounds(scene.snapshot.cameras, RELATIVE) != ""
    exported = read_cameras(config.out / "scene-0001" / "cameras.json")
    assert [camera.name for camera in exported] == [frame.name for frame in frames]
    landmarks = read_landmarks(config.out / "scene-0001")
    assert isinstance(localize_image(landmarks, frames[1].image), Located)
    assert set(read_depths(config.out / "scene-0001")) == {frame.name for frame in frames}

    with running(config):
        again = peer.wait(lambda scene: scene.session != first.session, "a new session")
        assert again.snapshot.final and again.snapshot.iterations == 20
        assert len(again.snapshot.gaussians) == len(scene.snapshot.gaussians)
        answer = ask(RECON_CONTROL, config.network, RemoveKeyframe("nobody.png"), Answer)
        assert not answer.done and frames[0].name in answer.message
        assert ask(RECON_CONTROL, config.network, RemoveKeyframe(frames[3].name), Answer).done
        less = peer.wait(finished(3), "three cameras, refined again")
        assert [dropped.name for dropped in less.snapshot.dropped] == [frames[3].name]

    with running(config):
        peer.wait(lambda scene: scene.session not in (first.session, again.session), "a third session")
        assert len(peer.heard[-1].snapshot.cameras) == 3
        assert peer.heard[-1].snapshot.dropped == less.snapshot.dropped


@pytest.mark.parametrize(
    "error, end",
    [
        (SystemExit(), pytest.raises(AssertionError, match="SystemExit")),
        (OSError(28, "No space left on device"), nullcontext()),
    ],
    ids=["death", "full disk"],
)
def test_a_result_that_could_not_be_written_is_written_by_the_next_process(config, peer, monkeypatch, error, end):
    failed = threading.Event()

    def fail(*_, **__):
        failed.set()
        raise error

    for frame in photographs()[:3]:
        peer.server.offer(frame)
    with monkeypatch.context() as patch, end, running(config):
        patch.setattr("splatnode.recon.daemon.output.write_result_folder", fail)
        wait_for(lambda: peer.server.serve(0.02) or failed.is_set(), PATIENCE_S)
    with running(config):
        wait_for((config.out / "scene-0001" / "manifest.json").exists, PATIENCE_S)


def test_a_scene_that_its_refinement_ruined_is_neither_shown_nor_kept(config, peer):
    wild = replace(QUICK.optimize, lr=training.LearningRates(means=1.0, means_unit="depth", log_scales=1.0))
    config = replace(config, reconstruction=replace(QUICK, optimize=wild))
    for frame in photographs()[:3]:
        peer.server.offer(frame)
    for _ in range(2):  # a restarted one does not take it from the checkpoint
        with running(config):
            ruined = peer.wait(lambda scene: scene.snapshot.verdict.code is Code.DIVERGED, "a refinement gone wrong")
            assert not ruined.snapshot.verdict.publishable and not len(ruined.snapshot.gaussians)
            peer.wait_for_acknowledgements()
    assert [path.name for path in config.out.iterdir()] == ["places.json"]
    (place,) = index(config)
    assert place["verdict"] == "DIVERGED" and not place["publishable"] and place["folder"] is None
    assert {"name": photographs()[0].name, "reason": "there is no scene: DIVERGED"} in place["frames_dropped"]


def test_two_daemons_do_not_export_into_one_folder(config, tmp_path):
    (tmp_path / "other").mkdir(mode=0o700)
    other = replace(config, network=Network(directory=tmp_path / "other"), checkpoint=tmp_path / "another checkpoint")
    with running(config):
        wait_for((config.out / LOCK).exists, PATIENCE_S)
        with pytest.raises(FolderInUse, match=f"process {os.getpid()} writes its results into .*out already; stop it"):
            Daemon(other, threading.Event())
    assert FolderInUse.exit_code == 75 and not config.out.exists()
    with running(other):
        wait_for((config.out / LOCK).exists, PATIENCE_S)


def test_a_nearly_full_disk_is_a_problem_that_the_status_tells_until_there_is_room(config, monkeypatch, caplog):
    free = {"checkpoint": 10**12, "out": 10**12}
    monkeypatch.setattr(
        shutil, "disk_usage", lambda path: SimpleNamespace(total=10**12, free=free[path.relative_to(tmp).parts[0]])
    )
    tmp = config.out.parent

    def problem() -> str:
        return read_heartbeats(config.network, only="recon")["recon"]["problem"]

    with running(replace(config, max_views=10, max_gaussians=10_000)), caplog.at_level("INFO"):
        assert problem() == ""
        for folder, what, needed in (("checkpoint", "the checkpoint", "60.6 MB"), ("out", "the result", "7.6 MB")):
            free[folder] = 2_000_000
            said = f"2.0 MB are free in {tmp / folder}, and {what} may take {needed}: make room on the disk"
            wait_for(lambda said=said: problem() == said, PATIENCE_S)
            free[folder] = 10**12
            wait_for(lambda: problem() == "", PATIENCE_S)
    assert caplog.text.count("event=disk_space") == 4


def offer_when_three_are_shown(peer, frames) -> None:
    """The first three frames, and the others once there is a scene of those."""
    for frame in frames[:3]:
        peer.server.offer(frame)
    peer.wait(lambda scene: len(scene.snapshot.cameras) == 3, "a scene of the first three")
    for frame in frames[3:]:
        peer.server.offer(frame)


def test_another_place_begins_another_scene_and_the_old_one_is_exported(config, peer):
    frames = places(seeds=(0, 1))
    with running(replace(config, new_submap_after=3)):
        offer_when_three_are_shown(peer, frames)
        other = peer.wait(lambda scene: scene.scene_id == "scene-0002", "another place")
        assert {camera.name for camera in other.snapshot.cameras} <= {frame.name for frame in frames[3:]}
        peer.wait_for_acknowledgements()
        wait_for((config.out / "scene-0001" / "manifest.json").exists, PATIENCE_S)
    kept = read_cameras(config.out / "scene-0001" / "cameras.json")
    assert {camera.name for camera in kept} == {frame.name for frame in frames[:3]}
    assert len(list((config.checkpoint / "frames").glob("*.frame"))) == 3


def test_keyframes_that_do_not_fit_at_once_join_the_scene_when_all_are_judged_together(config, peer, monkeypatch):
    monkeypatch.setattr("splatnode.recon.estimation.MIN_CONFIRMED_POINTS", 10**6)  # points: nothing fits at once
    frames = photographs()
    with running(replace(config, new_submap_after=3)):
        offer_when_three_are_shown(peer, frames)
        whole = peer.wait(lambda scene: len(scene.snapshot.cameras) == 6, "all cameras")
        assert whole.scene_id == "scene-0001" and not whole.snapshot.verdict.provisional
        peer.wait_for_acknowledgements()
    assert len(list((config.checkpoint / "frames").glob("*.frame"))) == 6


def test_a_keyframe_that_cannot_be_worked_in_keeps_no_other_out(config, peer, monkeypatch):
    add = submap.add

    def failing(work, keyframes, run):
        strangers = add(work, keyframes, run)
        if any(keyframe.name == frames[1].name for keyframe in keyframes):
            raise ArithmeticError("for the test")
        return strangers

    frames = photographs()[:4]
    monkeypatch.setattr(submap, "add", failing)
    for frame in frames:
        peer.server.offer(frame)
    with running(config):
        scene = peer.wait(finished(3), "the other three")
        assert sorted(each.name for each in scene.snapshot.cameras) == [frames[i].name for i in (0, 2, 3)]
        assert [(each.name, "for the test" in each.reason) for each in scene.snapshot.dropped] == [
            (frames[1].name, True)
        ]


@pytest.mark.parametrize(
    ("where", "step"),
    [(submap, "add"), (IncrementalReconstruction, "update"), (IncrementalReconstruction, "rebuild")],
)
def test_a_step_for_which_the_memory_did_not_suffice_costs_no_keyframe(config, peer, monkeypatch, where, step):
    real, failures = (
        getattr(where, step),
        iter([MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")]),
    )

    def short_of_memory(*args):
        done = real(*args)
        if (error := next(failures, None)) is not None:
            raise error
        return done

    monkeypatch.setattr(where, step, short_of_memory)
    monkeypatch.setattr(worker, "FIRST_WAIT_S", 0.1)
    for frame in photographs()[:3]:
        peer.server.offer(frame)
    with running(config):
        scene = peer.wait(finished(3), "all three")
        assert not scene.snapshot.dropped and next(failures, None) is None
