"""COLMAP's model: COLMAP itself reads it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.recon.result.export.formats.colmap import encode_colmap
from splatnode.recon.result.snapshot import CameraEstimate
from tests.support.exported import make_camera, make_snapshot


@pytest.mark.parametrize("form", ["{}", "a photo of {}"], ids=["text", "binary"])
def test_colmap_model_is_read_by_colmap(tmp_path, form):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap reads COLMAP models (the extra bench)")
    snapshot = make_snapshot()
    cameras = [replace(camera, name=form.format(camera.name)) for camera in snapshot.cameras]
    for name, data in encode_colmap(cameras, snapshot.gaussians).items():
        (tmp_path / name).write_bytes(data)
    model = pycolmap.Reconstruction(tmp_path)
    assert len(model.cameras) == 1  # the two images share a calibration
    assert np.allclose(model.cameras[1].params, [400, 410, 256, 192])
    assert len(model.points3D) == len(snapshot.gaussians)
    for camera in cameras:
        image = model.find_image_with_name(camera.name)
        assert image is not None
        T_camera_world = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        assert np.allclose(T_camera_world @ camera.T_world_camera, np.eye(4), atol=1e-12)


def make_rigged_cameras(form: str, shaken: float = 0.0) -> list[CameraEstimate]:
    """Three cameras on a rig that took three frame sets, the second of which lacks one; and one that is alone."""
    base = make_camera(0)
    turns = [
        Rotation.from_euler("xyz", angles, degrees=True).as_matrix() for angles in ((0, 0, 0), (5, 30, 2), (0, -40, 9))
    ]
    on_rig = [np.eye(4) for _ in turns]
    for T, turn, shift in zip(on_rig, turns, ((0, 0, 0), (0.2, 0, 0.1), (-0.3, 0.1, 0)), strict=True):
        T[:3, :3], T[:3, 3] = turn, shift
    rng, cameras = np.random.default_rng(0), []
    for number in range(3):
        T_world_rig = make_camera(number, 0.3 * number).T_world_camera
        for camera_id, T in zip(("left", "right", "top"), on_rig, strict=True):
            if (number, camera_id) == (1, "left"):
                continue
            T_world_camera = T_world_rig @ T
            T_world_camera[:3, 3] += shaken * rng.normal(size=3)
            name = form.format(f"{camera_id}/{number}.png")
            cameras.append(
                replace(base, name=name, camera_id=camera_id, frame_set=number, T_world_camera=T_world_camera)
            )
    return [*cameras, replace(base, name=form.format("hand/0.png"), camera_id="hand")]


@pytest.mark.parametrize("form", ["{}", "a photo of {}"], ids=["text", "binary"])
@pytest.mark.parametrize("shaken", [0.0, 0.05], ids=["rigid", "not rigid"])
def test_rigs_and_frames_are_read_by_colmap(tmp_path, form, shaken):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap reads COLMAP models (the extra bench)")
    cameras = make_rigged_cameras(form, shaken)
    for name, data in encode_colmap(cameras, make_snapshot().gaussians).items():
        (tmp_path / name).write_bytes(data)
    model = pycolmap.Reconstruction(tmp_path)
    assert len(model.cameras) == 4  # all have one calibration, and are four sensors
    assert sorted(rig.num_sensors() for rig in model.rigs.values()) == ([1, 1, 1, 1] if shaken else [1, 3])
    assert sorted(len(frame.data_ids) for frame in model.frames.values()) == ([1] * 9 if shaken else [1, 2, 3, 3])
    for camera in cameras:
        image = model.find_image_with_name(camera.name)
        T_camera_world = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        assert np.allclose(T_camera_world @ camera.T_world_camera, np.eye(4), atol=1e-8)


def test_of_one_camera_there_is_no_rig():
    assert sorted(encode_colmap(make_snapshot().cameras, make_snapshot().gaussians)) == [
        "cameras.txt",
        "images.txt",
        "points3D.txt",
    ]
