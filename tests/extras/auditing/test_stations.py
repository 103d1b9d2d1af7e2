"""Which recordings a station has, and which cameras; what cannot be read costs only itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.extras.audit import Film, ImageFiles, StationRecording, find_recordings, load_sample_frames
from tests.support import lerobot_sets
from tests.support.mcap_files import as_json, compressed, write

PICTURE = np.zeros((48, 64, 3), np.uint8)
EPISODE = {"top": [PICTURE] * 2, "side": [PICTURE] * 2}


def cameras(*named: Path) -> dict[str, list[str]]:
    return {each.name: sorted(each.cameras) for each in find_recordings(named)}


def problems(found: list[StationRecording]) -> dict[str, str]:
    return {each.name: each.problem for each in found if each.problem}


def put(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()


def test_each_episode_of_a_data_set_is_a_recording_of_its_cameras(tmp_path):
    pytest.importorskip("pyarrow", reason="needs pyarrow")
    first, second = (lerobot_sets.write(tmp_path / name, [EPISODE] * 2) for name in ("pusht", "stack"))
    assert cameras(first) == {"episode_000000": ["side", "top"], "episode_000001": ["side", "top"]}
    assert list(cameras(second, first)) == [f"{name}/episode_00000{i}" for name in ("stack", "pusht") for i in (0, 1)]
    assert cameras(Path(f"{first}#1/top"), Path(f"{first}#1/side")) == {"episode_000001": ["side", "top"]}
    with pytest.raises(ValueError, match="pusht/episode_000001' is given twice"):
        find_recordings([first, Path(f"{first}#1/top")])


def test_each_mcap_file_is_a_recording_whose_topics_are_cameras(tmp_path):
    for name in ("drive2", "drive10"):
        write(tmp_path / f"{name}.mcap", [compressed("/front", PICTURE), compressed("/rear", PICTURE)])
    assert cameras(tmp_path) == {"drive2.mcap": ["/front", "/rear"], "drive10.mcap": ["/front", "/rear"]}


def test_folders_and_lists_hold_recordings_and_videos_have_names(tmp_path):
    for name in (
        "a/left/1.jpg",
        "a/right/1.jpg",
        "b/left.jpg",
        "c/left.mp4",
        "c/right.mp4",
        "d/1/left/x.png",
        "d/2/left/x.png",
    ):
        put(tmp_path / name)
    expected = {"a": ["left", "right"], "b": ["left"], "c": ["left", "right"]}
    assert cameras(*(tmp_path / name for name in expected)) == expected
    assert cameras(tmp_path / "d") == {"1": ["left"], "2": ["left"]}
    assert cameras(tmp_path / "c" / "left.mp4") == {"left.mp4": ["camera"]}
    (tmp_path / "list.txt").write_text("b\nlost\na\nlist.txt\n")
    found = find_recordings([tmp_path / "list.txt"])
    assert [each.name for each in found] == ["b", "lost", "a", "list.txt"]
    assert "is not there" in found[1].problem and not found[1].cameras
    assert "leads to itself" in found[3].problem


def test_what_cannot_be_read_has_its_sentence_and_the_others_their_cameras(tmp_path):
    pytest.importorskip("pyarrow", reason="needs pyarrow")
    lerobot_sets.write(tmp_path / "in" / "good", [EPISODE])
    lerobot_sets.write(tmp_path / "in" / "old", [EPISODE], codebase_version="v2.1")
    write(tmp_path / "in" / "talk.mcap", [as_json("/log", "Log", {})])
    (tmp_path / "in" / "torn.mcap").write_bytes(b"no log")
    found = find_recordings([tmp_path / "in"])
    assert [each.name for each in found if each.cameras] == ["episode_000000"]
    told = problems(found)
    assert "version v3.0, it is of v2.1" in told["old"] and "must have a topic of images" in told["talk.mcap"]
    assert "no MCAP file that is whole" in told["torn.mcap"] and len(told) == 3


def test_a_camera_without_images_is_a_photograph_that_says_why(tmp_path):
    pytest.importorskip("pyarrow", reason="needs pyarrow")
    data_set = lerobot_sets.write(tmp_path / "pusht", [EPISODE])
    (data_set / "videos" / "top" / "chunk-000" / "file-000.mp4").write_bytes(b"no video")
    drive = write(tmp_path / "drive.mcap", [compressed("/front", PICTURE), as_json("/log", "Log", {})])
    (tmp_path / "left.mp4").write_bytes(b"no video")
    for named, camera, reason in (
        (Path(f"{data_set}#0/top"), "top", "is no video"),
        (Path(f"{drive}#/log"), "/log", "has no images of a topic /log"),
        (tmp_path / "left.mp4", "camera", "is no video"),
    ):
        (found,) = find_recordings([named])
        (dropped,) = load_sample_frames(found.cameras[camera], None)
        assert isinstance(dropped, DroppedFrame) and reason.replace("'", "") in dropped.reason.replace("'", "")
    assert len(load_sample_frames(find_recordings([Path(f"{data_set}#0/side")])[0].cameras["side"], None)) == 2


@pytest.mark.parametrize("count", [1, 2, 3, 40])
def test_of_a_film_the_first_the_last_and_one_between_are_looked_at(tmp_path, count):
    drive = write(tmp_path / "drive.mcap", [compressed("/front", PICTURE) for _ in range(count)])
    frames = load_sample_frames(Film(Path(f"{drive}#/front")), None)
    assert all(isinstance(frame, Frame) for frame in frames)
    indices = [int(frame.name[-10:-4]) for frame in frames]
    assert indices[0] == 0 and indices[-1] == count - 1 and len(indices) == min(count, 3)
    assert len(indices) < 3 or abs(indices[1] - (count - 1) / 2) <= count / 8


def test_of_a_folder_of_photographs_likewise(tmp_path):
    for index in range(5):
        put(tmp_path / "day" / "left" / f"{index}.jpg")
    (found,) = find_recordings([tmp_path / "day"])
    assert found.cameras["left"] == ImageFiles(tuple(tmp_path / "day" / "left" / f"{i}.jpg" for i in (0, 2, 4)))


def test_files_of_one_name_are_of_one_camera_and_none_is_lost(tmp_path):
    for name in ("left.JPG", "left.NEF", "right.jpg", "right.png", "top.nef"):
        put(tmp_path / "day" / name)
    (found,) = find_recordings([tmp_path / "day"])
    files = {
        camera: [path.name for path in of.paths] for camera, of in found.cameras.items() if isinstance(of, ImageFiles)
    }
    assert files == {"left": ["left.JPG"], "right": ["right.jpg", "right.png"], "top": ["top.nef"]}


def test_raw_files_beside_the_photographs_of_a_folder_a_camera_are_left_out(tmp_path):
    for name in ("0.dng", "1.jpg", "1.dng", "2.dng"):
        put(tmp_path / "day" / "left" / name)
    (found,) = find_recordings([tmp_path / "day"])
    assert found.cameras == {"left": ImageFiles((tmp_path / "day" / "left" / "1.jpg",))}


def test_a_folder_beside_photographs_does_not_hide_them_and_is_named(tmp_path, caplog):
    for name in ("left.png", "right.png", "thumbs/a.png"):
        put(tmp_path / "monday" / name)
    assert cameras(tmp_path / "monday") == {"monday": ["left", "right"]}
    assert "monday: its photographs are its cameras; left out: thumbs" in caplog.text


@pytest.mark.parametrize("deep", ["", "year/"])
def test_a_folder_of_recordings_that_are_photographs_stands_for_them(tmp_path, deep):
    """The last one lacks a camera."""
    days = tmp_path / "days" / deep
    for name in ("day2/left.png", "day2/right.png", "day10/left.jpg", "day10/right.jpg", "day11/left.png"):
        put(days / name)
    put(days / "day12" / "left" / "1.png")
    both = ["left", "right"]
    expected = {"day2": both, "day10": both, "day11": ["left"], "day12": ["left"]}
    found = find_recordings([tmp_path / "days"])
    assert {each.name: sorted(each.cameras) for each in found} == expected and list(expected) == [r.name for r in found]


def test_folders_of_numbered_photographs_or_of_one_alike_are_cameras(tmp_path):
    for camera in ("left", "right"):
        for name in ("frame_1", "frame_2", "preview"):
            put(tmp_path / "monday" / camera / f"{name}.png")
    assert cameras(tmp_path / "monday") == {"monday": ["left", "right"]}
