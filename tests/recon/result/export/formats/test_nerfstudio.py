"""transforms.json: nerfstudio's conventions hold."""

from __future__ import annotations

import json

import numpy as np

from splatnode.recon.result.export.formats.nerfstudio import encode_nerfstudio
from splatnode.recon.result.verdict import Scale
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


def test_nothing_of_ours_has_the_name_of_a_number_of_instant_ngp():
    content = json.loads(encode_nerfstudio([make_camera(2)], Scale(True, "0.5 m between a.jpg and b.jpg", (0.9, 1.1))))
    assert not {"scale", "offset", "aabb_scale", "from_na", "up"} & content.keys()  # it refuses a word as a number
    assert content["splatnode"]["scale"] == "metric" and content["splatnode"]["scale_interval_95"] == [0.9, 1.1]
