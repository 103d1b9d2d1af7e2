"""Wheels and an IMU, live: keyframes that carry motions and gravity give the scene metres, and its map its up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from msgspec.structs import replace as changed

import splatnode
from splatnode.capture import recording
from splatnode.capture.cameras import synthetic
from splatnode.capture.diorama import Config as Odometry
from splatnode.capture.frame import Frame
from splatnode.capture.recording import Recorder
from splatnode.recon.daemon.free_space import OccupancyConfig as FreeSpace
from splatnode.recon.result.verdict import FrameName
from tests.recon.daemon.test_daemon import config, finished, peer, running  # noqa: F401
from tests.support.synthetic import SMALL, photographs

MEASURED = synthetic.simulate_odometry(changed(SMALL, odometry=Odometry(drift=0.02, noise_deg=2.0)))
MOUNT = np.array([[0.0, 0.0, 1.0, 0.3], [-1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, 1.2], [0.0, 0.0, 0.0, 1.0]])
TRUE = [T for T, _ in synthetic.scene_cameras(SMALL)]


def frames_with_odometry(count: int = 4):
    """Not each photograph is a keyframe: the second is missing."""
    told = [replace(f, motion=m, gravity=g) for f, (m, g) in zip(photographs(), MEASURED, strict=False)]
    return [told[0], *told[2 : count + 1]]


def apart(first, last) -> float:
    return float(np.linalg.norm(first[:3, 3] - last[:3, 3]))


def test_keyframes_with_motions_give_metres_and_up_also_after_a_restart(config, peer):  # noqa: F811
    frames = frames_with_odometry()
    node = changed(config, occupancy=FreeSpace(live=True))
    with running(node), splatnode.connect(config.network.directory) as connection:
        for frame in frames:
            peer.server.offer(frame)
        scene = peer.wait(finished(len(frames)), "a final scene").snapshot
        early = next(heard.snapshot for heard in peer.heard if len(heard.snapshot.cameras) >= 2)
        for shown in (early, scene):
            assert shown.scale.metric and (shown.scale.source or "").startswith("motions between ")
        found = connection.wait_for_map(60.0)
        assert found.occupancy is not None and found.occupancy.upright.source == f"gravity in {len(frames)} photographs"
        saved = splatnode.load(config.out / "scene-0001")
        assert np.array_equal(saved.map().states, found.occupancy.states)
    names = {camera.name: camera.T_world_camera for camera in scene.cameras}
    ratio = apart(TRUE[0], TRUE[4]) / apart(names[frames[0].name], names[frames[-1].name])
    low, high = scene.scale.interval_95
    assert abs(ratio - 1) < 0.02 and low <= ratio <= high < 1.05
    with running(config):
        again = peer.wait(lambda heard: heard.snapshot.final, "the scene again").snapshot
    assert again.scale == scene.scale


def test_messages_maps_and_files_of_a_node_are_in_the_frame_that_is_asked_for(config, peer):  # noqa: F811
    frames = [replace(frame, T_base_camera=tuple(MOUNT.ravel().tolist())) for frame in frames_with_odometry()]
    metric = changed(config.reconstruction.metric, frame="base")
    node = changed(config, reconstruction=changed(config.reconstruction, metric=metric), occupancy=FreeSpace(live=True))
    with running(node), splatnode.connect(config.network.directory) as connection:
        for frame in frames:
            peer.server.offer(frame)
        scene = peer.wait(finished(len(frames)), "a final scene").snapshot
        early = next(heard.snapshot for heard in peer.heard if len(heard.snapshot.cameras) >= 2)
        found = connection.wait_for_map(60.0).occupancy
    saved = splatnode.load(config.out / "scene-0001")
    assert early.scale.frame.name is scene.scale.frame.name is saved.frame.name is FrameName.BASE
    for cameras in (early.cameras, scene.cameras, saved.cameras):
        np.testing.assert_allclose(cameras[0].T_world_camera, MOUNT, atol=1e-9)
    assert found is not None and found.upright.is_of_result and found.scale.frame == saved.frame


def test_a_recording_keeps_motions_and_gravity(tmp_path):
    frames = frames_with_odometry()
    with Recorder(tmp_path / "walk") as recorder:
        for frame in frames:
            recorder.write(frame)
    kept = [each for each in recording.read(tmp_path / "walk").frames() if isinstance(each, Frame)]
    assert [(each.motion, each.gravity) for each in kept] == [(each.motion, each.gravity) for each in frames]
