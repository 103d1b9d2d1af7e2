"""A scene in the frame of reference that was asked for, by hand-made mounts, gravity and poses; else a refusal."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.capture.diorama import look_at
from splatnode.capture.frame import Gravity, Motion, make_given_pose
from splatnode.command_line import exit_code
from splatnode.recon.metric.measurement import Baseline, MetricConfig
from splatnode.recon.metric.metres import (
    NOTHING,
    Evidence,
    UnknownFrame,
    apply_metric_scale,
    check_frame,
    make_upright_frame,
    transform_rigidly,
)
from splatnode.recon.result.export import write_result
from splatnode.recon.result.export.limits import SceneFileError
from splatnode.recon.result.export.stored import decode_cameras, decode_scale
from splatnode.recon.result.message import make_scale_record, parse_scale
from splatnode.recon.result.report import build_report
from splatnode.recon.result.snapshot import GaussianArrays, Snapshot
from splatnode.recon.result.stored_snapshot import read_result
from splatnode.recon.result.verdict import Code, FrameName, ReferenceFrame, Scale, encode_matrix, parse_frame_name
from tests.recon.metric.test_poses import NAMES, TRUE, UNIT, scene
from tests.recon.occupancy.test_floor import room

# A camera 0.3 m before the base and 1.2 m above it, which looks ahead: REP 103's optical frame on a base.
AHEAD = np.array([[0.0, 0.0, 1.0, 0.3], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.2], [0.0, 0.0, 0.0, 1.0]])
APART = float(np.linalg.norm(TRUE[7][:3, 3] - TRUE[0][:3, 3]))
METRES = Baseline(NAMES[0], NAMES[7], APART)
UP = np.array([0.0, 0.0, 1.0])  # in the place of the true poses


def asked(frame: str | None, metric: bool = True, **settings) -> MetricConfig:
    return MetricConfig(frame=frame, baseline=METRES if metric else None, **settings)  # pyright: ignore


def mounts(T=AHEAD) -> dict[str, np.ndarray]:
    return dict.fromkeys(NAMES, T)


def gravities() -> dict[str, Gravity]:
    return {name: Gravity(tuple((-T[:3, :3].T @ UP).tolist()), 1.0) for name, T in zip(NAMES, TRUE, strict=True)}


def assert_same_scene(moved: Snapshot, metric: bool = True) -> None:
    """All cameras are to each other, and the Gaussians to the cameras, as they were before."""
    before, factor = scene(), UNIT if metric else 1.0
    for old, new in zip(before.cameras, moved.cameras, strict=True):
        relative = np.linalg.inv(before.cameras[0].T_world_camera) @ old.T_world_camera
        relative[:3, 3] *= factor
        now = np.linalg.inv(moved.cameras[0].T_world_camera) @ new.T_world_camera
        np.testing.assert_allclose(now, relative, atol=1e-9)
    for which in (0, 5):
        old, new = before.cameras[which].T_world_camera, moved.cameras[which].T_world_camera
        in_camera = (before.gaussians.means - old[:3, 3]) @ old[:3, :3]
        now = (moved.gaussians.means - new[:3, 3]) @ new[:3, :3]
        np.testing.assert_allclose(now, factor * in_camera, atol=1e-5)


def test_the_base_is_where_its_mount_says():
    moved = apply_metric_scale(scene(), asked("base"), Evidence(mounts=mounts()))
    np.testing.assert_allclose(moved.cameras[0].T_world_camera, AHEAD, atol=1e-12)
    frame = moved.scale.frame
    assert frame.name is FrameName.BASE and frame.source == f"T_base_camera of {NAMES[0]}" and moved.scale.metric
    np.testing.assert_allclose(frame.matrix, AHEAD, atol=1e-12)
    assert_same_scene(moved)
    ahead = moved.cameras[0].T_world_camera @ [0.0, 0.0, 2.0, 1.0]  # two metres before the camera
    np.testing.assert_allclose(ahead, [2.3, 0.0, 1.2, 1.0], atol=1e-12)


def test_the_base_tells_up_where_nothing_else_does():
    """A base has z up (REP 103); gravity, where it is known, is told as it is."""
    moved = apply_metric_scale(scene(), asked("base"), Evidence(mounts=mounts()))
    assert moved.up is not None and moved.up.direction == (0.0, 0.0, 1.0) and "taken to stand level" in moved.up.source
    report = build_report(moved, seed=0, preset="fast", peak_rss_mb=None)
    assert json.loads(json.dumps(report))["up"]["direction"] == [0.0, 0.0, 1.0]
    known = apply_metric_scale(scene(), asked("base"), Evidence(mounts=mounts(), gravities=gravities()))
    expected = AHEAD[:3, :3] @ TRUE[0][:3, :3].T @ UP
    assert known.up is not None and "level" not in known.up.source
    np.testing.assert_allclose(known.up.direction, expected, atol=1e-6)


def test_a_mount_in_millimetres_is_told():
    far = AHEAD.copy()
    far[:3, 3] *= 1000.0
    known, odd = (apply_metric_scale(scene(), asked("base"), Evidence(mounts=mounts(T))) for T in (AHEAD, far))
    assert "millimetres" in (odd.scale.frame.source or "") and "millimetres" not in (known.scale.frame.source or "")


def test_names_of_ros_mean_the_same():
    assert parse_frame_name("base_link") is FrameName.BASE and parse_frame_name("odom") is FrameName.ODOMETRY
    with pytest.raises(ValueError, match="must be one of first_camera, base, odometry, upright"):
        parse_frame_name("map")
    moved = apply_metric_scale(scene(), asked("base_link"), Evidence(mounts=mounts()))
    assert moved.scale.frame.name is FrameName.BASE


def test_upright_has_z_against_gravity_and_x_ahead():
    moved = apply_metric_scale(scene(), asked("upright", metric=False), Evidence(gravities=gravities()))
    first = moved.cameras[0].T_world_camera
    np.testing.assert_allclose(first[:3, 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(first[:3, :3].T @ UP, TRUE[0][:3, :3].T @ UP, atol=1e-9)  # up in the camera stays
    assert first[0, 2] > 0 and abs(first[1, 2]) < 1e-12  # it looks along x
    assert moved.up is not None and moved.up.direction == (0.0, 0.0, 1.0)
    assert moved.scale.frame.sigma_deg is not None and 0.3 < moved.scale.frame.sigma_deg < 1.5
    assert_same_scene(moved, metric=False)
    heights = [camera.T_world_camera[2, 3] - first[2, 3] for camera in moved.cameras]
    np.testing.assert_allclose(heights, [(T[2, 3] - TRUE[0][2, 3]) / UNIT for T in TRUE], atol=1e-9)


def test_gravity_may_be_told_of_the_first_image():
    x, y, z = (-TRUE[0][:3, :3].T @ UP).tolist()
    moved = apply_metric_scale(scene(), asked("upright", metric=False, gravity=(x, y, z)))
    np.testing.assert_allclose(moved.cameras[0].T_world_camera[:3, :3].T @ UP, TRUE[0][:3, :3].T @ UP, atol=1e-9)
    assert moved.scale.frame.source == "gravity as it was told for the first image"
    with pytest.raises(ValueError, match="direction of three numbers"):
        MetricConfig(gravity=(0.0, 0.0, 0.0))


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.4, -1.1, 2.0)])
def test_a_floor_tells_where_up_is_however_the_world_is_turned(turn):
    points = room(np.random.default_rng(0), 3000, 6000, 9000).astype(np.float32)
    count = len(points)
    shapes = np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), 0.01), np.full(count, 0.5)
    quats, scales, opacities = (each.astype(np.float32) for each in shapes)
    seen = GaussianArrays(points, quats, scales, opacities, np.zeros((count, 1, 3), np.float32), np.zeros(count, int))
    Ts = [look_at(np.array([-1.0, y, 1.5]), np.array([2.0, 0.0, 0.5])) for y in (-1.0, 0.0, 1.0)]
    cameras = tuple(replace(old, T_world_camera=T) for old, T in zip(scene().cameras, Ts, strict=False))
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), [3.0, -1.0, 2.0]
    known = transform_rigidly(replace(scene(), cameras=cameras, gaussians=seen), world)
    moved = apply_metric_scale(known, asked("upright", metric=False))
    first = moved.cameras[0].T_world_camera
    off = np.degrees(np.arccos((first[:3, :3].T @ UP) @ (Ts[0][:3, :3].T @ UP)))
    assert off < 0.3 and "the floor" in (moved.scale.frame.source or "")
    assert moved.scale.frame.sigma_deg is not None and 1.0 <= moved.scale.frame.sigma_deg < 2.0
    assert moved.up is not None and moved.up.direction == (0.0, 0.0, 1.0)
    down = tuple((first[:3, :3].T @ UP).tolist())  # what an accelerometer at rest says: up, taken for down
    turned = apply_metric_scale(known, asked("upright", metric=False, gravity=down))
    assert "contradicts by 180 degrees: check its sign" in (turned.scale.frame.source or "")
    assert turned.scale.frame.sigma_deg == pytest.approx(180.0, abs=3.0), "one of them is wrong"
    unconfirmed = replace(known, gaussians=replace(seen, source_frame=np.full(count, -1)))
    assert apply_metric_scale(unconfirmed, asked("upright", metric=False)).verdict.code is Code.FRAME_UNKNOWN


def test_a_camera_that_looks_straight_down_has_an_upright_frame():
    down = np.eye(4)
    down[:3, :3] = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]  # its z is the world's -z, its upper edge y
    T = make_upright_frame(down, UP) @ down
    np.testing.assert_allclose(T[:3, 2], [0.0, 0.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(T[:3, 1], [-1.0, 0.0, 0.0], atol=1e-12)  # its upper edge is ahead


def test_the_world_of_given_poses_is_the_odometrys_and_can_be_left():
    poses = Evidence(poses=dict(zip(NAMES, TRUE, strict=True)), mounts=mounts(), gravities=gravities())
    kept, same = (apply_metric_scale(scene(), asked(frame, False), poses) for frame in (None, "odometry"))
    for moved in (kept, same):
        assert moved.scale.frame.name is FrameName.ODOMETRY and "poses of 8" in (moved.scale.frame.source or "")
        np.testing.assert_allclose(moved.cameras[3].T_world_camera, TRUE[3], atol=1e-6)
        np.testing.assert_allclose(moved.scale.frame.matrix, TRUE[0], atol=1e-6)
    first = apply_metric_scale(scene(), asked("first_camera", False), poses)
    np.testing.assert_allclose(first.cameras[0].T_world_camera, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(first.cameras[3].given.T_world_camera, first.cameras[3].T_world_camera, atol=1e-6)
    base = apply_metric_scale(scene(), asked("base", False), poses)
    np.testing.assert_allclose(base.cameras[0].T_world_camera, AHEAD, atol=1e-12)
    for moved in (first, base, apply_metric_scale(scene(), asked("upright", False), poses)):
        assert_same_scene(moved)
        assert moved.up is not None
        up_in_camera = moved.cameras[2].T_world_camera[:3, :3].T @ moved.up.direction
        np.testing.assert_allclose(up_in_camera, TRUE[2][:3, :3].T @ UP, atol=1e-3)


def test_motions_have_the_frame_in_which_they_began():
    motion, motions = Motion(NAMES[0]), {NAMES[0]: Motion(NAMES[0])}
    for before, after, name in zip(TRUE[:-1], TRUE[1:], NAMES[1:], strict=True):
        motion = motions[name] = motion.append_step(np.linalg.inv(before) @ after, 0.005, 0.5)
    by_wheels = apply_metric_scale(scene(), asked("odometry"), Evidence(motions=motions))
    np.testing.assert_allclose(by_wheels.cameras[0].T_world_camera, np.eye(4), atol=1e-4)
    on_base = apply_metric_scale(scene(), asked("odometry"), Evidence(motions=motions, mounts=mounts()))
    np.testing.assert_allclose(on_base.cameras[0].T_world_camera, AHEAD, atol=1e-4)
    assert on_base.scale.frame.source == "motions of 8 images since they began"
    assert_same_scene(on_base)


REFUSALS = [
    ("base", asked("base", metric=False), Evidence(mounts=mounts()), "has no metres, in which T_base_camera is"),
    ("base", asked("base"), Evidence(mounts={NAMES[1]: AHEAD}), f"nobody tells where the camera of .*{NAMES[0]}"),
    ("base", asked("base"), NOTHING, "no image tells where its camera stands"),
    ("odometry", asked("odometry"), NOTHING, "no image has a pose or a motion"),
    ("odometry", asked("odometry", False), Evidence(poses={NAMES[0]: TRUE[0]}), "do not tell it: poses were given"),
    ("upright", asked("upright"), NOTHING, "no image has gravity, and no floor was found"),
    (
        "upright",
        asked("upright"),
        Evidence(gravities={name: Gravity((float(np.cos(i)), float(np.sin(i)), i - 3.5), 1.0)
                            for i, name in enumerate(NAMES)}),
        "no image has gravity",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("frame", "config", "evidence", "said"), REFUSALS)
def test_a_frame_that_is_not_known_is_refused_with_what_is_missing(tmp_path, frame, config, evidence, said):
    refused = apply_metric_scale(scene(), config, evidence)
    verdict = refused.verdict
    assert verdict.code is Code.FRAME_UNKNOWN and not verdict.publishable and verdict.advice
    assert f"frame of reference {frame} was asked for" in verdict.message
    assert re.search(said, verdict.message), verdict.message
    assert refused.cameras == () and len(refused.gaussians) == 0
    write_result(refused, tmp_path, build_report(refused, seed=0, preset="fast", peak_rss_mb=None))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["manifest.json", "report.json"]
    assert json.loads((tmp_path / "report.json").read_text())["verdict"]["code"] == "FRAME_UNKNOWN"


def test_what_is_missing_from_the_beginning_is_told_before_the_work():
    for frame, said in (("base", "T_base_camera"), ("odom", "--poses FILE")):
        with pytest.raises(UnknownFrame, match=said) as refused:
            check_frame(asked(frame), NOTHING)
        assert exit_code(refused.value) == 2, "what was asked for does not go with what was given"
    check_frame(asked("upright"), NOTHING)  # a floor may be found
    check_frame(asked("base"), Evidence(mounts=mounts()))
    check_frame(asked(None), NOTHING)
    bare = msgspec.structs.replace(asked("base"), baseline=None)
    with pytest.raises(UnknownFrame, match="nothing that was given tells metres"):
        check_frame(bare, Evidence(mounts=mounts()))
    check_frame(bare, Evidence(mounts=mounts()), has_lengths=True)
    check_frame(msgspec.structs.replace(bare, marker_size_m=0.1), Evidence(mounts=mounts()))


def test_a_refused_snapshot_keeps_its_reason():
    refused = replace(scene(), cameras=(), verdict=replace(scene().verdict, code=Code.NO_OVERLAP, publishable=False))
    assert apply_metric_scale(refused, asked("base"), NOTHING).verdict.code is Code.NO_OVERLAP


def test_a_mount_that_is_rounded_shears_nothing():
    rough = AHEAD.copy()
    rough[:3, :3] += np.random.default_rng(0).normal(size=(3, 3)) * 1e-3
    moved = apply_metric_scale(scene(), asked("base"), Evidence(mounts=mounts(rough)))
    rotation = moved.cameras[4].T_world_camera[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("frame", [None, "first_camera", "base", "odometry", "upright"])
def test_every_file_states_unit_and_frame_and_all_agree(tmp_path, frame):
    tracked = {name: make_given_pose(T) for name, T in zip(NAMES, TRUE, strict=True)}
    evidence = Evidence(tracked=tracked if frame == "odometry" else {}, mounts=mounts(), gravities=gravities())
    made = apply_metric_scale(scene(), asked(frame), evidence)
    write_result(made, tmp_path, build_report(made, seed=0, preset="fast", peak_rss_mb=None))
    name, unit = frame or "first_camera", "metres"
    T_first = made.cameras[0].T_world_camera
    for path in ("cameras.json", "report.json", "manifest.json", "transforms.json"):
        told = json.loads((tmp_path / path).read_text())
        told = told["splatnode"] if path == "transforms.json" else told
        assert (told["frame"], told["unit"]) == (name, unit), path
        if frame is not None:
            np.testing.assert_allclose(told["T_frame_first_camera"], T_first, atol=1e-12)
    for path in ("trajectory.tum", "colmap/images.txt", "colmap/cameras.txt", "colmap/points3D.txt"):
        comments = [row for row in (tmp_path / path).read_text().splitlines() if row.startswith("#")]
        assert f"# unit: {unit}" in comments and any(row.startswith(f"# frame: {name},") for row in comments), path
    assert f"unit {unit}, frame {name}\n".encode() in (tmp_path / "scene.ply").read_bytes()
    row = next(row for row in (tmp_path / "trajectory.tum").read_text().splitlines() if not row.startswith("#"))
    np.testing.assert_allclose([float(each) for each in row.split()[1:4]], T_first[:3, 3], atol=1e-12)
    told = json.loads((tmp_path / "transforms.json").read_text())["frames"][0]["transform_matrix"]
    np.testing.assert_allclose(np.array(told) @ np.diag([1, -1, -1, 1]), T_first, atol=1e-12)
    images = [row for row in (tmp_path / "colmap/images.txt").read_text().splitlines() if not row.startswith("#")]
    w, x, y, z, *shift = (float(each) for each in images[0].split()[1:8])
    R = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(-R.T @ shift, T_first[:3, 3], atol=1e-9)
    again = read_result(tmp_path)[0]
    assert (
        again.scale.frame == made.scale.frame and parse_scale(make_scale_record(made.scale)).frame == made.scale.frame
    )


def test_binary_models_of_colmap_have_the_unit_beside_them(tmp_path):
    spaced = replace(scene(), cameras=tuple(replace(each, name=f"a {each.name}") for each in scene().cameras))
    write_result(spaced, tmp_path, {})
    assert (tmp_path / "colmap/unit.txt").read_text().splitlines()[1] == "# unit: relative"


def test_a_frame_that_a_stranger_wrote_is_no_mirror():
    data = json.dumps({"cameras": [], "frame": "base", "T_frame_first_camera": np.diag([1, 1, -1, 1]).tolist()})
    with pytest.raises(SceneFileError, match="rigid motion"):
        decode_scale(data.encode())
    with pytest.raises(SceneFileError, match="printable"):
        decode_scale(json.dumps({"cameras": [], "frame_source": "\x1b[2J"}).encode())
    assert decode_scale(b'{"cameras": []}').frame == ReferenceFrame() and decode_cameras(b'{"cameras": []}') == ()


def test_a_message_leaves_out_the_first_cameras_frame():

    assert b"frame" not in msgspec.json.encode(make_scale_record(Scale(True, "a marker")))
    frame = ReferenceFrame(FrameName.BASE, "T_base_camera of a", None, encode_matrix(AHEAD))
    assert parse_scale(make_scale_record(Scale(True, "a marker", None, frame))).frame == frame
