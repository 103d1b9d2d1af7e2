"""COLMAP's model: COLMAP itself reads it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon.result.export.formats.colmap import encode_colmap
from tests.support.exported import make_snapshot


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
