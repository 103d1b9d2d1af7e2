"""Cameras written back, and read again by the formats' own libraries."""

from __future__ import annotations

import base64
import errno
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from splatnode import command_line
from splatnode.capture.frame import Clock, Stamp
from splatnode.capture.image_file import encode_png
from splatnode.extras.batch import BatchRecording, recordings
from splatnode.extras.batch.command import EXIT_GOOD, EXIT_SOME_FAILED, run_batch
from splatnode.extras.lerobot import list_parts
from splatnode.recon.result.export.stored import encode_cameras
from splatnode.recon.result.snapshot import CameraEstimate
from tests.support import lerobot_sets, mcap_files
from tests.support.recordings import REFUSAL, REPORT, options
from tests.support.synthetic import photographs

pq = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")

PICTURE = np.zeros((48, 64, 3), np.uint8)
K = np.array([[100.0, 0.0, 32.0], [0.0, 110.0, 24.0], [0.0, 0.0, 1.0]])


def camera(stem: str, index: int) -> CameraEstimate:
    T_world_camera = np.array(
        [[0.0, -1.0, 0.0, index], [1.0, 0.0, 0.0, 0.5], [0.0, 0.0, 1.0, 2.0], [0.0, 0.0, 0.0, 1.0]]
    )
    captured_at = Stamp(100_000_000 * index, Clock.RECORDING)
    return CameraEstimate(f"{stem}_{index:06d}.png", index, T_world_camera, K, 64, 48, None, captured_at)


def placed(tmp_path: Path, *refused: str):
    """The work of a batch: the cameras of frames 0 and 2, or a refusal for recordings of these names."""

    def work(recording: BatchRecording, folder: Path) -> list[str]:
        made = tmp_path / "made" / recording.name
        made.mkdir(parents=True, exist_ok=True)
        (made / "report.json").write_text(json.dumps(REFUSAL if recording.name in refused else REPORT))
        (made / "cameras.json").write_bytes(encode_cameras([camera("a", 0), camera("a", 2)]))
        return ["cp", "-r", str(made), str(folder)]

    return work


def ran(tmp_path: Path, source: Path, *refused: str, **changed: Any) -> int:
    out = tmp_path / "out"
    found = recordings([source], out)
    return run_batch(options(out, write_back=True, **changed), found, placed(tmp_path, *refused), ["act"])


@pytest.fixture
def data_set(tmp_path):
    episodes = [{"top": [PICTURE] * 4, "side": [PICTURE] * 4}, {"top": [PICTURE] * 3, "side": [PICTURE] * 3}]
    return lerobot_sets.write(tmp_path / "pusht", episodes)


@pytest.fixture
def drive(tmp_path):
    told = [mcap_files.compressed(topic, PICTURE) for topic in ("/a", "/b", "/a", "/a", "/b")]
    return mcap_files.write(tmp_path / "drive.mcap", told)


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_data_set_gets_a_table_beside_its_own_which_stay(tmp_path, data_set, capsys):
    before = content(data_set)
    assert ran(tmp_path, data_set, "pusht_episode_000001_side") == EXIT_GOOD
    after = content(data_set)
    assert set(after) - set(before) == {"meta/splatnode_cameras.parquet"}
    assert {name: after[name] for name in before} == before
    assert "4 recordings are rows of" in capsys.readouterr().out
    rows = pq.read_table(data_set / "meta" / "splatnode_cameras.parquet").to_pylist()
    assert [(row["episode_index"], row["camera"]) for row in rows] == [(0, "side"), (0, "top"), (1, "side"), (1, "top")]
    first, refused = rows[0], rows[2]
    assert (first["verdict"], first["frame_index"], first["timestamp"]) == ("OK", [0, 2], [0.0, 0.2])
    assert np.array_equal(np.reshape(first["T_world_camera"][1], (4, 4)), camera("a", 2).T_world_camera)
    assert np.array_equal(np.reshape(first["K"][0], (3, 3)), K) and first["width"] == [64, 64]
    assert (refused["verdict"], refused["frame_index"]) == ("NO_OVERLAP", [])


def test_in_place_the_tables_get_columns_and_keep_theirs(tmp_path, data_set):
    file = data_set / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    before = pq.read_table(file)
    for _ in range(2):  # the second time they take the place of the first
        assert ran(tmp_path, data_set, in_place=True, resume=True) == EXIT_GOOD
    after = pq.read_table(file)
    assert after.select(before.column_names) == before and len(after.column_names) == len(before.column_names) + 22
    row = after.to_pylist()[1]
    assert row["splatnode/top/frame_index"] == [0, 2] and row["splatnode/side/verdict"] == "OK"
    assert len(list_parts(data_set)) == 4, "it is a data set as before"


def test_a_log_gets_another_one_beside_it(tmp_path, drive):
    before = drive.read_bytes()
    assert ran(tmp_path, drive, "drive_b") == EXIT_GOOD
    assert drive.read_bytes() == before
    with (tmp_path / "drive.splatnode.mcap").open("rb") as stream:
        told = [(channel.topic, schema.name, message.log_time, json.loads(message.data)) for schema, channel, message
                in make_reader(stream).iter_messages()]  # fmt: skip
    start, step = mcap_files.START_NS, mcap_files.STEP_NS
    assert [(topic, name, at_ns - start) for topic, name, at_ns, _ in told] == [
        ("/a/splatnode/verdict", "foxglove.Log", 0),
        ("/a/splatnode/pose", "foxglove.PoseInFrame", 0),
        ("/a/splatnode/calibration", "foxglove.CameraCalibration", 0),
        ("/b/splatnode/verdict", "foxglove.Log", step),
        ("/a/splatnode/pose", "foxglove.PoseInFrame", 3 * step),
        ("/a/splatnode/calibration", "foxglove.CameraCalibration", 3 * step),
    ]
    pose, lens = told[4][3]["pose"], told[5][3]
    assert pose["position"] == {"x": 2.0, "y": 0.5, "z": 2.0}
    assert pose["orientation"]["z"] == pytest.approx(0.5**0.5) and pose["orientation"]["w"] == pytest.approx(0.5**0.5)
    assert (lens["K"][0], lens["K"][2], lens["width"]) == (100.0, 31.5, 64), "the top-left pixel is at (0, 0)"
    assert told[3][3]["level"] == 3 and told[3][3]["message"].startswith("NO_OVERLAP")
    assert [recording.name for recording in recordings([tmp_path], tmp_path / "out")] == ["drive_a", "drive_b"]


def test_a_log_in_disorder_gets_each_pose_with_its_picture(tmp_path):
    """The pictures of a simulation lie as 2, 0, 1: numbers 0 and 2 are the second and the first of the file."""
    headers_ns = [200_000_000, 0, 100_000_000]
    told = [mcap_files.compressed("/a", PICTURE, header_ns=ns) for ns in headers_ns]
    drive = mcap_files.write(tmp_path / "drive.mcap", told)
    assert ran(tmp_path, drive) == EXIT_GOOD
    with (tmp_path / "drive.splatnode.mcap").open("rb") as stream:
        found = [(channel.topic, message.log_time - mcap_files.START_NS, json.loads(message.data)["timestamp"])
                 for _, channel, message in make_reader(stream).iter_messages()]  # fmt: skip
    first, second = {"sec": 0, "nsec": 0}, {"sec": 0, "nsec": 200_000_000}
    assert found == [
        ("/a/splatnode/pose", 0, second),
        ("/a/splatnode/calibration", 0, second),
        ("/a/splatnode/verdict", mcap_files.STEP_NS, first),
        ("/a/splatnode/pose", mcap_files.STEP_NS, first),
        ("/a/splatnode/calibration", mcap_files.STEP_NS, first),
    ]


def test_what_cannot_be_written_is_said_and_the_rest_goes_on(tmp_path, data_set, drive, capsys):
    (tmp_path / "drive.splatnode.mcap").mkdir()
    out = tmp_path / "out"
    found = recordings([data_set, drive], out)
    assert run_batch(options(out, write_back=True), found, placed(tmp_path), ["act"]) == EXIT_SOME_FAILED
    said = capsys.readouterr().out
    assert "4 recordings are rows of" in said and f"the cameras of {drive} were not written back: " in said


def test_photographs_have_nothing_to_be_written_back_to(tmp_path, capsys):
    out = tmp_path / "out"
    assert run_batch(options(out, write_back=True), [BatchRecording("a", "/x")], placed(tmp_path), ["act"]) == EXIT_GOOD
    assert "nothing to write back to" in capsys.readouterr().out


def test_in_place_goes_with_write_back(tmp_path, drive, capsys):
    argv = ["batch", str(drive), "--out", str(tmp_path / "out"), "--in-place"]
    assert command_line.main(argv) != EXIT_GOOD
    assert "--in-place says how --write-back writes; give both" in capsys.readouterr().err


def test_an_episode_and_a_topic_are_reconstructed_and_written_back(tmp_path):
    images = [frame.image for frame in photographs()[:3]]
    data_set = lerobot_sets.write(tmp_path / "in" / "set", [{"top": images}])
    mcap_files.write(tmp_path / "in" / "log.mcap", [mcap_files.compressed("/image", image) for image in images])
    how = ["--preset", "preview", "--every-frame"]
    argv = ["batch", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--cores", "1", "--write-back", *how]
    assert command_line.main(argv) == EXIT_GOOD
    (row,) = pq.read_table(data_set / "meta" / "splatnode_cameras.parquet").to_pylist()
    assert row["verdict"] == "OK" and row["frame_index"] == [0, 1, 2]
    with (tmp_path / "in" / "log.splatnode.mcap").open("rb") as stream:
        poses = [each for _, channel, each in make_reader(stream).iter_messages() if channel.topic.endswith("pose")]
    assert len(poses) == 3


def everything(file: Path) -> list[tuple]:
    """All messages as mcap's own reader has them, then attachments and metadata."""
    with file.open("rb") as stream:
        reader = make_reader(stream)
        told = [
            (channel.topic, channel.message_encoding, channel.metadata, schema and (schema.name, schema.data))
            + (message.log_time, message.publish_time, message.sequence, message.data)
            for schema, channel, message in reader.iter_messages(log_time_order=False)
        ]
        attached = [(each.name, each.data) for each in reader.iter_attachments()]
        return [*told, *attached, *((each.name, each.metadata) for each in reader.iter_metadata())]


def own(told: list[tuple]) -> list[tuple]:
    return [each for each in told if "/splatnode/" in each[0]]


def test_in_place_a_log_gets_topics_and_keeps_its_own(tmp_path):
    file = tmp_path / "drive.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="robot", library="of somebody")
        schema = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
        picture = {"format": "png", "data": base64.b64encode(encode_png(PICTURE)).decode()}
        pictures = writer.register_channel("/a", "json", schema, {"lens": "wide"})
        odometry = writer.register_channel("/odometry", "application/octet-stream", 0)
        for index in range(3):
            writer.add_message(odometry, index * 10, bytes([index, 255]), index * 10 + 1, sequence=7 + index)
            writer.add_message(pictures, index * 10, json.dumps(picture).encode(), index * 10)
        writer.add_attachment(1, 2, "map", "text/plain", b"where")
        writer.add_metadata("robot", {"name": "r2"})
        writer.finish()
    file.chmod(0o640)
    before = everything(file)
    assert ran(tmp_path, file, in_place=True) == EXIT_GOOD
    once = file.read_bytes()
    assert ran(tmp_path, file, in_place=True, resume=True) == EXIT_GOOD
    assert file.read_bytes() == once, "the second time they take the place of the first"
    after = everything(file)
    assert [each for each in after if each not in own(after)] == before and len(before) == 8
    assert [each[0] for each in own(after)][:3] == [
        f"/a/splatnode/{kind}" for kind in ("verdict", "pose", "calibration")
    ]
    assert file.stat().st_mode & 0o777 == 0o640
    assert {path.name for path in tmp_path.iterdir() if path.suffix == ".mcap" or path.name[0] == "."} == {"drive.mcap"}


def test_a_log_that_breaks_off_or_a_full_disk_leaves_it_as_it_is(tmp_path, drive, monkeypatch, capsys):
    whole, found = drive.read_bytes(), recordings([drive], None)
    broken = whole[: len(whole) // 2]
    drive.write_bytes(broken)
    in_place = options(tmp_path / "broken", write_back=True, in_place=True)
    assert run_batch(in_place, found, placed(tmp_path), ["act"]) == EXIT_SOME_FAILED
    assert drive.read_bytes() == broken and "were not written back: " in capsys.readouterr().out
    drive.write_bytes(whole)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("splatnode.extras.batch.mcap.add_messages", full)
    assert ran(tmp_path, drive, in_place=True) == EXIT_SOME_FAILED
    assert drive.read_bytes() == whole and "No space left" in capsys.readouterr().out
    assert not list(tmp_path.glob(".*.partial"))
