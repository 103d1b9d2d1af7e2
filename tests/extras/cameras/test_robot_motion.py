"""tf, tf_static, odometry and an IMU of an MCAP file give images their mount, their pose and gravity."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import Frame
from splatnode.extras.cameras.mcap import Config, stream
from splatnode.extras.logged.messages import UnusableMessage
from splatnode.extras.logged.transforms import parse_imu, parse_odometry, read_robot_motion
from splatnode.recon.metric.measurement import MetricConfig
from splatnode.recon.metric.metres import apply_metric_scale, gather_evidence
from splatnode.recon.result.verdict import Code, FrameName
from tests.recon.metric.test_poses import NAMES, TRUE, scene
from tests.support import mcap_files, ros2
from tests.support.mcap_files import START_NS

OPTICAL = "camera_optical_frame"
IMAGE = np.full((48, 64, 3), 90, np.uint8)
STEP_NS = 200_000_000


def pose(rotation=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", rotation, degrees=True).as_matrix(), shift
    return T


# A camera 0.2 m before the base and 0.5 m above it, 10 degrees down, and the optical frame in it.
T_BASE_LINK = pose((0.0, 10.0, 0.0), (0.2, 0.0, 0.5))
T_LINK_OPTICAL = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
T_BASE_CAMERA = T_BASE_LINK @ T_LINK_OPTICAL
T_BASE_IMU = pose((180.0, 0.0, 90.0), (0.0, 0.1, 0.2))  # mounted upside down
BODY = [("base_link", "camera_link", T_BASE_LINK), ("camera_link", OPTICAL, T_LINK_OPTICAL)]
IMU = ("base_link", "imu_link", T_BASE_IMU)


def base_at(index: float) -> np.ndarray:
    """T_odom_base of the robot that carries the camera of the built-in capture; between images it moves evenly."""
    before, after = (TRUE[min(int(index) + more, len(TRUE) - 1)] @ np.linalg.inv(T_BASE_CAMERA) for more in (0, 1))
    part = index - int(index)
    T = np.eye(4)
    turn = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec()
    T[:3, :3] = before[:3, :3] @ Rotation.from_rotvec(part * turn).as_matrix()
    T[:3, 3] = (1.0 - part) * before[:3, 3] + part * after[:3, 3]
    return T


def measure_gravity(index: float) -> np.ndarray:
    """What the accelerometer measures at rest: what keeps it from falling, in its frame."""
    R_odom_imu = base_at(index)[:3, :3] @ T_BASE_IMU[:3, :3]
    return R_odom_imu.T @ [0.0, 0.0, 9.81]


def measure_turn(index: float) -> tuple[float, ...]:
    """What the gyroscope measures until the next measurement, rad/s in its frame."""
    before, after = (base_at(index + more)[:3, :3] @ T_BASE_IMU[:3, :3] for more in (0.0, 0.05))
    return tuple((Rotation.from_matrix(before.T @ after).as_rotvec() / 0.01).tolist())


def write_drive(file: Path, by: str = "tf", images: int = 8, further: tuple = ()) -> Path:
    """The drive: odometry at 50 Hz `by` tf or by odometry, an IMU at 100 Hz, and an image every 0.2 s."""
    written = [ros2.transforms(ros2.STATIC, START_NS, *BODY, IMU), *further]
    for tick in range(-40, 20 * (images - 1) + 40):
        at_ns, index = START_NS + tick * STEP_NS // 20, max(0.0, tick / 20)
        if by == "tf" and tick % 2 == 0:
            written.append(ros2.transforms(ros2.MOVING, at_ns, ("odom", "base_link", base_at(index))))
        if by == "odometry" and tick % 2 == 0:
            written.append(ros2.odometry(at_ns, "odom", "base_link", base_at(index)))
        turn = measure_turn(index) if tick >= 0 else (0.0, 0.0, 0.0)
        written.append(ros2.imu(at_ns, "imu_link", measure_gravity(index).tolist(), turn=turn))
    written += [ros2.compressed(START_NS + number * STEP_NS, OPTICAL, IMAGE) for number in range(images)]
    return mcap_files.write(file, written)


def read(file: Path, **settings) -> list[Frame]:
    return [each for each in stream(Config(file, **settings)) if isinstance(each, Frame)]


@pytest.mark.parametrize("by", ["tf", "odometry"])
def test_images_carry_what_the_robot_knows(tmp_path, by):
    frames = read(write_drive(tmp_path / "drive.mcap", by))
    assert len(frames) == 8
    for frame, T in zip(frames, TRUE, strict=True):
        assert frame.mount is not None and frame.given_pose is not None and frame.gravity is not None
        np.testing.assert_allclose(frame.mount, T_BASE_CAMERA, atol=1e-9)
        np.testing.assert_allclose(frame.given_pose.matrix, T, atol=1e-6)
        np.testing.assert_allclose(frame.gravity.direction, -T[:3, :3].T @ [0, 0, 1], atol=1e-6)
        assert frame.gravity.sigma_deg == pytest.approx(2.0, abs=0.01)


@pytest.mark.parametrize("asked", [None, "odom", "base_link", "upright", "first_camera"])
def test_a_scene_of_a_log_lies_in_the_frame_that_is_asked_for(tmp_path, asked):
    frames = read(write_drive(tmp_path / "drive.mcap"))
    named = [Frame(**{**vars(frame), "name": name}) for frame, name in zip(frames, NAMES, strict=True)]
    config = MetricConfig(frame=asked)
    made = apply_metric_scale(scene(), config, gather_evidence(named, config))
    first = made.cameras[0].T_world_camera
    assert made.scale.metric and made.verdict.code is not Code.FRAME_UNKNOWN
    if asked in (None, "odom"):
        assert made.scale.frame.name is FrameName.ODOMETRY
        np.testing.assert_allclose([each.T_world_camera for each in made.cameras], TRUE, atol=2e-3)
    if asked == "base_link":
        np.testing.assert_allclose(first, T_BASE_CAMERA, atol=1e-9)
        T_base_odom = T_BASE_CAMERA @ np.linalg.inv(TRUE[0])
        np.testing.assert_allclose(made.cameras[7].T_world_camera, T_base_odom @ TRUE[7], atol=2e-3)
    if asked == "upright":
        np.testing.assert_allclose(first[:3, :3].T @ [0, 0, 1], TRUE[0][:3, :3].T @ [0, 0, 1], atol=0.03)
    if asked == "first_camera":
        np.testing.assert_allclose(first, np.eye(4), atol=1e-9)


def test_what_the_log_does_not_tell_is_left_out(tmp_path):
    file = write_drive(tmp_path / "drive.mcap", by="none", images=2)
    assert [frame.given_pose for frame in read(file)] == [None, None]
    assert all(frame.mount is not None and frame.gravity is not None for frame in read(file))
    other = read(file, base_frame="torso")
    assert [frame.mount for frame in other] == [None, None]
    blank = read(mcap_files.write(tmp_path / "b.mcap", [ros2.compressed(START_NS, OPTICAL, IMAGE)]))
    assert (blank[0].mount, blank[0].given_pose, blank[0].gravity) == (None, None, None)
    with_poses = write_drive(tmp_path / "c.mcap", images=2)
    assert [frame.given_pose for frame in read(with_poses, odometry_frame="")] == [None, None]
    robot = read_robot_motion(with_poses)
    late_ns = START_NS + 10 * 10**9
    assert robot.make_given_pose("odom", OPTICAL, late_ns) is None and robot.make_gravity(OPTICAL, late_ns) is None
    assert robot.find_pose("base_link", OPTICAL, late_ns) is not None  # what does not move stands for ever


def test_an_accelerometer_that_does_not_rest_tells_no_gravity(tmp_path):
    def gravity_of(*accelerations, frame="imu_link", covariance=0.0):
        told = [ros2.imu(START_NS + 10**7 * n, frame, each, covariance) for n, each in enumerate(accelerations)]
        body = ros2.transforms(ros2.STATIC, START_NS, *BODY, IMU)
        shot = ros2.compressed(START_NS, OPTICAL, IMAGE)
        return read(mcap_files.write(tmp_path / "a.mcap", [body, *told, shot]))[0].gravity

    rest = [0.0, 0.0, -9.81]  # it is mounted upside down
    known = gravity_of(*[rest] * 5)
    assert known is not None
    np.testing.assert_allclose(known.direction, -T_BASE_CAMERA[:3, :3].T @ [0, 0, 1], atol=1e-9)
    assert gravity_of(*[[0.0, 0.0, 0.1]] * 5) is None  # a driver that takes gravity out
    assert gravity_of(*[[6.0, 0.0, -9.81]] * 5) is None  # it brakes
    assert gravity_of(*[rest] * 2) is None and gravity_of(*[rest] * 5, frame="somewhere") is None
    assert gravity_of(*[rest] * 5, covariance=-1.0) is None  # REP 145: it has no accelerometer
    shaken = gravity_of(*[[2.0, 0.0, -9.81], [-2.0, 0.0, -9.81]] * 3)
    assert shaken is not None and shaken.sigma_deg > known.sigma_deg + 1.0


def test_a_head_that_turns_is_mounted_where_it_is_at_each_image(tmp_path):
    written = [ros2.transforms(ros2.STATIC, START_NS, ("head", OPTICAL, T_LINK_OPTICAL))]
    written += [ros2.transforms(ros2.MOVING, START_NS + n * 10**8, ("base_link", "head", pose((0, 0, 9.0 * n))))
                for n in range(3)]  # fmt: skip
    written += [ros2.compressed(START_NS + at, OPTICAL, IMAGE) for at in (0, 50_000_000, 200_000_000)]
    mounts = [frame.mount for frame in read(mcap_files.write(tmp_path / "a.mcap", written))]
    for mount, degrees in zip(mounts, (0.0, 4.5, 18.0), strict=True):
        np.testing.assert_allclose(mount, pose((0, 0, degrees)) @ T_LINK_OPTICAL, atol=1e-6)


def test_transforms_that_are_no_tree_or_no_motion_harm_nothing(tmp_path):
    circle = ros2.transforms(ros2.MOVING, START_NS, ("a", "b", np.eye(4)), ("b", "a", np.eye(4)))
    far = ros2.transforms(ros2.MOVING, START_NS, ("odom", "base_link", pose(shift=(1e300, 0, 0))))
    short = ("/odom", "nav_msgs/msg/Odometry", "ros2msg", b"", ros2.odometry(START_NS, "odom", "x", np.eye(4))[4][:40])
    file = write_drive(tmp_path / "drive.mcap", images=2, further=(circle, far, short))
    assert all(frame.given_pose is not None for frame in read(file))
    assert read_robot_motion(file).find_pose("a", OPTICAL, START_NS) is None


def test_a_log_that_is_made_to_take_long_does_not(tmp_path):
    chain = [(f"f{n + 1}", f"f{n}", np.eye(4)) for n in range(5000)] + [("f0", OPTICAL, T_LINK_OPTICAL)]
    dense = [ros2.imu(START_NS + n, "imu_link", (0.0, 0.0, -9.81), turn=(1.0, 2.0, 3.0)) for n in range(3000)]
    shots = [ros2.compressed(START_NS + n, OPTICAL, IMAGE) for n in range(40)]
    body = [ros2.transforms(ros2.STATIC, START_NS, *chain), ros2.transforms(ros2.STATIC, START_NS, IMU)]
    file = mcap_files.write(tmp_path / "a.mcap", [*body, *dense, *shots])
    begun = time.process_time()
    assert [frame.mount for frame in read(file, base_frame="f5000")] == [None] * 40
    assert time.process_time() - begun < 20.0
    on_base = ros2.transforms(ros2.STATIC, START_NS, *BODY, IMU)
    assert all(frame.gravity for frame in read(mcap_files.write(tmp_path / "b.mcap", [on_base, *dense, *shots[:3]])))


def test_messages_are_read_as_they_are_defined():
    told = parse_odometry(ros2.odometry(5, "odom", "base", pose(shift=(1.0, 2.0, 3.0)))[4])
    assert (told.parent, told.child, told.translation, told.rotation) == ("odom", "base", (1, 2, 3), (0, 0, 0, 1))
    measured = parse_imu(ros2.imu(7, "imu", (1.0, 2.0, 3.0))[4])
    assert measured is not None and (measured.frame, measured.stamp_ns, measured.acceleration) == ("imu", 7, (1, 2, 3))
    assert measured.turn == (0, 0, 0)
    with pytest.raises(UnusableMessage, match="ends within"):
        parse_imu(ros2.imu(7, "imu", (1.0, 2.0, 3.0))[4][:200])
