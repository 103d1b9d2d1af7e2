"""A folder with a file of poses: each photograph carries its own, through the keyframe's message."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from splatnode.capture.cameras import folder
from splatnode.capture.frame import LARGEST_M, DroppedFrame, Frame, GivenPose
from splatnode.capture.image_file import encode_png
from splatnode.capture.messaging.messages import FrameHeader, Numbering, decode, encode_frame

NAMES = ("1341847980.722988.png", "1341847981.000000.png", "1341847982.500000.png")


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    there = tmp_path / "photographs"
    there.mkdir()
    for number, name in enumerate(NAMES):
        (there / name).write_bytes(encode_png(np.full((24, 32, 3), 60 * number, np.uint8)))
    return there


def streamed(photographs: Path, file: Path, **sigmas: float) -> list[Frame | DroppedFrame]:
    return list(folder.stream(folder.Config(photographs, poses=folder.Poses(file, **sigmas))))


def poses(frames: list[Frame | DroppedFrame]) -> list[GivenPose | None]:
    return [frame.given_pose for frame in frames if isinstance(frame, Frame)]


def test_a_trajectory_by_time_gives_each_photograph_its_pose_or_none(photographs, tmp_path):
    file = tmp_path / "odometry.tum"
    file.write_text("1341847980.722988 1 2 3 0 0 0 1\n1341847980.9 2 2 3 0 0 0 1\n1341847981.1 4 2 3 0 0 0 1\n")
    first, second, third = poses(streamed(photographs, file, sigma_m=0.05, sigma_deg=1.0))
    assert first is not None and second is not None and third is None
    assert np.allclose(first.matrix[:3, 3], (1, 2, 3)) and (first.sigma_m, first.sigma_deg) == (0.05, 1.0)
    assert np.allclose(second.matrix[:3, 3], (3, 2, 3))  # midway


def test_poses_by_name_go_with_the_keyframes(photographs, tmp_path):
    (tmp_path / "images.txt").write_text(f"1 1 0 0 0 -1 -2 -3 1 {NAMES[1]}\n\n")
    frames = streamed(photographs, tmp_path)
    first, second, third = poses(frames)
    assert first is None and third is None and second is not None
    keyframe = frames[1]
    assert isinstance(keyframe, Frame)
    assert decode(encode_frame(keyframe, Numbering()), FrameHeader).header.given_pose == second
    assert np.allclose(second.matrix[:3, 3], (1, 2, 3)) and second.sigma_m == 0.01


def test_each_time_that_a_folder_is_shown_the_poses_go_with_it(photographs, tmp_path):
    file = tmp_path / "odometry.tum"
    file.write_text(f"{NAMES[0]} 1 2 3 0 0 0 1\n")
    frames = list(folder.stream(folder.Config(photographs, poses=folder.Poses(file), loops=2)))
    assert [pose is not None for pose in poses(frames)] == [True, False, False] * 2


def test_poses_of_other_photographs_are_refused(photographs, tmp_path):
    file = tmp_path / "odometry.tum"
    file.write_text("kitchen.png 1 2 3 0 0 0 1\n")
    with pytest.raises(
        ValueError, match=r"photographs such as kitchen\.png, and none of those here, such as 1341847980"
    ):
        streamed(photographs, file)


def test_a_pose_that_is_too_far_away_leaves_its_photograph_out(photographs, tmp_path):
    file = tmp_path / "odometry.tum"
    file.write_text(f"{NAMES[0]} {2 * LARGEST_M} 2 3 0 0 0 1\n")
    dropped, *others = streamed(photographs, file)
    assert isinstance(dropped, DroppedFrame) and "its pose cannot be used" in dropped.reason
    assert all(isinstance(frame, Frame) for frame in others)


def test_sigmas_have_bounds():
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"file": "a.tum", "sigma_m": 0.0}, folder.Poses)
