"""evo, which evaluates trajectories of SLAM, reads trajectory.tum and compares it with odometry.

It brings half a gigabyte, so that it is no part of the extra dev. `pip install evo` lets this test run.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.capture.image_header import name_time
from splatnode.recon.result.export.formats.tum import encode_tum
from splatnode.recon.result.snapshot import CameraEstimate

WITHOUT = "needs evo: pip install evo"
file_interface = pytest.importorskip("evo.tools.file_interface", reason=WITHOUT, exc_type=ImportError)
metrics = pytest.importorskip("evo.core.metrics", reason=WITHOUT)
sync = pytest.importorskip("evo.core.sync", reason=WITHOUT)

BEGAN_S = 1_341_847_980
METRES = 2.5  # of a unit of the scene
OF_SCENE = Rotation.from_euler("xyz", [20, -130, 75], degrees=True)


def walked(seconds: float) -> tuple[Rotation, np.ndarray]:
    """How the robot stands so many seconds after the start, by its odometry: direction, and position (3,) in metres."""
    turn = Rotation.from_euler("xyz", [0.1 * seconds, 0.7 * seconds, 0.05 * np.sin(seconds)])
    return turn, np.array([np.cos(seconds), 0.3 * seconds, np.sin(1.3 * seconds)])


def odometry() -> str:
    """A TUM file at 50 Hz, which begins a second before the first photograph."""
    lines = []
    for index in range(600):
        turn, position = walked(index / 50 - 1)
        row = [*position, *turn.as_quat()]  # x y z w
        lines.append(f"{BEGAN_S + index / 50 - 1:.6f} " + " ".join(f"{value:.9f}" for value in row))
    return "\n".join(lines) + "\n"


def camera(frame_id: int) -> CameraEstimate:
    """The camera of a photograph every half second, in a scene that lies elsewhere and has another unit."""
    turn, position = walked(frame_id / 2)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = (OF_SCENE * turn).as_matrix()
    T_world_camera[:3, 3] = OF_SCENE.apply(position) / METRES + [3, -1, 4]
    name = f"{BEGAN_S + frame_id // 2}.{frame_id % 2 * 5}04000.png"
    return CameraEstimate(name, frame_id, T_world_camera, np.eye(3), 640, 480, captured_at=name_time(name))


def test_evo_finds_the_scale_and_no_error_between_the_cameras_and_the_odometry(tmp_path):
    (tmp_path / "odometry.tum").write_text(odometry())
    (tmp_path / "trajectory.tum").write_bytes(encode_tum([camera(index) for index in range(16)]))
    reference = file_interface.read_tum_trajectory_file(tmp_path / "odometry.tum")
    ours = file_interface.read_tum_trajectory_file(tmp_path / "trajectory.tum")
    assert ours.check()[0] and ours.num_poses == 16
    reference, ours = sync.associate_trajectories(reference, ours, max_diff=0.01)
    assert ours.num_poses == 16
    _, _, scale = ours.align(reference, correct_scale=True)
    assert scale == pytest.approx(METRES, rel=1e-3)
    for relation, most in (("translation_part", 0.02), ("rotation_angle_deg", 0.5)):
        error = metrics.APE(metrics.PoseRelation[relation])
        error.process_data((reference, ours))
        assert error.get_statistic(metrics.StatisticsType.max) < most
