"""cameras.json reads back exactly, and what is something else is a clear error."""

from __future__ import annotations

import json

import numpy as np
import pytest

from splatnode.recon.result.export import SceneFileError, read_cameras
from tests.support.exported import make_snapshot, write


def test_cameras_read_back_exactly(tmp_path):
    write(make_snapshot(), tmp_path)
    for read, camera in zip(read_cameras(tmp_path / "cameras.json"), make_snapshot().cameras, strict=True):
        assert np.array_equal(read.T_world_camera, camera.T_world_camera)
        assert np.array_equal(read.K, camera.K)
        assert (read.name, read.frame_id, read.width, read.height) == (camera.name, camera.frame_id, 512, 384)
        assert read.bounds == camera.bounds is not None


@pytest.mark.parametrize("axes", [[[0.1, 0.0, 0.0]], [[float("nan"), 0.0, 0.0]] * 3, None])
def test_axes_that_are_no_ellipsoid_are_a_clear_error(tmp_path, axes):
    write(make_snapshot(), tmp_path)
    content = json.loads((tmp_path / "cameras.json").read_text())
    content["cameras"][0]["bounds"]["axes"] = axes
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    with pytest.raises(SceneFileError, match="cameras.json"):
        read_cameras(tmp_path / "cameras.json")


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"cameras": [{"name": "a"}]}', '{"cameras": [1]}'])
def test_foreign_cameras_file_is_a_clear_error(tmp_path, content):
    (tmp_path / "cameras.json").write_text(content)
    with pytest.raises(SceneFileError, match="cameras.json"):
        read_cameras(tmp_path / "cameras.json")
