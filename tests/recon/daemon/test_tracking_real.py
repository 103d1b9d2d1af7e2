"""The alarm on photographs of real places: light and noise are no motion; another standpoint is, by the right angle."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import Frame, reduce_image
from splatnode.extras.evaluate.dataset import load_scene, load_split
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon.relocalization import Tracker, compute_landmarks, scale_intrinsics
from splatnode.recon.daemon.relocalization import TrackingConfig as Tracking
from splatnode.recon.estimation import prepare
from splatnode.recon.optimize import training
from splatnode.recon.pipeline import reconstruct

QUICK = replace(ReconstructionConfig(), size=256, optimize=training.RefinementConfig(iterations=10))


def preview(frame: Frame, gain: float, seed: int) -> np.ndarray:
    """As capture sends it: small, a JPEG; by another light, with noise of its own."""
    small = reduce_image(frame.image, 480)
    noise = np.random.default_rng(seed).normal(0, 3, small.shape)
    lit = np.clip(gain * small + noise, 0, 255).astype(np.uint8)
    _, jpeg = cv2.imencode(".jpg", lit, [cv2.IMWRITE_JPEG_QUALITY, 75])
    return np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), np.uint8)


@pytest.mark.parametrize("name", ["fountain_p11", "fox"])
def test_a_camera_that_stands_in_a_real_place_and_then_moves(shared, name):
    folder = shared / "scenes" / name
    scene = load_scene(folder)
    split = load_split(folder, list(scene.paths), 6)
    frames = list(scene.frames(split.train[:4]))
    *_, snapshot = reconstruct(frames, QUICK)
    watch = Tracker(compute_landmarks(snapshot, [prepare(frame, QUICK) for frame in frames], Tracking()), Tracking())
    stood, went = (next(iter(scene.frames((each,)))) for each in split.train[1:3])

    def look(frame: Frame, gain: float, seed: int):
        image = preview(frame, gain, seed)
        height, width = image.shape[:2]
        return watch.track(image, scale_intrinsics(snapshot.cameras[0], width, height))

    for seed, gain in enumerate((1.0, 0.7, 1.1)):
        position, motion = look(stood, gain, seed)
        assert position is not None and motion is not None and not motion.moved
    _, once = look(went, 1.0, 5)
    _, twice = look(went, 0.9, 6)
    assert not once.moved and twice.moved and twice.certainty > 0.999
    T_stood, T_went = (scene.cameras[frame.name].T_world_camera for frame in (stood, went))
    turned = Rotation.from_matrix(T_stood[:3, :3].T @ T_went[:3, :3]).magnitude()
    assert abs(twice.rotation_deg - np.degrees(turned)) < 0.5
