"""The formats in which poses come, and how photographs find theirs."""

from __future__ import annotations

import json
import struct
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from splatnode.capture import pose_files
from splatnode.capture.frame import Clock, Frame, Stamp, are_rigid, rigid_problem
from splatnode.capture.pose_files import PosesFileError, Trajectory, each_line, poses_of, read_poses
from splatnode.recon.result.export import export_scene
from splatnode.recon.result.report import write_result_folder
from tests.recon.metric.test_poses import NAMES, TRUE, scene

SEEN = np.zeros((8, 8, 3), np.uint8)


def frame(name: str, frame_id: int = 0, seconds: float | None = None, clock: Clock = Clock.UTC) -> Frame:
    stamp = None if seconds is None else Stamp(round(1e9 * seconds), clock)
    return Frame(frame_id, name, frame_id, SEEN, None, captured_at=stamp)


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    """A result whose cameras are known, in every format that it writes."""
    out = tmp_path_factory.mktemp("saved")
    write_result_folder(scene(), out, seed=0, preset_name="fast")
    export_scene(out, "colmap", out / "again")
    return out


@pytest.mark.parametrize("name", ["transforms.json", "colmap", "colmap/images.txt", "again", "trajectory.tum"])
def test_what_a_result_writes_is_read(saved, name):
    frames = [frame(NAMES[index], index) for index in range(8)]
    found = poses_of(read_poses(saved / name), frames, name)
    assert list(found) == NAMES
    for camera in scene().cameras:
        np.testing.assert_allclose(found[camera.name], camera.T_world_camera, atol=1e-6)


def test_a_binary_model_is_read(saved, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    pycolmap.Reconstruction(str(saved / "again")).write_binary(str(tmp_path))
    found = read_poses(tmp_path).by_name
    np.testing.assert_allclose(found[NAMES[3]], scene().cameras[3].T_world_camera, atol=1e-6)


def test_times_between_two_poses_are_interpolated(tmp_path):
    file = tmp_path / "odometry.txt"
    file.write_text("# time x y z qx qy qz qw\n100.0 0 0 0 0 0 0 1\n100.5 1 0 0 0 0 0.7071067811865476 0.70710678\n")
    found = read_poses(file).find_poses(
        [frame("a.png", 0, 100.25), frame("b.png", 1, 100.51), frame("c.png", 2, 101.0), frame("d.png", 3)]
    )
    assert list(found) == ["a.png", "b.png"]
    np.testing.assert_allclose(found["a.png"][:3, 3], [0.5, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(found["a.png"][:2, 0], [np.cos(np.pi / 4), np.sin(np.pi / 4)], atol=1e-6)


def test_whole_seconds_are_those_of_a_recording_and_else_may_number_the_frames(tmp_path):
    """At ten frames a second the frame of .3 s is number 3, and not where the camera was at 3 s."""
    file = tmp_path / "odometry.txt"
    file.write_text("".join(f"{second} {second} 0 0 0 0 0 1\n" for second in range(5)))
    timed = [frame(f"{number}.png", number, number / 10, Clock.RECORDING) for number in range(40)]
    found = read_poses(file).find_poses(timed)
    np.testing.assert_allclose([T[0, 3] for T in found.values()], np.arange(40) / 10, atol=1e-9)
    numbered = read_poses(file).find_poses([frame("a.png", 3), frame("b.png", 4, 1.7e9)])
    assert [T[0, 3] for T in numbered.values()] == [3.0, 4.0]


def test_a_trajectory_may_name_photographs(tmp_path):
    file = tmp_path / "poses.tum"
    file.write_text("a.jpg 1 2 3 0 0 0 1\nb.jpg 4 5 6 0 0 0 1\n")
    found = read_poses(file).find_poses([frame("b.jpg"), frame("c.jpg")])
    assert list(found) == ["b.jpg"] and found["b.jpg"][:3, 3].tolist() == [4.0, 5.0, 6.0]


def test_a_line_may_tell_how_unsure_its_pose_is(tmp_path):
    file = tmp_path / "poses.tum"
    file.write_text("a.jpg 1 2 3 0 0 0 1 0.002 0.3\nb.jpg 4 5 6 0 0 0 1\n")
    assert read_poses(file).find_sigmas([frame("a.jpg"), frame("b.jpg"), frame("c.jpg")]) == {"a.jpg": (0.002, 0.3)}
    file.write_text("100.0 0 0 0 0 0 0 1 0.1 1\n100.5 1 0 0 0 0 0 1 0.2 0.5\n101.0 2 0 0 0 0 0 1\n")
    timed = [frame("a.png", 0, 100.0), frame("b.png", 1, 100.25), frame("c.png", 2, 100.75), frame("d.png", 3, 105.0)]
    assert read_poses(file).find_sigmas(timed) == {"a.png": (0.1, 1.0), "b.png": (0.2, 1.0)}


def test_transforms_may_tell_how_unsure_a_pose_is(tmp_path):
    file = tmp_path / "transforms.json"
    row = {"transform_matrix": np.eye(4).tolist()}
    told = {"file_path": "images/a.png", "sigma_m": 0.001, "sigma_deg": 0.1}
    file.write_text(json.dumps({"frames": [{**row, **told}, {**row, "file_path": "b.png"}]}))
    assert read_poses(file).find_sigmas([frame("a.png"), frame("b.png")]) == {"a.png": (0.001, 0.1)}


def test_no_photograph_with_a_pose_is_told(tmp_path):
    with pytest.raises(PosesFileError, match=r"it has photographs such as a\.png, and the first photograph is z\.png"):
        poses_of(Trajectory({"a.png": TRUE[0]}), [frame("z.png")], "poses.json")
    timed = Trajectory(seconds=np.array([5.5, 6.0]), Ts=np.stack(TRUE[:2]))
    with pytest.raises(PosesFileError, match=r"the times 5\.500 to 6\.000 s"):
        poses_of(timed, [frame("z.png", 0, 100.0)], "poses.tum")


def transforms(T: np.ndarray, times: int) -> str:
    return json.dumps({"frames": [{"file_path": "a", "transform_matrix": T.tolist()}] * times})


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.tum", "1 2 3\n", "eight values"),
        ("a.tum", "", "eight values"),
        ("a.tum", "1 0 0 0 0 0 0 0\n", "rigid motion|finite"),
        ("a.tum", "nan 0 0 0 0 0 0 1\n", "times must be finite"),
        ("a.tum", "1 0 0 0 0 0 0 1 0.1\n", "ten with the sigmas"),
        ("a.tum", "1 0 0 0 0 0 0 1 0 1\n", "the pose of 1 must be metres and degrees above 0"),
        ("a.tum", "a.png 0 0 0 0 0 0 1 0.1 nan\n", "the pose of a.png must be metres .* got 0.1 and nothing"),
        (
            "a.json",
            '{"frames": [{"file_path": "a", "sigma_m": 1, "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], '
            "[0, 0, 1, 0], [0, 0, 0, 1]]}]}",
            "the pose of a must be metres .* got 1 and nothing",
        ),
        ("a.json", "{}", "frames"),
        (
            "a.json",
            json.dumps({"frames": [{"file_path": "a", "transform_matrix": np.zeros((4, 4)).tolist()}]}),
            "rigid",
        ),
        (
            "a.json",
            json.dumps({"frames": [{"file_path": "a", "transform_matrix": np.eye(4).tolist()}] * 2}),
            "two poses",
        ),
        ("images.txt", "1 1 0 0 0 0 0\n", "images.txt"),
        ("images.bin", "xx", "images.bin"),
    ],
)
def test_what_is_no_file_of_poses_is_refused(tmp_path, name, content, told):
    file = tmp_path / name
    file.write_text(content)
    with pytest.raises(PosesFileError, match=told) as refused:
        read_poses(file)
    assert str(file) in str(refused.value)


def test_a_folder_must_hold_a_model(tmp_path):
    with pytest.raises(PosesFileError, match=r"must hold images\.txt or images\.bin"):
        read_poses(tmp_path)


MANY = 30_000


def many(kind: str) -> tuple[str, bytes]:
    """A file of many poses, and its name."""
    if kind == "tum":
        return "a.tum", b"".join(b"%d.5 1 2 3 0 0 0 1\n" % n for n in range(MANY))
    if kind == "names":
        return "a.tum", b"".join(b"%d.jpg 1 2 3 0 0 0 1\n" % n for n in range(MANY))
    if kind == "text":
        return "images.txt", b"".join(b"%d 1 0 0 0 1 2 3 1 %d.jpg\n\n" % (n, n) for n in range(MANY))
    if kind == "binary":
        rows = (struct.pack("<I7dI", n, 1, 0, 0, 0, 1, 2, 3, 1) + b"%d.jpg\0" % n + bytes(8) for n in range(MANY))
        return "images.bin", struct.pack("<Q", MANY) + b"".join(rows)
    frames = [{"file_path": f"{n}.jpg", "transform_matrix": np.eye(4).tolist()} for n in range(MANY)]
    return "transforms.json", json.dumps({"frames": frames}).encode()


@pytest.mark.parametrize("kind", ["tum", "names", "text", "binary", "json"])
def test_many_poses_are_read_soon(tmp_path, kind):
    """Sooner than each of them can be judged by itself."""
    name, content = many(kind)
    (tmp_path / name).write_bytes(content)
    began = time.process_time()
    found = read_poses(tmp_path / name)
    taken_s = time.process_time() - began
    assert len(found.by_name) + len(found.seconds) == MANY
    numbers = np.eye(4).ravel().tolist()
    began = time.process_time()
    for _ in range(MANY // 10):
        rigid_problem(numbers)
    assert taken_s < 10 * (time.process_time() - began)


def test_a_time_is_looked_up_without_a_look_at_all_others(tmp_path):
    seconds = np.arange(1_000_000.0)
    trajectory = Trajectory(seconds=seconds, Ts=np.broadcast_to(np.eye(4), (len(seconds), 4, 4)))
    frames = [frame(f"{number}.png", number) for number in range(500)]
    began = time.process_time()
    assert len(trajectory.find_poses(frames)) == 500
    taken_s = time.process_time() - began
    began = time.process_time()
    for _ in range(50):
        assert (seconds == np.floor(seconds)).all()
    assert taken_s < time.process_time() - began


@pytest.mark.parametrize("kind", ["tum", "names", "text", "binary", "json"])
def test_more_poses_than_are_read_are_refused(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(pose_files, "MOST_POSES", 100)
    name, content = many(kind)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(PosesFileError, match="at most 100 poses are read, and there are more"):
        read_poses(tmp_path / name)


def test_lines_that_are_empty_take_no_memory(tmp_path):
    text = "\n" * 100_000
    tracemalloc.start()
    assert sum(1 for _ in each_line(text)) == 100_000
    most_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most_bytes < 20_000
    assert list(each_line("a\r\nb\n\nc")) == ["a", "b", "", "c"] and list(each_line("a\rb")) == ["a", "b"]


@pytest.mark.parametrize("seed", range(3))
def test_many_matrices_are_judged_as_one_is(seed):
    rng = np.random.default_rng(seed)
    matrices = np.tile(np.eye(4), (200, 1, 1)) + rng.normal(size=(200, 4, 4)) * 10.0 ** rng.integers(-9, 2, (200, 1, 1))
    matrices[rng.random((200, 4, 4)) < 0.002] = np.nan
    for matrix, is_rigid in zip(matrices, are_rigid(matrices), strict=True):
        assert not (is_rigid and rigid_problem(matrix.ravel().tolist()))
    assert are_rigid(np.stack(TRUE)).all()


def test_poses_of_several_cameras_are_found_with_the_cameras_folder(tmp_path):
    """Photographs of two cameras have one name: their folders tell them apart, and none gets the other one's pose."""
    left, right = np.eye(4), np.eye(4)
    right[0, 3] = 0.5
    frames = {"rig/left/1.png": left, "rig/right/1.png": right, "rig/left/2.png": right}
    content = {"frames": [{"file_path": name, "transform_matrix": T.tolist()} for name, T in frames.items()]}
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps(content))
    found = read_poses(file).find_poses([frame(name) for name in ("left/1.png", "right/1.png", "right/2.png")])
    assert sorted(found) == ["left/1.png", "right/1.png"]
    assert (found["left/1.png"][0, 3], found["right/1.png"][0, 3]) == (0.0, 0.5)
