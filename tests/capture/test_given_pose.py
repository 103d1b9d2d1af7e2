"""A pose that others estimated: what it may be, and that messages, recordings and files keep it."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from splatnode.capture.frame import LARGEST_M, Frame, GivenPose, make_given_pose, rename_frame
from splatnode.capture.messaging.messages import FrameHeader, Numbering, decode, encode_frame
from splatnode.capture.recording import INDEX, Recorder, read
from splatnode.capture.rig import RigCamera
from splatnode.recon.daemon.ledger import file_name, read_frame, write_frame

MOVED = np.array([[0.0, -1.0, 0.0, 1.5], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
POSE = make_given_pose(MOVED, 0.02, 1.5)


def frame(pose=POSE) -> Frame:
    return Frame(0, "a.png", 0, np.zeros((6, 8, 3), np.uint8), None, given_pose=pose)


def test_a_pose_is_its_matrix_and_how_unsure_it_is():
    assert np.array_equal(POSE.matrix, MOVED) and (POSE.sigma_m, POSE.sigma_deg) == (0.02, 1.5)
    assert rename_frame(frame(), 3, "b.png", 7).given_pose == POSE  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize(
    "T, sigmas, said",
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]), (0.01, 2.0), "rigid motion"),
        (2.0 * MOVED, (0.01, 2.0), "rigid motion"),
        (MOVED[:3], (0.01, 2.0), r"\(4, 4\), got \(3, 4\)"),
        (MOVED * np.nan, (0.01, 2.0), "finite"),
        (MOVED + 2 * LARGEST_M * (np.arange(16).reshape(4, 4) == 3), (0.01, 2.0), "within 1e"),
        (MOVED, (0.0, 2.0), "1e-09 or more"),
        (MOVED, (0.01, 181.0), "180 degrees"),
        (MOVED, (float("inf"), 2.0), "up to 1e"),
    ],
)
def test_what_is_no_pose_is_refused(T, sigmas, said):
    with pytest.raises(ValueError, match=said):
        make_given_pose(T, *sigmas)


def test_a_message_without_a_pose_is_that_of_a_splatnode_that_knows_none():
    """To the byte of its header, which an earlier receiver refuses for a field that it does not know."""
    without, having = (
        msgspec.msgpack.decode(encode_frame(frame(pose), Numbering("0" * 32))[1]) for pose in (None, POSE)
    )
    assert "given_pose" not in without[0]
    assert set(having[0]) == {*without[0], "given_pose"}
    assert decode(encode_frame(frame(), Numbering()), FrameHeader).header.given_pose == POSE


@pytest.mark.parametrize("pose", [None, POSE])
def test_recordings_and_checkpoints_keep_it(tmp_path, pose):
    with Recorder(tmp_path / "recorded") as recorder:
        recorder.write(frame(pose))
    (seen,) = read(tmp_path / "recorded").frames()
    assert isinstance(seen, Frame) and seen.given_pose == pose
    assert ("given_pose" in (tmp_path / "recorded" / INDEX).read_text()) == (pose is not None)
    path = tmp_path / file_name(3)
    write_frame(path, ("0" * 32, 0), frame(pose))
    assert read_frame(path).frame.given_pose == pose


@pytest.mark.parametrize("sigmas", [(1e-320, 1.0), (1.0, 1e-320), (0.0, 1.0)])
def test_sigmas_whose_weights_would_overflow_are_refused(sigmas):
    with pytest.raises(ValueError, match="1e-09 or more"):
        GivenPose(tuple(np.eye(4).ravel().tolist()), *sigmas)
    with pytest.raises(ValueError, match="1e-09 or more"):
        RigCamera("left", None, *sigmas)
