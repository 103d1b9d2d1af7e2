"""The right image of a stereo camera: that messages, recordings, folders and files keep it."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from splatnode.capture.cameras import folder
from splatnode.capture.frame import Baseline, DroppedFrame, Frame, RightImage, rename_frame
from splatnode.capture.image_file import encode_png
from splatnode.capture.messaging.messages import Numbering, encode_frame
from splatnode.capture.recording import Recorder, read
from splatnode.recon.daemon.ledger import file_name, read_frame, write_frame

SEEN = np.random.default_rng(0).integers(0, 256, (6, 8)).astype(np.uint8)
RIGHT = RightImage(SEEN, Baseline(0.075, 0.001))


def frame(right=RIGHT) -> Frame:
    return Frame(0, "a.png", 0, np.zeros((6, 8, 3), np.uint8), None, right=right)


def same(found, right) -> bool:
    if right is None or found is None:
        return found is right
    return found.baseline == right.baseline and np.array_equal(found.image, right.image)


def test_a_frame_of_another_name_keeps_it():
    other = rename_frame(frame(), 3, "b.png", 7)
    assert isinstance(other, Frame) and same(other.right, RIGHT)


def test_a_message_without_one_is_that_of_a_splatnode_that_knows_none():
    without, having = (
        msgspec.msgpack.decode(encode_frame(frame(each), Numbering("0" * 32))[1]) for each in (None, RIGHT)
    )
    assert set(having[0]) == {*without[0], "baseline"} and len(without[1]) == 1 and len(having[1]) == 2


@pytest.mark.parametrize("right", [None, RIGHT])
def test_recordings_and_checkpoints_keep_it(tmp_path, right):
    with Recorder(tmp_path / "recorded") as recorder:
        recorder.write(frame(right))
    (seen,) = read(tmp_path / "recorded").frames()
    assert isinstance(seen, Frame) and same(seen.right, right)
    path = tmp_path / file_name(3)
    write_frame(path, ("0" * 32, 0), frame(right))
    assert same(read_frame(path).frame.right, right)


def test_a_recorded_right_image_that_was_changed_is_told(tmp_path):
    with Recorder(tmp_path / "recorded") as recorder:
        recorder.write(frame())
    (tmp_path / "recorded" / "000000-right.png").write_bytes(encode_png(np.zeros((6, 8, 3), np.uint8)))
    (seen,) = read(tmp_path / "recorded").frames()
    assert seen == DroppedFrame("a.png", "000000-right.png is not the file that was recorded")


def pair_folders(tmp_path, names=("1.png", "2.png"), partners=("1.png",), size=(6, 8)) -> folder.Config:
    for side, held, shape in (("left", names, (6, 8, 3)), ("right", partners, (*size, 3))):
        (tmp_path / side).mkdir()
        for number, name in enumerate(held):
            (tmp_path / side / name).write_bytes(encode_png(np.full(shape, 9 * number + 7, np.uint8)))
    return folder.Config(tmp_path / "left", right=folder.Right(tmp_path / "right", 0.075))


def test_a_folder_gives_its_photographs_the_partners_that_they_have(tmp_path):
    first, second = folder.stream(pair_folders(tmp_path))
    assert isinstance(first, Frame) and isinstance(second, Frame) and second.right is None
    assert same(first.right, RightImage(np.full((6, 8), 7, np.uint8), Baseline(0.075)))


def test_a_partner_of_another_size_leaves_its_photograph_out(tmp_path):
    first, _ = folder.stream(pair_folders(tmp_path, size=(8, 6)))
    assert isinstance(first, DroppedFrame) and "the right image must be (6, 8), got (8, 6)" in first.reason


def test_a_folder_without_partners_says_so(tmp_path):
    with pytest.raises(ValueError, match=r"no right photograph has the name of a left one, such as 1.png"):
        folder.stream(pair_folders(tmp_path, partners=("b.png",)))


def test_a_recording_has_its_right_images_in_it(tmp_path):
    with Recorder(tmp_path / "recorded") as recorder:
        recorder.write(frame())
    with pytest.raises(ValueError, match="leave out right"):
        folder.stream(folder.Config(tmp_path / "recorded", right=folder.Right(tmp_path, 0.075)))


def test_an_impossible_baseline_of_a_configuration_is_refused(tmp_path):
    with pytest.raises(msgspec.ValidationError, match="less than half of it"):
        msgspec.convert({"folder": tmp_path, "baseline_m": 0.1, "baseline_sigma_m": 0.06}, folder.Right)
