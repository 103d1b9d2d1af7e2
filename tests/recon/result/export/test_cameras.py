"""Cameras as files: other programs' conventions hold, and rotations survive their quaternions."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon.result.export.cameras import encode_colmap, encode_nerfstudio, encode_tum
from splatnode.recon.result.export.quaternions import matrices_from_quats, quats_from_matrices
from tests.support.exported import make_camera, make_snapshot


def test_quaternions_and_matrices_agree_for_every_largest_component():
    rng = np.random.default_rng(1)
    quats = rng.normal(size=(200, 4))
    quats[:4] = np.eye(4)  # the identity and the three half turns
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    matrices = matrices_from_quats(quats)
    assert np.allclose(matrices @ matrices.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    back = quats_from_matrices(matrices)
    assert np.allclose(np.abs((quats * back).sum(1)), 1.0, atol=1e-12)
    quarter_turn_about_z = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    assert np.allclose(quats_from_matrices(quarter_turn_about_z), [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


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


def test_nerfstudio_cameras_look_along_minus_z():
    camera = make_camera(2)
    frame = json.loads(encode_nerfstudio([camera]))["frames"][0]
    matrix = np.array(frame["transform_matrix"])
    ahead_in_world = camera.T_world_camera @ [0.0, 0.0, 1.0, 0.0]
    down_in_world = camera.T_world_camera @ [0.0, 1.0, 0.0, 0.0]
    assert np.allclose(matrix @ [0, 0, -1, 0], ahead_in_world)
    assert np.allclose(matrix @ [0, -1, 0, 0], down_in_world)
    assert np.allclose(matrix[:3, 3], camera.T_world_camera[:3, 3])
    assert (frame["fl_x"], frame["fl_y"], frame["cx"], frame["cy"]) == (400, 410, 256, 192)
    assert frame["file_path"] == "images/0002.jpg"


def test_tum_trajectory_has_frame_ids_positions_and_xyzw():
    camera = make_camera(2, angle=np.pi / 2)
    line = encode_tum([camera]).decode().splitlines()[-1].split()
    assert line[:3] == ["2", "2", "-0.5"]
    assert np.allclose([float(value) for value in line[1:]], [2, -0.5, 0.25, 0, np.sqrt(0.5), 0, np.sqrt(0.5)])
