from __future__ import annotations

import numpy as np
import pytest

import splatnode
from splatnode.api.photographs import make_frame as frame_of
from splatnode.api.reconstruct import poses_given, sigmas_of
from splatnode.capture.cameras import synthetic
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
