"""Whether the camera has moved: small shifts are found, light and noise are none, and the figures are right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.capture import lenses
from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Intrinsics
from splatnode.recon.daemon.relocalization import (
    KeyframeLandmarks,
    Tracker,
    TrackingConfig,
    compute_landmarks,
    localize,
    measure_motion,
)
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching import features
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from tests.support.synthetic import SMALL, photographs, renumbered

CONFIG = TrackingConfig()
PLACE = synthetic.Config(views=3, width=480, height=360)


@pytest.fixture(scope="module")
def known() -> list[KeyframeLandmarks]:
    """What three keyframes know of the place, with the depth that is true."""
    found = []
    for index, (frame, camera) in enumerate(zip(photographs(PLACE), synthetic.scene_cameras(PLACE), strict=True)):
        T_world_camera, K = camera
        feature = features.extract(frame.image, features.FeatureConfig(max_num_features=3000))
        depth = synthetic.depth(PLACE, index)
        column, row = feature.points.astype(int).T
        z = depth[np.clip(row, 0, PLACE.height - 1), np.clip(column, 0, PLACE.width - 1)].astype(float)
        rays = np.c_[feature.points, np.ones(len(z))] @ np.linalg.inv(K).T
        good = np.isfinite(z)
        points = (rays * z[:, None])[good] @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        found.append(KeyframeLandmarks(frame.name, points, feature.descriptors[good]))
    return found


def stand() -> tuple[np.ndarray, np.ndarray]:
    """Where the camera stands: beside the second keyframe."""
    return synthetic.evaluation_cameras(PLACE)[1]


def moved(turn_deg: float = 0.0, step: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    T_world_camera, K = stand()
    change = np.eye(4)
    change[:3, :3] = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    change[0, 3] = step
    return T_world_camera @ change, K


def preview(camera=None, seed: int = 1) -> np.ndarray:
    return synthetic.render_image(PLACE, camera or stand(), seed)


def darker(image: np.ndarray) -> np.ndarray:
    """Half the light, of another colour, from one side."""
    shade = np.linspace(0.35, 0.8, image.shape[1])[None, :, None] * np.array([1.0, 0.9, 0.75])
    return np.clip(255 * (image / 255.0) ** 1.2 * shade, 0, 255).astype(np.uint8)


def test_a_preview_is_placed_where_it_was_taken(known):
    position = localize(preview(), stand()[1], known, CONFIG)
    T_world_camera, _ = stand()
    assert (
        np.linalg.norm(position.T_world_camera[:3, 3] - T_world_camera[:3, 3]) < 0.03
    )  # metres; the scene is 3.3 away
    turn = Rotation.from_matrix(position.T_world_camera[:3, :3].T @ T_world_camera[:3, :3]).magnitude()
    assert np.degrees(turn) < 0.4
    assert len(position.points) > 50 and position.keyframes[0] in {"view_001.png", "view_002.png"}


def test_sensor_noise_and_light_are_no_motion(known):
    watch = Tracker(known, CONFIG)
    for seed in range(1, 4):
        for image in (preview(seed=seed), darker(preview(seed=10 + seed))):
            position, found = watch.track(image, stand()[1])
            assert position is not None and not found.moved
            assert found.rotation_deg < 0.3 and found.shift_px < CONFIG.shift_px


@pytest.mark.parametrize(("turn_deg", "step"), [(2.0, 0.0), (-4.0, 0.0), (0.0, 0.15)])
def test_a_shift_of_some_pixels_is_found_and_measured(known, turn_deg, step):
    """A turn of 2 degrees is 17 px of 480, one of 4 is 34; a step of 0.15 m at about 3.3 m is 20."""
    watch, K = Tracker(known, CONFIG), stand()[1]
    _, first = watch.track(preview(), K)
    assert not first.moved
    alarms = []
    for seed in (2, 3, 4):
        _, found = watch.track(darker(preview(moved(turn_deg, step), seed)), K)
        alarms.append(found.moved)
    assert alarms == [False, True, True]  # one preview alone is no alarm
    assert found.certainty > 0.999
    assert found.rotation_deg == pytest.approx(abs(turn_deg), abs=0.4)
    depth = (
        np.median(localize(preview(), K, known, CONFIG).points @ np.linalg.inv(stand()[0])[2, :3])
        + (np.linalg.inv(stand()[0])[2, 3])
    )
    assert found.translation_rel == pytest.approx(step / depth, abs=0.015)
    assert "certain to" in str(found)


def test_a_camera_that_comes_back_is_no_longer_moved(known):
    watch, K = Tracker(known, CONFIG), stand()[1]
    looks = [watch.track(preview(camera), K)[1].moved for camera in (None, moved(4), moved(4), moved(4), None)]
    assert looks == [False, False, True, True, False]


def test_what_no_camera_could_have_seen_is_not_known(known):
    """Another place of the same kind shares its wall's bricks; a mirror image repeats single patterns by chance."""
    (other,) = photographs(synthetic.Config(views=1, width=PLACE.width, height=PLACE.height, seed=5))
    mirrored = np.ascontiguousarray(preview()[:, ::-1])
    for image in (mirrored, other.image, np.zeros_like(mirrored)):
        assert localize(image, stand()[1], known, CONFIG) is None
        assert Tracker(known, CONFIG).track(image, stand()[1]) == (None, None)


def test_the_same_position_has_not_moved(known):
    position = localize(preview(), stand()[1], known, CONFIG)
    found = measure_motion(position, replace(position), CONFIG)
    assert found.certainty < 0.01 and found.shift_px == 0 and not found.moved


def test_landmarks_lie_on_what_the_gaussians_show():
    """One large Gaussian, flat and opaque, 2 in front of the camera: every feature is there."""
    (frame,) = renumbered([photographs(SMALL)[0].image])
    keyframe = Keyframe(frame, frame.image, features.extract(frame.image, features.FeatureConfig(max_num_features=500)))
    wall = GaussianArrays(
        means=np.array([[0, 0, 2]], np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.array([[5, 5, 0.001]], np.float32),
        opacities=np.array([0.99], np.float32),
        sh=np.zeros((1, 1, 3), np.float32),
        source_frame=np.zeros(1, np.int32),
    )
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    camera = CameraEstimate(frame.name, 0, np.eye(4), K, 320, 240)
    verdict = Verdict(Code.OK, "", "", publishable=True)
    snapshot = Snapshot(1, verdict, (camera,), wall, {frame.name: frame.image}, (), 0)
    (found,) = compute_landmarks(snapshot, [keyframe], CONFIG)
    assert len(found.points) == len(found.descriptors) > 100
    np.testing.assert_allclose(found.points[:, 2], 2.0, rtol=1e-3)
    projected = found.points[:, :2] / found.points[:, 2:] * 300 + [160, 120]
    np.testing.assert_allclose(projected[0], keyframe.features.points[0], atol=0.1)
    lens = Intrinsics(640, 480, 610.0, 610.0, 320.0, 240.0, "estimated", (-0.2, 0.0, 0.0, 0.0))
    large = replace(frame, image=np.repeat(np.repeat(frame.image, 2, 0), 2, 1))
    plain = keyframe.features
    keyframe = Keyframe(large, frame.image, replace(plain, points=2 * plain.points))  # as it was photographed
    (found,) = compute_landmarks(replace(snapshot, cameras=(replace(camera, lens=lens),)), [keyframe], CONFIG)
    rays = lenses.unproject_opencv(keyframe.features.points, lens)
    expected = 2.0 * rays[:, :2] / rays[:, 2:]
    np.testing.assert_allclose(found.points[0, :2], expected[plain.point_of[plain.tilt == 1.0]][0], rtol=1e-3)
