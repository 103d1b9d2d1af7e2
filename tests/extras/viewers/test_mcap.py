"""scene.mcap, read back with mcap's own reader: one of Foxglove's messages for each thing that a result tells."""

from __future__ import annotations

import base64
import io
import json
import sys

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from splatnode.capture.process.system import remedy
from splatnode.recon.result.export import export_scene
from splatnode.recon.result.stored_snapshot import LANDMARKS, encode_landmarks
from tests.support.exported import make_gaussians, make_landmarks, make_snapshot, stamped, write

BEGAN_NS = 1_714_989_607_250_000_001


@pytest.fixture
def folder(tmp_path):
    """A result of two cameras, with landmarks and the photograph of the first one."""
    result = tmp_path / "result"
    write(stamped(make_snapshot()), result, further={LANDMARKS: encode_landmarks(make_landmarks())})
    (result / "images").mkdir()
    cv2.imwrite(str(result / "images" / "0000.jpg"), np.full((768, 1024, 3), (200, 100, 50), np.uint8))  # BGR
    return result


def read(content: bytes) -> dict[str, list[tuple[int, str, dict]]]:
    """By topic: time, name of the schema and content of each message, which has just what its schema names."""
    found: dict[str, list[tuple[int, str, dict]]] = {}
    for schema, channel, message in make_reader(io.BytesIO(content)).iter_messages():
        assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
        values = json.loads(message.data)
        assert set(values) == set(json.loads(schema.data)["properties"])
        found.setdefault(channel.topic, []).append((message.log_time, schema.name, values))
    return found


def cloud(values: dict) -> np.ndarray:
    """The points as a reader of foxglove.PointCloud takes them apart, by its fields."""
    kinds = {1: "u1", 7: "<f4"}
    fields = values["fields"]
    layout = np.dtype(
        {
            "names": [field["name"] for field in fields],
            "formats": [kinds[field["type"]] for field in fields],
            "offsets": [field["offset"] for field in fields],
            "itemsize": values["point_stride"],
        }
    )
    return np.frombuffer(base64.b64decode(values["data"]), layout)


def test_a_result_is_read_back(folder, tmp_path):
    found = read(export_scene(folder, "mcap", tmp_path / "scene.mcap").read_bytes())
    names = {topic: {name for _, name, _ in messages} for topic, messages in found.items()}
    assert names == {
        "/tf": {"foxglove.FrameTransforms"},
        "/camera/pose": {"foxglove.PoseInFrame"},
        "/camera/calibration": {"foxglove.CameraCalibration"},
        "/camera/image": {"foxglove.CompressedImage"},
        "/gaussians": {"foxglove.PointCloud"},
        "/landmarks": {"foxglove.PointCloud"},
        "/verdict": {"foxglove.Log"},
    }
    [(time, _, said)] = found["/verdict"]
    assert time == BEGAN_NS and said["message"].startswith("OK: Said in one sentence. Do this.") and said["level"] == 2
    assert [time for time, _, _ in found["/tf"]] == [BEGAN_NS, BEGAN_NS + 10**9]
    assert found["/camera/pose"][1][2]["timestamp"] == {"sec": BEGAN_NS // 10**9 + 1, "nsec": BEGAN_NS % 10**9}


def test_cameras_are_where_the_result_has_them(folder, tmp_path):
    found = read(export_scene(folder, "mcap", tmp_path / "scene.mcap").read_bytes())
    [_, (_, _, pose)] = found["/camera/pose"]
    assert pose["frame_id"] == "world" and pose["pose"]["position"] == {"x": 2, "y": -0.5, "z": 0.25}
    turn = pose["pose"]["orientation"]  # by -0.7 radians about y
    assert np.allclose([turn[axis] for axis in "wxyz"], [np.cos(0.35), 0, -np.sin(0.35), 0])
    [transform] = found["/tf"][1][2]["transforms"]
    assert (transform["translation"], transform["rotation"]) == (pose["pose"]["position"], turn)
    calibration = found["/camera/calibration"][0][2]
    assert calibration["K"] == [400, 0, 255.5, 0, 410, 191.5, 0, 0, 1]  # the top-left pixel's centre is at (0, 0)
    assert (calibration["width"], calibration["height"], len(calibration["P"])) == (512, 384, 12)


def test_the_photograph_is_of_the_calibration_s_size_and_rgb(folder, tmp_path):
    [(time, _, image)] = read(export_scene(folder, "mcap", tmp_path / "scene.mcap").read_bytes())["/camera/image"]
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(image["data"]), np.uint8), cv2.IMREAD_COLOR)
    assert time == BEGAN_NS and image["format"] == "jpeg" and pixels.shape == (384, 512, 3)
    assert np.abs(pixels.astype(int) - (200, 100, 50)).max() < 5


def test_points_are_those_of_the_scene(folder, tmp_path):
    found = read(export_scene(folder, "mcap", tmp_path / "scene.mcap").read_bytes())
    points, gaussians = cloud(found["/gaussians"][0][2]), make_gaussians()
    order, expected = np.argsort(points["x"]), np.argsort(gaussians.means[:, 0])
    for axis, name in enumerate("xyz"):
        assert np.allclose(points[name][order], gaussians.means[expected, axis], atol=1e-5)
    assert np.allclose(points["alpha"][order] / 255, gaussians.opacities[expected], atol=0.005)
    marks = cloud(found["/landmarks"][0][2])
    assert np.allclose(np.column_stack([marks[name] for name in "xyz"]), make_landmarks().points, atol=1e-6)


def test_without_times_frames_are_a_second_apart(tmp_path):
    write(make_snapshot(), tmp_path / "result")
    found = read(export_scene(tmp_path / "result", "mcap", tmp_path / "scene.mcap").read_bytes())
    assert [time for time, _, _ in found["/tf"]] == [0, 2 * 10**9]
    assert not {"/landmarks", "/camera/image"} & set(found)


def test_without_the_package_it_says_what_to_install(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(ModuleNotFoundError) as lacking:
        export_scene(folder, "mcap", tmp_path / "scene.mcap")
    assert remedy(lacking.value.name) == "Run: pip install 'splatnode[mcap]'"
    assert not (tmp_path / "scene.mcap").exists()
