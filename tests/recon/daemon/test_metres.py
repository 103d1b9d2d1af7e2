"""A live scene has metres from the first source that speaks, and its files have the same."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import make_given_pose
from splatnode.capture.status import read_heartbeats
from splatnode.recon.daemon.output import MetricScaler
from splatnode.recon.keyframes import Features, Keyframe
from splatnode.recon.metric.measurement import MetricConfig as Metric
from splatnode.recon.result.export import read_cameras
from splatnode.recon.result.export.stored import decode_scale
from tests.recon.daemon.test_daemon import config, finished, peer, running  # noqa: F401
from tests.support.synthetic import SMALL, photographs

TRUE = [T for T, _ in synthetic.scene_cameras(SMALL)]


def apart(cameras) -> float:
    """Of the cameras of the first and the third photograph."""
    found = {camera.frame_id: camera.T_world_camera[:3, 3] for camera in cameras}
    return float(np.linalg.norm(found[0] - found[2]))


def apart_truly() -> float:
    return float(np.linalg.norm(TRUE[0][:3, 3] - TRUE[2][:3, 3]))


def with_poses(factor: float = 1.0):
    moved = [T.copy() for T in TRUE]
    for T in moved:
        T[:3, 3] *= factor
    return [
        replace(frame, given_pose=make_given_pose(T, 0.01, 1.0))
        for frame, T in zip(photographs()[:3], moved, strict=False)
    ]


def test_poses_of_keyframes_give_what_is_shown_and_what_is_written_metres(config, peer):  # noqa: F811
    true = apart_truly()
    with running(config):
        for frame in with_poses():
            peer.server.offer(frame)
        scene = peer.wait(finished(3), "a final scene").snapshot
        first = next(heard.snapshot for heard in peer.heard if len(heard.snapshot.cameras) == 3)
        assert read_heartbeats(config.network, only="recon")["recon"]["bounds"].count(" m")
    for shown in (first, scene):
        assert shown.scale.metric and shown.scale.source.startswith("poses of 3 photographs, known to ")
        low, high = shown.scale.interval_95
        assert low <= true / apart(shown.cameras) <= high and high < 1.1
        assert np.linalg.norm(shown.cameras[0].T_world_camera[:3, 3] - TRUE[0][:3, 3]) < 0.1
    written = config.out / "scene-0001" / "cameras.json"
    assert decode_scale(written.read_bytes()) == scene.scale
    for camera, shown in zip(read_cameras(written), scene.cameras, strict=True):
        np.testing.assert_allclose(camera.T_world_camera, shown.T_world_camera, atol=1e-9)


def test_right_images_of_keyframes_give_what_is_shown_and_what_is_written_metres(config, peer):  # noqa: F811
    frames = list(synthetic.stream(msgspec.structs.replace(SMALL, baseline_m=0.15)))[:3]
    with running(config):
        for frame in frames:
            peer.server.offer(frame)
        scene = peer.wait(finished(3), "a final scene").snapshot
        first = next(heard.snapshot for heard in peer.heard if len(heard.snapshot.cameras) == 3)
    for shown in (first, scene):
        assert shown.scale.metric and "3 stereo pairs with 150 mm between the cameras" in shown.scale.source
        low, high = shown.scale.interval_95
        assert low <= apart_truly() / apart(shown.cameras) <= high and high < 1.05
    assert decode_scale((config.out / "scene-0001" / "cameras.json").read_bytes()) == scene.scale


def test_poses_against_a_distance_leave_the_scene_relative_with_the_reason(config, peer):  # noqa: F811
    names = [frame.name for frame in photographs()[:3]]
    metric = msgspec.convert({"baseline": [names[0], names[2], apart_truly()]}, Metric)
    measured = msgspec.structs.replace(
        config, reconstruction=msgspec.structs.replace(config.reconstruction, metric=metric)
    )
    with running(measured):
        for frame in with_poses(1.3):
            peer.server.offer(frame)
        scene = peer.wait(lambda heard: len(heard.snapshot.cameras) == 3, "three cameras").snapshot
    assert not scene.scale.metric and scene.scale.interval_95 is None
    assert "contradicts poses of 3 photographs: the scales differ by " in scene.scale.source


def test_a_marker_is_looked_for_once_in_a_keyframe(monkeypatch):
    asked = []
    monkeypatch.setattr(
        "splatnode.recon.metric.metres.detect_markers",
        lambda frames, _: asked.extend(each.name for each in frames) or [],
    )
    frames = photographs()[:2]
    none = Features.__new__(Features)
    keyframes = [Keyframe(frame, frame.image, none) for frame in frames]
    metres = MetricScaler(Metric(marker_size_m=0.1))
    for known in (keyframes[:1], keyframes, keyframes):
        metres.collect_evidence(known)
    assert asked == [frame.name for frame in frames]
