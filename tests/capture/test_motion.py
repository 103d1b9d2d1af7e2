"""Motions and gravity: what they may be, how steps add up, and that messages, recordings and files keep them."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import Frame, Gravity, Motion, rename_frame
from splatnode.capture.messaging.messages import FrameHeader, Numbering, WireError, decode, encode, encode_frame
from splatnode.capture.recording import INDEX, Recorder, read
from splatnode.recon.daemon.ledger import file_name, read_frame, write_frame

STEP = np.eye(4)
STEP[:3, :3], STEP[:3, 3] = Rotation.from_rotvec([0.0, 0.3, 0.0]).as_matrix(), [0.1, 0.0, 0.5]
MOTION = Motion("a.png").append_step(STEP, 0.03, 3.0).append_step(STEP, 0.04, 4.0)
GRAVITY = Gravity((0.0, 9.81, 0.2), 1.5)


def frame(motion=MOTION, gravity=GRAVITY) -> Frame:
    return Frame(0, "a.png", 0, np.zeros((6, 8, 3), np.uint8), None, motion=motion, gravity=gravity)


def test_steps_add_up_and_what_they_are_unsure_by_squares():
    np.testing.assert_allclose(MOTION.matrix, STEP @ STEP, atol=1e-12)
    assert (MOTION.sigma_m, MOTION.sigma_deg) == pytest.approx((0.05, 5.0)) and MOTION.chain == "a.png"
    long = Motion("long")
    bent = STEP.copy()
    bent[:3, :3] *= 1.001  # not quite a rotation, as a sender may round it
    for _ in range(2000):
        long = long.append_step(bent, 0.01, 1.0)
    np.testing.assert_allclose(long.matrix[:3, :3] @ long.matrix[:3, :3].T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(GRAVITY.direction @ GRAVITY.direction, 1.0)
    assert rename_frame(frame(), 3, "b.png", 7).motion == MOTION  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: Motion(""), "must have a printable name"),
        (lambda: Motion("\x1b[2J"), "must have a printable name"),
        (lambda: replace(MOTION, sigma_m=-1.0), "sigmas of a motion must be 0 or more"),
        (lambda: replace(MOTION, sigma_deg=float("nan")), "sigmas of a motion must be 0 or more"),
        (lambda: replace(MOTION, T_start_current=(1.0,) * 16), "a motion must be a rigid motion"),
        (lambda: MOTION.append_step(STEP[:3], 0.1, 1.0), r"\(4, 4\), got \(3, 4\)"),
        (lambda: MOTION.append_step(STEP, 0.0, 1.0), "sigmas of a step must be above 0"),
        (lambda: Gravity((0.0, 0.0, 0.0)), "not zero"),
        (lambda: Gravity((float("nan"), 0.0, 1.0)), "a direction of three numbers"),
        (lambda: Gravity((0.0, 0.0, 1.0), 0.0), "sigma of gravity must be 1e-09 or more"),
    ],
)
def test_what_is_none_is_refused(made, said):
    with pytest.raises(ValueError, match=said):
        made()


def test_a_message_without_them_is_that_of_a_splatnode_that_knows_none():
    none, both = frame(None, None), frame()
    without, having = (msgspec.msgpack.decode(encode_frame(each, Numbering("0" * 32))[1]) for each in (none, both))
    assert set(having[0]) - set(without[0]) == {"motion", "gravity"}
    header = decode(encode_frame(both, Numbering()), FrameHeader).header
    assert (header.motion, header.gravity) == (MOTION, GRAVITY)
    fields = msgspec.to_builtins(header) | {"gravity": {"down": [0.0, 0.0, 0.0], "sigma_deg": 1.0}}
    with pytest.raises(WireError, match="not zero"):
        decode(encode(fields, [both.image]), FrameHeader)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("motion", "gravity"), [(None, None), (MOTION, None), (None, GRAVITY), (MOTION, GRAVITY)])
def test_recordings_and_checkpoints_keep_them(tmp_path, motion, gravity):
    with Recorder(tmp_path / "recorded") as recorder:
        recorder.write(frame(motion, gravity))
    (seen,) = read(tmp_path / "recorded").frames()
    assert isinstance(seen, Frame) and (seen.motion, seen.gravity) == (motion, gravity)
    assert ("motion" in (tmp_path / "recorded" / INDEX).read_text()) == (motion is not None)
    path = tmp_path / file_name(3)
    write_frame(path, ("0" * 32, 0), frame(motion, gravity))
    stored = read_frame(path).frame
    assert (stored.motion, stored.gravity) == (motion, gravity)
