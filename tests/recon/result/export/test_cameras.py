"""cameras.json reads back exactly, and what is something else is a clear error."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from splatnode.capture.frame import Intrinsics
from splatnode.recon.result.export import SceneFileError, export_scene, read_cameras
from splatnode.recon.result.snapshot import GivenCameraPose
from tests.support.exported import make_snapshot, stamped, write


def test_cameras_read_back_exactly(tmp_path):
    write(make_snapshot(), tmp_path)
    for read, camera in zip(read_cameras(tmp_path / "cameras.json"), make_snapshot().cameras, strict=True):
        assert np.array_equal(read.T_world_camera, camera.T_world_camera)
        assert np.array_equal(read.K, camera.K)
        assert (read.name, read.frame_id, read.width, read.height) == (camera.name, camera.frame_id, 512, 384)
        assert read.bounds == camera.bounds is not None


def test_an_estimated_lens_reads_back_exactly_and_a_file_without_is_that_of_an_earlier_version(tmp_path):
    lens = Intrinsics(4000, 3000, 3200.5, 3200.5, 2001.0, 1499.0, "estimated", (-0.1, 0.0, 0.0, 0.0))
    snapshot = make_snapshot()
    first, *others = snapshot.cameras
    write(replace(snapshot, cameras=(replace(first, lens=lens), *others)), tmp_path)
    file = tmp_path / "cameras.json"
    assert [camera.lens for camera in read_cameras(file)] == [lens, None]
    content = json.loads(file.read_text())
    for camera in content["cameras"]:
        camera.pop("lens")
    file.write_text(json.dumps(content))
    assert [camera.lens for camera in read_cameras(file)] == [None, None]
    content["cameras"][0]["lens"] = {**asdict(lens), "fx": -1.0}
    file.write_text(json.dumps(content))
    with pytest.raises(SceneFileError, match="cameras.json"):
        read_cameras(file)


def test_times_of_capture_read_back_to_the_nanosecond_and_are_in_the_other_files(tmp_path):
    snapshot = stamped(make_snapshot())
    write(snapshot, tmp_path)
    read = [camera.captured_at for camera in read_cameras(tmp_path / "cameras.json")]
    assert read == [camera.captured_at for camera in snapshot.cameras] and read[0].ns == 1_714_989_607_250_000_001
    for name, entries in {"cameras.json": "cameras", "report.json": "cameras", "transforms.json": "frames"}.items():
        first = json.loads((tmp_path / name).read_text())[entries][0]
        assert (first["stamp_ns"], first["clock"]) == (1_714_989_607_250_000_001, "utc"), name
    trajectory = (tmp_path / "trajectory.tum").read_bytes()
    assert b"\n1714989607.250000001 " in trajectory
    assert export_scene(tmp_path, "tum", tmp_path / "again.tum").read_bytes() == trajectory


def test_a_file_without_times_is_that_of_an_earlier_version_and_of_photographs_without(tmp_path):
    write(make_snapshot(), tmp_path)
    file = tmp_path / "cameras.json"
    content = json.loads(file.read_text())
    for camera in content["cameras"]:
        assert camera.pop("stamp_ns") is None and camera.pop("clock") is None
    file.write_text(json.dumps(content))
    assert [camera.captured_at for camera in read_cameras(file)] == [None, None]


@pytest.mark.parametrize(
    "parts",
    [
        {"stamp_ns": -1},
        {"stamp_ns": 2**63},
        {"stamp_ns": 1.5},
        {"clock": "sundial"},
        {"clock": None},
        {"stamp_ns": None},
    ],
)
def test_a_time_that_is_none_is_a_clear_error(tmp_path, parts):
    write(stamped(make_snapshot()), tmp_path)
    content = json.loads((tmp_path / "cameras.json").read_text())
    content["cameras"][0] |= parts
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    with pytest.raises(SceneFileError, match="cameras.json"):
        read_cameras(tmp_path / "cameras.json")


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


def test_two_cameras_of_one_name_are_a_clear_error(tmp_path):
    """Files of all formats, and edits of scenes, know a camera by its name."""
    write(make_snapshot(), tmp_path)
    file = tmp_path / "cameras.json"
    content = json.loads(file.read_text())
    for camera in content["cameras"]:
        camera["name"] = "same.png"
    file.write_text(json.dumps(content))
    with pytest.raises(SceneFileError, match=r"cameras\.json has two cameras of one name"):
        read_cameras(file)


def test_camera_ids_frame_sets_and_given_poses_read_back_exactly(tmp_path):
    first, second = make_snapshot().cameras
    T_given = first.T_world_camera.copy()
    T_given[:3, 3] += [0.03, 0.0, 0.04]
    first = replace(first, name="left/1.jpg", camera_id="left", frame_set=3, given=GivenCameraPose(T_given, 0.01, 0.5))
    second = replace(second, name="right/1.jpg", camera_id="right", frame_set=3)
    write(replace(make_snapshot(), cameras=(first, second)), tmp_path)
    file = tmp_path / "cameras.json"
    back = read_cameras(file)
    assert [(each.name, each.camera_id, each.frame_set) for each in back] == [
        ("left/1.jpg", "left", 3),
        ("right/1.jpg", "right", 3),
    ]
    assert back[0].given is not None and np.array_equal(back[0].given.T_world_camera, T_given)
    assert back[0].pose_residual == pytest.approx((0.05, 0.0), abs=1e-6) and back[1].given is None
    told = json.loads(file.read_text())["cameras"][0]["given"]
    assert (told["sigma_m"], told["sigma_deg"]) == (0.01, 0.5) and told["residual_m"] == pytest.approx(0.05)
    report = json.loads((tmp_path / "report.json").read_text())
    assert [(each["name"], round(each["residual_m"], 6)) for each in report["given_poses"]] == [("left/1.jpg", 0.05)]
    frame = json.loads((tmp_path / "transforms.json").read_text())["frames"][0]
    assert (frame["camera_id"], frame["frame_set"]) == ("left", 3)
    given = np.array(frame["given"]["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert np.allclose(given, T_given)


@pytest.mark.parametrize("name", ["/etc/passwd", "../a.png", "a//b.png", "left/../../a.png", "left/"])
def test_a_name_leads_out_of_no_folder(tmp_path, name):
    write(make_snapshot(), tmp_path)
    file = tmp_path / "cameras.json"
    content = json.loads(file.read_text())
    content["cameras"][0]["name"] = name
    file.write_text(json.dumps(content))
    with pytest.raises(SceneFileError, match="a name must be that of a file"):
        read_cameras(file)
