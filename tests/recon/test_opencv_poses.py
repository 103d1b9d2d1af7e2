"""What serves where PoseLib is not installed, against poses that are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from splatnode.recon import poselib

Array = npt.NDArray[np.float64]
COUNT = 300


@dataclass(frozen=True, eq=False)
class View:
    """Two cameras that see points in a box, with .4 pixels of noise and a fifth of the matches wrong."""

    focal: float
    points: Array  # (M, 3) in the first camera's frame
    pixels1: Array  # (M, 2) relative to the principal point
    pixels2: Array
    wrong: npt.NDArray[np.bool_]  # (M,)
    rotation: Array
    translation: Array

    @property
    def camera(self) -> dict[str, object]:
        return {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [self.focal, 0, 0]}


def two_views(seed: int) -> View:
    rng = np.random.default_rng(seed)
    focal = 400.0 * (1 + 0.3 * seed)
    points = rng.uniform([-2, -2, 3], [2, 2, 8], (COUNT, 3))
    rotation = Rotation.from_rotvec(rng.normal(0, 0.15, 3)).as_matrix()
    translation = np.array([0.6, 0.1, 0.3]) + rng.normal(0, 0.1, 3)
    moved = points @ rotation.T + translation
    pixels1, pixels2 = (focal * each[:, :2] / each[:, 2:] + rng.normal(0, 0.4, (COUNT, 2)) for each in (points, moved))
    wrong = rng.random(COUNT) < 0.2
    pixels2[wrong] = rng.uniform(-0.6 * focal, 0.6 * focal, (int(wrong.sum()), 2))
    return View(focal, points, pixels1, pixels2, wrong, rotation, translation)


def degrees(rotation: Array, other: Array) -> float:
    return float(np.rad2deg(Rotation.from_matrix(rotation @ other.T).magnitude()))


@pytest.mark.parametrize("seed", range(5))
def test_absolute_pose(seed):
    view = two_views(seed)
    options = {"max_reproj_error": 2.5, "seed": 0}
    pose, found = poselib.estimate_opencv_absolute_pose(view.pixels2, view.points, view.camera, options)
    assert degrees(pose.R, view.rotation) < 0.1 and np.linalg.norm(pose.t - view.translation) < 0.01
    assert pose.Rt.shape == (3, 4)
    inliers = np.array(found["inliers"])
    assert inliers[~view.wrong].mean() > 0.98 and inliers[view.wrong].mean() < 0.05


@pytest.mark.parametrize("seed", range(5))
def test_relative_pose(seed):
    view = two_views(seed)
    options = {"max_epipolar_error": 1.5, "seed": 0}
    pose, found = poselib.estimate_opencv_relative_pose(view.pixels1, view.pixels2, view.camera, view.camera, options)
    cosine = pose.t @ view.translation / np.linalg.norm(view.translation)
    assert degrees(pose.R, view.rotation) < 0.5 and np.rad2deg(np.arccos(cosine)) < 2
    assert np.array(found["inliers"])[~view.wrong].mean() > 0.95


@pytest.mark.parametrize("seed", range(5))
def test_shared_focal_length(seed):
    view = two_views(seed)
    pixels1, pixels2 = view.pixels1[~view.wrong], view.pixels2[~view.wrong]
    options = {"max_epipolar_error": 1.5, "seed": 0}
    pair, _ = poselib.estimate_opencv_shared_focal_relative_pose(pixels1, pixels2, np.zeros(2), options)
    assert pair.camera1.focal() == pytest.approx(view.focal, rel=0.05)
    again, _ = poselib.estimate_opencv_shared_focal_relative_pose(pixels1, pixels2, np.zeros(2), options)
    assert again.camera1.focal() == pair.camera1.focal()


def test_too_few_matches_give_no_inliers():
    view, options = two_views(0), {"max_epipolar_error": 1.5, "max_reproj_error": 2.5}
    few = slice(0, 3)
    _, absolute = poselib.estimate_opencv_absolute_pose(view.pixels2[few], view.points[few], view.camera, options)
    _, relative = poselib.estimate_opencv_relative_pose(
        view.pixels1[few], view.pixels2[few], view.camera, view.camera, options
    )
    assert not any(absolute["inliers"]) and not any(relative["inliers"])
