"""transforms.json: nerfstudio's conventions hold."""

from __future__ import annotations

import json

import numpy as np

from splatnode.recon.result.export.formats.nerfstudio import encode_nerfstudio
from tests.support.exported import make_camera


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
