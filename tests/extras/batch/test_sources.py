"""Which recordings there are, and what they are called."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from splatnode.extras import batch
from splatnode.extras.batch import recordings
from tests.support import lerobot_sets
from tests.support.mcap_files import as_json, compressed, write


def put(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()


def names(*sources: Path, out: Path = Path("out"), **own) -> list[str]:
    return [recording.name for recording in recordings(sources, out, **own)]


def test_a_folder_of_photographs_is_one_recording(tmp_path):
    put(tmp_path / "fox" / "images" / "1.jpg")
    put(tmp_path / "fox" / "images" / "masks" / "1.png")
    assert names(tmp_path / "fox" / "images") == names(tmp_path / "fox") == ["fox"]
    assert recordings([tmp_path / "fox"], Path("out"))[0].source == str(tmp_path / "fox" / "images")


def test_folders_and_videos_are_found_at_any_depth_in_natural_order(tmp_path):
    for name in ("scene10/images/1.jpg", "scene2/1.png", "day/film.MP4", "day/cam0/1.jpg", ".hidden/1.jpg", "notes.md"):
        put(tmp_path / name)
    assert names(tmp_path) == ["day_cam0", "day_film", "scene2", "scene10"]


def test_results_are_no_recordings(tmp_path):
    for name in ("a/1.jpg", "out/a/preview.png", "earlier/preview.png", "earlier/report.json"):
        put(tmp_path / name)
    assert names(tmp_path, out=tmp_path / "out") == ["a"]


def test_links_in_a_circle_end(tmp_path):
    put(tmp_path / "a" / "1.jpg")
    (tmp_path / "b").symlink_to(tmp_path)
    assert names(tmp_path) == ["a"]


def test_a_list_names_sources_beside_it_that_need_not_be_there(tmp_path):
    put(tmp_path / "a" / "1.jpg")
    put(tmp_path / "many" / "b" / "1.jpg")
    put(tmp_path / "film.mkv")
    (tmp_path / "list.txt").write_text("# of the third of May\na\n\nfilm.mkv\nmany\nlost.mp4\n")
    found = recordings([tmp_path / "list.txt"], Path("out"))
    assert [recording.name for recording in found] == ["a", "film", "b", "lost"]
    assert found[3].source == str(tmp_path / "lost.mp4")


def test_a_list_that_leads_to_itself_is_told(tmp_path):
    (tmp_path / "one.txt").write_text("two.txt\n")
    (tmp_path / "two.txt").write_text("one.txt\n")
    with pytest.raises(ValueError, match=r"the list '.*one.txt' leads to itself"):
        names(tmp_path / "one.txt")


def test_recordings_of_one_name_are_told_apart_whatever_their_order(tmp_path):
    for name in ("a/x/1.jpg", "b/x/1.jpg", "b/y/1.jpg", "index.html/1.jpg"):
        put(tmp_path / name)
    found = names(tmp_path / "a", tmp_path / "b")
    assert found[2] == "y" and all(name.startswith("x~") for name in found[:2]) and len(set(found)) == 3
    assert sorted(names(tmp_path / "b", tmp_path / "a")) == sorted(found)
    (own,) = names(tmp_path / "index.html", own_names=frozenset({"index.html"}))
    assert own.startswith("index.html~")


def test_the_same_recording_is_found_once(tmp_path):
    put(tmp_path / "a" / "1.jpg")
    (tmp_path / "list.txt").write_text("a\na/../a\n")
    assert names(tmp_path / "list.txt") == ["a"]


def test_what_is_named_must_be_there_and_hold_something(tmp_path):
    with pytest.raises(FileNotFoundError, match="is not there; give a folder, a video, .* or a list"):
        names(tmp_path / "lost")
    with pytest.raises(ValueError, match="no photographs and no videos in"):
        names(tmp_path)


def test_any_file_name_makes_a_folder_name_of_one_line(tmp_path):
    strange = tmp_path / os.fsdecode(b"a\nb\xff")
    put(strange / "1.jpg")
    (found,) = recordings([strange], Path("out"))
    assert found.name.isprintable() and os.fsdecode(b"a\nb\xff") in found.source


def test_each_image_topic_of_an_mcap_file_is_a_recording(tmp_path):
    picture = np.zeros((48, 64, 3), np.uint8)
    (tmp_path / "day").mkdir()
    write(tmp_path / "day" / "drive.mcap", [compressed("/front/image", picture), compressed("/rear/image", picture)])
    write(tmp_path / "day" / "talk.mcap", [as_json("/log", "Log", {})])
    (tmp_path / "day" / "broken.mcap").write_bytes(b"no log")
    assert names(tmp_path) == ["day_broken", "day_drive_front_image", "day_drive_rear_image", "day_talk"]
    (tmp_path / "list.txt").write_text("day/drive.mcap#/rear/image\nday/drive.mcap\n")
    found = recordings([tmp_path / "list.txt"], Path("out"))
    assert [recording.name for recording in found] == ["drive_rear_image", "drive_front_image"]
    assert found[0].source == str(tmp_path / "day" / "drive.mcap#" / "rear" / "image")
    assert names(Path(found[0].source)) == ["drive_rear_image"]


def test_each_camera_of_each_episode_of_a_data_set_is_a_recording(tmp_path):
    pytest.importorskip("pyarrow", reason="needs pyarrow")
    picture = [np.zeros((48, 64, 3), np.uint8)]
    data_set = lerobot_sets.write(
        tmp_path / "sets" / "pusht", [{"top": picture, "side": picture}, {"top": picture, "side": picture}]
    )
    lerobot_sets.write(tmp_path / "sets" / "old", [{"top": picture}], codebase_version="v2.1")
    found = recordings([tmp_path / "sets"], Path("out"))
    episodes = [f"pusht_episode_00000{number}_{key}" for number in range(2) for key in ("top", "side")]
    assert [recording.name for recording in found] == ["old", *episodes]
    assert found[2].source == str(data_set) + "#episode_000000/side"
    assert names(data_set) == episodes and names(Path(found[2].source)) == [episodes[1]]


def test_folders_however_deep_do_not_end_the_others(tmp_path, caplog):
    """1200 of them: as deep as a path may be, and deeper than functions call each other."""
    put(tmp_path / "a" / "1.jpg")
    place = os.open(tmp_path, os.O_RDONLY)
    for _ in range(2500):
        os.mkdir("d", dir_fd=place)
        below = os.open("d", os.O_RDONLY, dir_fd=place)
        os.close(place)
        place = below
    os.close(place)
    try:
        assert names(tmp_path) == ["a"]
        assert "folders more than 100 deep are not looked into" in caplog.text
    finally:
        subprocess.run(["rm", "-rf", str(tmp_path / "d")], check=True)


def test_lists_that_name_lists_twice_are_read_once(tmp_path):
    """Thirty such lists would be read a billion times."""
    put(tmp_path / "a" / "1.jpg")
    for number in range(19):
        (tmp_path / f"{number}.txt").write_text(f"{number + 1}.txt\n./{number + 1}.txt\nagain{number + 1}.txt\n")
        (tmp_path / f"again{number}.txt").symlink_to(f"{number}.txt")
    (tmp_path / "19.txt").write_text("a\n" * 1000)
    (tmp_path / "again19.txt").symlink_to("19.txt")
    assert names(tmp_path / "0.txt") == ["a"]


def test_lists_that_lead_to_lists_for_ever_are_told(tmp_path):
    for number in range(2000):
        (tmp_path / f"{number}.txt").write_text(f"{number + 1}.txt\n")
    with pytest.raises(ValueError, match="lists may lead to lists 20 deep, and '.*20.txt' lies deeper; name it"):
        names(tmp_path / "0.txt")


def test_a_source_that_a_list_names_often_is_looked_into_once(tmp_path, monkeypatch):
    put(tmp_path / "many" / "a" / "1.jpg")
    (tmp_path / "b.mcap").write_bytes(b"no log")
    looked, parts = [], batch.list_parts
    monkeypatch.setattr(batch, "list_parts", lambda path: looked.append(path) or parts(path))
    (tmp_path / "list.txt").write_text("many\nb.mcap\nmany/../many\n" * 100)
    assert names(tmp_path / "list.txt") == ["a", "b"]
    assert len(looked) == 2


@pytest.mark.parametrize("line", ["circle.txt", "circle", "x" * 300, "x/" * 3000 + "y", "circle/a.mcap"])
def test_what_a_list_names_wrongly_costs_only_itself(tmp_path, line):
    put(tmp_path / "a" / "1.jpg")
    for name in ("circle.txt", "circle"):
        (tmp_path / name).symlink_to(name)
    (tmp_path / "list.txt").write_text(f"{line}\na\n")
    assert len(names(tmp_path / "list.txt")) == 2


def test_a_list_is_text(tmp_path):
    (tmp_path / "list.txt").write_bytes(b"a\0b\n")
    with pytest.raises(ValueError, match="must name a path a line; it has zero bytes"):
        names(tmp_path / "list.txt")
