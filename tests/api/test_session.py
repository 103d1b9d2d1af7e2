"""A session: photographs that come one at a time, and the scene that is made of them in the end."""

from __future__ import annotations

import itertools

import cv2
import msgspec
import numpy as np
import pytest

import splatnode
from splatnode.capture.cameras import synthetic
from splatnode.capture.diorama import Config as Odometry
from splatnode.capture.diorama import odometry
from tests.api.conftest import QUICK, SMALL
from tests.support.synthetic import errors


@pytest.fixture(scope="module")
def walked(arrays) -> tuple[list[splatnode.Update], splatnode.Result]:
    with splatnode.Session(config=QUICK, seed=0) as session:
        updates = [session.add(image) for image in [arrays[0], arrays[0], *arrays[1:]]]
        return updates, session.finish()


def test_each_photograph_is_told_of_and_the_scene_grows(walked):
    updates, _ = walked
    assert [update.name for update in updates] == [f"{index:04d}.png" for index in range(5)]
    assert [update.taken for update in updates] == [True, False, True, True, True]
    assert "adds too little" in updates[1].reason and updates[2].reason
    assert updates[0].result.verdict.code.value == "TOO_FEW_VIEWS" and updates[-1].result.verdict.publishable
    assert len(updates[-1].result.cameras) == 4 > len(updates[2].result.cameras)
    assert not updates[-1].result.final and len(updates[-1].result.gaussians["means"])


def test_what_an_update_told_stays_as_it_was(walked):
    updates, _ = walked
    assert [len(update.result.cameras) for update in updates] == sorted(len(u.result.cameras) for u in updates)


def test_the_end_is_as_good_as_a_reconstruction_of_all(walked, result, tmp_path):
    _, finished = walked
    assert finished.final and finished.verdict == result.verdict and len(finished.cameras) == len(result.cameras)
    assert len(finished.gaussians["means"]) == pytest.approx(len(result.gaussians["means"]), rel=0.1)
    found = [camera.centre for camera in finished.cameras]
    assert np.allclose(found, [camera.centre for camera in result.cameras], atol=0.02)
    names = sorted(path.name for path in (finished.save(tmp_path / "out") / "images").iterdir())
    assert names == ["0000.png", "0002.png", "0003.png", "0004.png"]


def test_before_the_first_photograph_it_says_so_and_can_be_finished():
    session = splatnode.Session()
    assert session.result.verdict.code.value == "TOO_FEW_VIEWS"
    assert not session.finish().verdict.publishable


def test_a_dark_photograph_does_not_count(arrays):
    with splatnode.Session(config=QUICK) as session:
        update = session.add(np.zeros_like(arrays[0]), name="dark.png")
        assert not update.taken and update.reason and not update.result.verdict.publishable
        assert session.add(arrays[0]).taken  # at once


def test_a_session_that_is_closed_says_so_and_keeps_its_last_result(arrays):
    with splatnode.Session(config=QUICK, threads=1, intrinsics=splatnode.Intrinsics(
        320, 240, 300, 300, 160, 120, "given"
    )) as session:  # fmt: skip
        session.add(arrays[0], name="a.png")
        with pytest.raises(ValueError, match="name must be new for each photograph; 'a.png' was given before"):
            session.add(arrays[1], name="a.png")
        session.add(arrays[1], name="b.png")
        with pytest.raises(TypeError, match="must be uint8, got float64"):
            session.add(arrays[1] / 255)
    assert session.result.cameras[0].lens is not None and len(session.result.cameras) == 2
    for ask in (session.finish, lambda: session.add(arrays[2])):
        with pytest.raises(RuntimeError, match="the session is closed: begin another one"):
            ask()


def test_a_lens_that_fits_no_photograph_is_told_with_the_first(arrays):
    square = splatnode.Intrinsics(100, 100, 90, 90, 50, 50, "given")
    with splatnode.Session(config=QUICK, intrinsics=square) as session:
        with pytest.raises(ValueError, match="got those of 100 x 100 for 320 x 240"):
            session.add(arrays[0])
        assert session.add(arrays[0][:, :240]).taken
        session.add(arrays[1])  # of another lens


def test_a_matrix_is_of_photographs_of_the_size_of_the_first_one(arrays):
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    with splatnode.Session(config=QUICK, intrinsics=K) as session:
        session.add(arrays[0], name="a.png")
        session.add(np.ascontiguousarray(arrays[1][::2, ::2]), name="b.png")
        lens = session._frames["b.png"].intrinsics
    assert lens is not None and lens.fx == 150 and lens.width == 160


def test_all_that_are_sharp_can_be_asked_for(arrays):
    with splatnode.Session(config=QUICK, every_frame=True, scale=(0, 1, 2.0)) as session:
        shifted = np.roll(arrays[0], 3, axis=1)
        assert session.add(arrays[0]).taken
        assert "every frame" in session.add(shifted).reason or "duplicate" in session.add(shifted).reason
        last = session.add(arrays[1])
        assert last.taken


def test_its_cameras_are_right(walked):
    updates, finished = walked
    taken = [index for index, update in enumerate(updates) if update.taken]
    numbers = {updates[index].name: position for position, index in enumerate(taken)}
    from dataclasses import replace

    snapshot = finished._snapshot
    cameras = tuple(replace(camera, frame_id=numbers[camera.name]) for camera in snapshot.cameras)
    assert errors(replace(snapshot, cameras=cameras), SMALL).rotation_deg < 1.0


def test_poses_give_a_session_metres_and_their_axes(arrays):
    true = [T for T, _ in synthetic.scene_cameras(SMALL)]
    with splatnode.Session(config=QUICK, seed=0) as session:
        for image, T in zip(arrays[:2], true, strict=False):
            update = session.add(image, pose=T, pose_sigma=(0.02, 1.0))
        result = update.result
    assert result.metric and result.scale_interval is not None
    low, high = result.scale_interval
    first, last = result.cameras
    apart = np.linalg.norm(true[1][:3, 3] - true[0][:3, 3]) / np.linalg.norm(last.centre - first.centre)
    assert low <= apart <= high < 1.2
    assert np.linalg.norm(first.centre - true[0][:3, 3]) < 0.1


@pytest.mark.parametrize("only_checked", [False, True])
def test_poses_with_sigmas_hold_the_cameras_of_a_session(arrays, only_checked):
    true = synthetic.scene_cameras(SMALL)
    chosen = {"intrinsics": true[0][1], "check_poses": only_checked, "seed": 0}
    with splatnode.Session(config=QUICK, **chosen) as session:
        for image, (T, _) in zip(arrays[:2], true, strict=False):
            result = session.add(image, pose=T, pose_sigma=(0.002, 0.1)).result
    assert result.metric and ("by given poses" in result.verdict.message) is not only_checked
    if not only_checked:
        for camera, (T, _) in zip(result.cameras, true, strict=False):
            assert np.linalg.norm(camera.centre - T[:3, 3]) < 0.006


def test_former_names_of_arguments_are_read_and_told():
    with pytest.warns(DeprecationWarning, match="poses_only_check is called check_poses now") as heard:
        session = splatnode.Session(poses_only_check=True)
    assert session._only_checks and heard[0].filename == __file__
    with pytest.raises(TypeError, match="check_poses is given twice, once as poses_only_check"):
        splatnode.Session(poses_only_check=False, check_poses=True)
    with pytest.raises(TypeError, match="multi_view_only is given twice, once as only_seen"):
        splatnode.reconstruct([], only_seen=True, multi_view_only=True)


def test_what_is_no_pose_is_said_and_the_photograph_can_come_again(arrays):
    with splatnode.Session(config=QUICK) as session:
        for bad, kind, why in (
            ({"pose": np.eye(3)}, TypeError, r"a pose must be T_world_camera \(4, 4\) or None, got shape \(3, 3\)"),
            ({"pose": np.diag([1.0, 1, -1, 1])}, ValueError, "a given pose must be a rigid motion"),
            ({"pose": np.eye(4), "pose_sigma": 0.1}, TypeError, "pose_sigma must be metres and degrees"),
            ({"pose": np.eye(4), "pose_sigma": (0.0, 1.0)}, ValueError, "sigmas of a given pose must be 1e-09 or more"),
            ({"pose_sigma": (0.1, 1.0)}, ValueError, "give pose, too"),
        ):
            with pytest.raises(kind, match=why):
                session.add(arrays[0], name="a.png", **bad)
        assert session.add(arrays[0], name="a.png", pose=np.eye(4)).taken


def test_stereo_pairs_give_a_session_metres():
    true = [T for T, _ in synthetic.scene_cameras(SMALL)]
    frames = itertools.islice(synthetic.stream(msgspec.structs.replace(SMALL, baseline_m=0.15)), 2)
    with splatnode.Session(config=QUICK, seed=0) as session:
        for each in frames:
            update = session.add(each.image, right=each.right.image, baseline_m=0.15)
        result = session.finish()
    assert update.taken and result.metric and result.scale_interval is not None
    low, high = result.scale_interval
    first, last = result.cameras
    apart = np.linalg.norm(true[1][:3, 3] - true[0][:3, 3]) / np.linalg.norm(last.centre - first.centre)
    assert low <= apart <= high < 1.05


def test_what_is_no_right_image_is_said(arrays):
    with splatnode.Session(config=QUICK) as session:
        for bad, kind, why in (
            ({"right": arrays[0]}, TypeError, "right and baseline_m belong together"),
            ({"baseline_m": 0.1}, TypeError, "right and baseline_m belong together"),
            ({"right": arrays[0], "baseline_m": -1.0}, ValueError, "a baseline must be above 0"),
            (
                {"right": arrays[0][:50, :60], "baseline_m": 0.1},
                ValueError,
                r"the right image must be .*got \(50, 60\)",
            ),
        ):
            with pytest.raises(kind, match=why):
                session.add(arrays[0], name="a.png", **bad)
        assert session.add(arrays[0], name="a.png").taken


def test_motions_and_gravity_of_photographs_give_metres_and_up(arrays):
    true = [T for T, _ in synthetic.scene_cameras(SMALL)]
    measured = odometry([str(index) for index in range(len(true))], true, Odometry(), 7)
    with splatnode.Session(config=QUICK, seed=0) as session:
        for index, (image, (moved, gravity)) in enumerate(zip(arrays, measured, strict=True)):
            more = {}
            if index:
                step = np.linalg.inv(measured[index - 1][0].matrix) @ moved.matrix
                more = {"motion": step, "motion_sigma": (0.02, 2.0)}
            session.add(image, gravity=gravity.down, **more)
        result = session.finish()
    assert result.metric and result.scale_interval is not None
    first, last = result.cameras[0], result.cameras[-1]
    apart = np.linalg.norm(true[-1][:3, 3] - true[0][:3, 3]) / np.linalg.norm(last.centre - first.centre)
    assert abs(apart - 1) < 0.02 and result.scale_interval[0] <= apart <= result.scale_interval[1]
    made = result.map()
    true_up = first.T_world_camera[:3, :3] @ true[0][:3, :3].T @ [0.0, 0.0, 1.0]
    assert made.upright.source == "gravity in 4 photographs" and made.T_world_map[:3, 2] @ true_up > np.cos(
        np.radians(4)
    )


def test_motions_and_gravity_that_are_none_are_said(arrays):
    step = np.eye(4)
    with splatnode.Session(config=QUICK) as session:
        for bad, kind, why in (
            ({"motion": step}, ValueError, "the first one has none"),
            ({"motion_sigma": (0.1, 1.0)}, ValueError, "give motion, too"),
            ({"gravity": [0.0, 0, 0]}, ValueError, "gravity must be a direction"),
            ({"gravity": np.eye(3)}, TypeError, r"a direction \(3,\) in the camera's frame, got shape \(3, 3\)"),
            ({"gravity_sigma": 2.0}, ValueError, "give gravity, too"),
        ):
            with pytest.raises(kind, match=why):
                session.add(arrays[0], name="a.png", **bad)
        assert session.add(arrays[0], name="a.png").taken
        for bad, kind, why in (
            ({"motion": np.eye(3)}, TypeError, r"got shape \(3, 3\)"),
            ({"motion": 2 * step}, ValueError, "T_previous_current must be a rigid motion"),
            ({"motion": step, "motion_sigma": (0.0, 1.0)}, ValueError, "the sigmas of a step must be above 0"),
        ):
            with pytest.raises(kind, match=why):
                session.add(arrays[1], name="b.png", **bad)


def test_a_limit_on_the_seconds_is_refused():
    with pytest.raises(ValueError, match="a session has no budget_s"):
        splatnode.Session(config={"budget_s": 30})


def test_an_image_that_zooms_in_the_middle_of_a_session_gets_a_lens_of_its_own(arrays):
    """Provisionally when it comes, and in the end."""
    height, width = arrays[0].shape[:2]
    across, down = round(width / 1.3), round(height / 1.3)
    left, top = (width - across) // 2, (height - down) // 2
    zoomed = cv2.resize(
        arrays[3][top : top + down, left : left + across], (width, height), interpolation=cv2.INTER_CUBIC
    )
    with splatnode.Session(config=QUICK, seed=0, every_frame=True) as session:
        images = [*arrays[:3], zoomed]
        results = [session.add(image).result for image in images]
        finished = session.finish()
    for result in (results[-1], finished):
        assert len(result.cameras) == 4
        *others, own = (float(camera.K[0, 0]) for camera in result.cameras)
        assert own == pytest.approx(1.3 * np.median(others), rel=0.05)


def test_a_photograph_may_have_its_own_lens_and_camera(arrays):
    K, wide = (
        np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]),
        splatnode.Intrinsics(320, 240, 200, 200, 160, 120, "given"),
    )
    with splatnode.Session(config=QUICK, intrinsics=K) as session:
        session.add(arrays[0], name="a.png")
        session.add(arrays[1], name="b.png", intrinsics=wide, camera="gripper")
        with pytest.raises(ValueError, match="got those of 100 x 100 for 320 x 240"):
            session.add(arrays[2], intrinsics=splatnode.Intrinsics(100, 100, 90, 90, 50, 50, "given"))
        with pytest.raises(ValueError, match="camera must be at most 255 printable letters"):
            session.add(arrays[2], camera="a\n")
        frames = [session._frames[name] for name in ("a.png", "b.png")]
    assert [(each.intrinsics.fx, each.camera_id) for each in frames] == [(300, ""), (200, "gripper")]
