"""A recording gives back exactly the frames that were seen."""

from __future__ import annotations

import os
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.capture import recording
from splatnode.capture.cameras import folder
from splatnode.capture.frame import Clock, DroppedFrame, Frame, Intrinsics, Stamp
from splatnode.capture.image_file import encode_png
from splatnode.capture.recording import INDEX, Recorder, RecordingError
from tests.support.crafted import recordings

LENS = Intrinsics(16, 12, 20.5, 20.25, 8.0, 6.1, "calibration", (0.1, -0.02, 0.001, 0.0, 1e-17))
RNG = np.random.default_rng(0)


def frames():
    images = [RNG.integers(0, 256, (12, 16, 3)).astype(np.uint8) for _ in range(4)]
    jpeg = cv2.imencode(".jpg", images[3])[1].tobytes()
    decoded = cv2.cvtColor(cv2.imdecode(np.frombuffer(jpeg, np.uint8), 1), cv2.COLOR_BGR2RGB)
    return [
        Frame(0, "b 1.png", 10**15 + 7, images[0], LENS),
        Frame(1, "ä/2", 10**15 + 33_333_340, images[1], None, captured_at=Stamp(1_714_989_607_250_000_001, Clock.UTC)),
        DroppedFrame("c.jpg", "truncated: the file ends early"),
        Frame(2, "d", 10**15 + 66_666_673, images[2], replace(LENS, source="given")),
        Frame(3, "e", 10**15 + 99_999_999, decoded, None, encoded=jpeg),
    ]


def record(path, items):
    with Recorder(path) as recorder:
        for item in items:
            recorder.write(item)
    return path


def seen(items):
    return [
        (item.frame_id, item.name, item.stamp_ns, item.captured_at, item.intrinsics, item.image.tobytes())
        if isinstance(item, Frame)
        else item
        for item in items
    ]


def test_the_same_frames_come_back(tmp_path):
    sent = frames()
    path = record(tmp_path / "walk", sent)
    assert seen(folder.stream(folder.Config(path))) == seen(sent)
    again = record(tmp_path / "copy", folder.stream(folder.Config(path)))
    assert seen(folder.stream(folder.Config(again))) == seen(sent)
    assert (again / "000003.jpg").read_bytes() == sent[4].encoded


def test_an_earlier_recording_tells_no_time_of_capture(tmp_path):
    path = record(tmp_path / "walk", frames())
    index = (path / INDEX).read_bytes()
    earlier = re.sub(rb',"captured_at":(null|\{[^}]*\})', b"", index)
    assert index.count(b"captured_at") == 4 and b"captured_at" not in earlier
    (path / INDEX).write_bytes(earlier)
    found = [item for item in folder.stream(folder.Config(path)) if isinstance(item, Frame)]
    assert [item.captured_at for item in found] == [None] * 4


def test_a_copy_of_a_folder_of_photographs(shared, tmp_path):
    photographs = folder.Config(shared / "scenes" / "fox" / "images", names=("0001.jpg", "0003.jpg"))
    path = record(tmp_path / "fox", folder.stream(photographs))
    assert seen(folder.stream(folder.Config(path))) == seen(folder.stream(photographs))
    assert (path / "000000.jpg").read_bytes() == (photographs.folder / "0001.jpg").read_bytes()


def test_some_frames_by_name(tmp_path):
    path = record(tmp_path / "walk", frames())
    assert folder.names_in(path) == ["b 1.png", "ä/2", "d", "e"]
    assert [item.name for item in folder.stream(folder.Config(path, names=("b 1", "e")))] == ["b 1.png", "e"]
    with pytest.raises(ValueError, match="no frame named f"):
        list(folder.stream(folder.Config(path, names=("f",))))


def test_what_a_killed_recorder_leaves_is_shorter(tmp_path):
    path = record(tmp_path / "walk", frames())
    index = path / INDEX
    index.write_bytes(index.read_bytes()[:-10])
    assert [item.name for item in folder.stream(folder.Config(path))] == ["b 1.png", "ä/2", "c.jpg", "d"]


def test_a_changed_image_is_told(tmp_path):
    path = record(tmp_path / "walk", frames())
    (path / "000000.png").write_bytes((path / "000001.png").read_bytes())
    (path / "000001.png").unlink()
    changed, gone, *_ = folder.stream(folder.Config(path))
    assert isinstance(changed, DroppedFrame) and "not the file that was recorded" in changed.reason
    assert isinstance(gone, DroppedFrame) and "cannot be read" in gone.reason


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "empty"),
        (b"{}\n", "line 1"),
        (b'{"type":"frame","name":"a","stamp_ns":0,"intrinsics":null,"file":"../a.png","sha256":""}\n', "not a file"),
    ],
)
def test_a_damaged_index_is_named(tmp_path, text, message):
    (tmp_path / INDEX).write_bytes(text)
    with pytest.raises(ValueError, match=message):
        recording.read(tmp_path)


def test_nothing_is_written_over(tmp_path):
    (tmp_path / "photo.jpg").write_bytes(b"")
    with pytest.raises(ValueError, match="not empty"):
        Recorder(tmp_path)


def test_a_camera_that_never_came_leaves_a_folder_to_record_into(tmp_path):
    sent = frames()
    record(tmp_path, [])
    assert seen(folder.stream(folder.Config(record(tmp_path, sent)))) == seen(sent)


def test_a_full_disk_leaves_what_was_recorded(tmp_path, monkeypatch):
    first, second = frames()[:2]
    with Recorder(tmp_path / "walk") as recorder:
        recorder.write(first)
        with monkeypatch.context() as patch:

            def no_space(path, content):
                os.close(os.open(path, os.O_CREAT))
                raise OSError(28, "No space left on device")

            patch.setattr("pathlib.Path.write_bytes", no_space)
            with pytest.raises(OSError, match=r"No space.*000001\.png"):
                recorder.write(second)
    assert seen(folder.stream(folder.Config(tmp_path / "walk"))) == seen([first])
    assert len(list((tmp_path / "walk").iterdir())) == 2


@pytest.mark.parametrize("crafted", list(recordings()), ids=lambda crafted: crafted.name)
def test_a_crafted_index_is_named_or_its_frames_are_left_out(tmp_path, crafted):
    (tmp_path / INDEX).write_bytes(crafted.data)
    (tmp_path / "a.png").write_bytes(encode_png(np.zeros((4, 4, 3), np.uint8)))
    try:
        items = list(recording.read(tmp_path).frames())
    except RecordingError as error:
        assert INDEX in str(error) or "is empty" in str(error)
        assert len(str(error)) < 2000
    else:
        assert [type(item) for item in items] == [DroppedFrame]
