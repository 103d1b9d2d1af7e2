from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import splatnode
from splatnode.api.photographs import make_frame as frame_of
from splatnode.api.reconstruct import own_sigmas_of, poses_given, sigmas_of
from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame
from splatnode.recon.replay_source import Source, add_poses
from tests.api.conftest import QUICK, SMALL
from tests.support.synthetic import photographs

TRUE = [T for T, _ in synthetic.scene_cameras(SMALL)]


def test_poses_give_a_result_metres_and_their_world(folder):
    names = sorted(path.name for path in folder.iterdir())
    wrong = TRUE[2].copy()
    wrong[:3, 3] += [0.0, 0.0, 1.0]
    given = {name: wrong if index == 2 else T for index, (name, T) in enumerate(zip(names, TRUE, strict=True))}
    result = splatnode.reconstruct(folder, poses=given, poses_sigma=(0.02, 2.0), config=QUICK)
    assert result.scale_interval is not None
    assert f"the pose of {names[2]} was left out" in result._snapshot.scale.sentence
    for camera in result.cameras:
        true = TRUE[names.index(camera.name)]
        assert np.linalg.norm(camera.T_world_camera[:3, 3] - true[:3, 3]) < 0.1
        np.testing.assert_allclose(camera.T_world_camera[:3, :3], true[:3, :3], atol=0.03)


def test_poses_may_be_in_the_order_of_a_list(arrays):
    frames = photographs(SMALL)
    with pytest.raises(TypeError, match="metres and degrees"):
        sigmas_of((0.1,))  # type: ignore[arg-type]
    renamed = [frame_of(frame.image, i, f"{i:04d}.png", i) for i, frame in enumerate(frames)]
    found = poses_given([None, *TRUE[1:]], arrays, renamed)
    assert found is not None and list(found) == [f"{index:04d}.png" for index in range(1, len(TRUE))]
    for wrong, told in ((TRUE[:2], "one for each of the"), ([np.eye(3)] * len(TRUE), r"\(4, 4\) or None")):
        with pytest.raises((TypeError, ValueError), match=told):
            poses_given(wrong, arrays, renamed)


def test_a_list_of_poses_does_not_go_with_a_folder(folder):
    with pytest.raises(TypeError, match="one for each; of a folder or a video, give names"):
        poses_given(TRUE, folder, photographs(SMALL))


def test_each_pose_may_have_its_own_sigmas(arrays, tmp_path):
    frames = [replace(frame, name=f"{index:04d}.png") for index, frame in enumerate(photographs(SMALL))]
    sigmas = [(0.01, 1.0), None, *([(0.02, 2.0)] * (len(arrays) - 2))]
    assert own_sigmas_of(TRUE, sigmas, arrays, frames)["0000.png"] == (0.01, 1.0)
    assert "0001.png" not in own_sigmas_of(TRUE, sigmas, arrays, frames)
    assert own_sigmas_of(TRUE, {"0003.png": (0.5, 5)}, arrays, frames) == {"0003.png": (0.5, 5.0)}
    assert own_sigmas_of(TRUE, (0.01, 1.0), arrays, frames) == {} == own_sigmas_of(TRUE, None, arrays, frames)
    file = tmp_path / "arm.tum"
    file.write_text("0000.png 0 0 0 0 0 0 1 0.001 0.1\n")
    assert own_sigmas_of(file, None, arrays, frames) == {"0000.png": (0.001, 0.1)}
    with pytest.raises(ValueError, match="one for each of the"):
        own_sigmas_of(TRUE, [(0.01, 1.0)], arrays, frames)


def test_a_pose_whose_sigmas_nobody_tells_is_named():
    source = Source(tuple(photographs(SMALL)), None, None)
    first, second = (frame.name for frame in source.frames[:2])
    told = add_poses(source, {first: TRUE[0], second: TRUE[1]}, (0.01, 1.0), {second: (0.5, 5.0)})
    poses = [frame.given_pose for frame in told.frames[:2] if isinstance(frame, Frame)]
    assert [pose.sigma_m for pose in poses if pose is not None] == [0.01, 0.5]
    with pytest.raises(ValueError, match=f"that of {first} does not: tell it"):
        add_poses(source, {first: TRUE[0], second: TRUE[1]}, None, {second: (0.5, 5.0)})
