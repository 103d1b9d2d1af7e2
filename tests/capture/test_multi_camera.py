"""Several cameras as one stream: which there are, what they are called, and which images were taken together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode.capture import recording
from splatnode.capture.film import ALL, CameraSet, CameraSource, find_cameras, select_cameras
from splatnode.capture.frame import Clock, DroppedFrame, Frame, Stamp
from splatnode.capture.image_file import encode_png
from splatnode.capture.keyframe_selection import Config, Limits, choose, group_frame_sets
from splatnode.capture.rig import TOLERANCE_S
from tests.support import lerobot_sets, mcap_files


def picture(seed: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 255, (12, 16, 3), np.uint8)
    return cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC)


def write_photographs(folder: Path, names: list[str]) -> Path:
    folder.mkdir(parents=True)
    for seed, name in enumerate(names):
        (folder / name).write_bytes(encode_png(picture(seed)))
    return folder


def frames_of(cameras: CameraSet, *names: str) -> list[Frame]:
    return [each for each in cameras.stream(names) if isinstance(each, Frame)]


def sets_of(frames: list[Frame], tolerance_s: float = TOLERANCE_S) -> list[tuple[Frame, ...]]:
    return [each for each in group_frame_sets(frames, tolerance_s) if isinstance(each, tuple)]


def names_of(cameras: CameraSet, *names: str) -> list[str]:
    return [each.name for each in cameras.stream(names)]


def write_film(file: Path, count: int = 3, rate: int = 10) -> Path:
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), rate, (64, 48))
    for seed in range(count):
        writer.write(picture(seed))
    writer.release()
    return file


def test_a_frame_without_a_camera_waits_for_no_other():
    """A recording that is interrupted after it keeps it."""

    def interrupted():
        yield Frame(0, "one.png", 0, picture(0), None)
        raise KeyboardInterrupt

    together = next(group_frame_sets(interrupted()))
    assert isinstance(together, tuple)
    assert [each.name for each in together] == ["one.png"]


def test_a_folder_per_camera_is_one_stream_of_frame_sets(tmp_path):
    for camera in ("right", "left"):
        write_photographs(tmp_path / camera, ["img2.png", "img10.png"])
    cameras = select_cameras([tmp_path])
    frames = frames_of(cameras)
    assert [each.name for each in frames] == ["left/img2.png", "right/img2.png", "left/img10.png", "right/img10.png"]
    assert [each.camera_id for each in frames] == ["left", "right"] * 2
    assert [each.frame_id for each in frames] == [0, 1, 2, 3]
    assert [each.stamp_ns for each in frames] == sorted(each.stamp_ns for each in frames)
    assert [[frame.name for frame in frames] for frames in sets_of(frames)] == [
        ["left/img2.png", "right/img2.png"],
        ["left/img10.png", "right/img10.png"],
    ]
    assert cameras.folder == tmp_path and not cameras.is_film
    assert names_of(cameras, "right/img10", "left/img2.png") == ["left/img2.png", "right/img10.png"]
    with pytest.raises(ValueError, match="no photograph named img2.png: .* such as left/img10.png"):
        names_of(cameras, "img2.png")


def test_times_in_names_tell_what_was_taken_together(tmp_path):
    write_photographs(tmp_path / "a", ["1700000000.000.png", "1700000000.100.png", "1700000000.200.png"])
    write_photographs(tmp_path / "b", ["1700000000.115.png", "1700000000.300.png"])
    cameras = select_cameras([tmp_path])
    assert [sorted(each.names) for each in cameras.form_frame_sets()] == [["a"], ["a", "b"], ["a"], ["b"]]
    assert len(replace(cameras, tolerance_s=0.001).form_frame_sets()) == 5
    frames = frames_of(cameras)
    assert [frame.captured_at and frame.captured_at.clock for frame in frames] == [Clock.UTC] * 5
    assert [len(each) for each in sets_of(frames)] == [1, 2, 1, 1]


def test_equal_times_of_one_camera_tell_nothing_and_names_do(tmp_path):
    names = ["20240501_101500 (1).png", "20240501_101500 (2).png"]  # a number behind a time: of a whole sequence
    for camera in ("a", "b"):
        write_photographs(tmp_path / camera, names)
    assert [len(each.names) for each in select_cameras([tmp_path]).form_frame_sets()] == [2, 2]


def test_what_cannot_be_read_is_named_with_its_camera(tmp_path):
    write_photographs(tmp_path / "a", ["1.png", "2.png"])
    write_photographs(tmp_path / "b", ["1.png"])
    (tmp_path / "b" / "2.png").write_bytes(b"no image")
    (tmp_path / "b" / "3.dng").write_bytes(b"raw")
    found = list(select_cameras([tmp_path]).stream())
    assert {each.name for each in found if isinstance(each, DroppedFrame)} == {"b/2.png", "b/3.dng"}
    assert len(found) == 5


def test_topics_of_a_log_are_cameras(tmp_path):
    def shot(topic, seed, header_ms):
        return mcap_files.compressed(topic, picture(seed), header_ns=mcap_files.START_NS + header_ms * 10**6)

    messages = [
        shot(f"/robot/{camera}/image_raw", seed, 100 * seed + late)
        for seed in range(3)
        for camera, late in (("left", 0), ("right", 7), ("wrist", 50))
    ]
    messages += [shot("/robot/left/image_raw/compressed", 0, 0)]
    file = mcap_files.write(tmp_path / "drive.mcap", messages)
    cameras = select_cameras([file])
    assert [each.camera_id for each in cameras.cameras] == ["left", "right", "wrist"]
    frames = frames_of(cameras)
    assert [frame.name for frame in frames[:4]] == [
        "left/000000.png",
        "right/000000.png",
        "wrist/000000.png",
        "left/000001.png",
    ]
    assert [[each.camera_id for each in frames] for frames in sets_of(frames)] == [
        ["left", "right"],
        ["wrist"],
    ] * 3
    assert [len(each) for each in sets_of(frames, 0.06)] == [3, 3, 3]
    by_topic = select_cameras([file], ["/robot/left/image_raw", "wrist"])
    assert [each.camera_id for each in by_topic.cameras] == ["left", "wrist"]
    with pytest.raises(ValueError, match="there is no camera front; there are: left, right, wrist"):
        select_cameras([file], ["left", "front"])
    with pytest.raises(ValueError, match="two cameras or more that are used together"):
        select_cameras([file], ["left"])


def test_cameras_of_an_episode(tmp_path):
    keys = [f"observation.images.{camera}" for camera in ("top", "wrist")]
    episodes = [{key: [picture(10 * n + i) for i in range(4)] for n, key in enumerate(keys)} for _ in range(2)]
    data_set = lerobot_sets.write(tmp_path / "set", episodes)
    cameras = select_cameras([Path(f"{data_set}#1")])
    frames = frames_of(cameras)
    assert [len(each) for each in sets_of(frames)] == [2] * 4
    assert [frame.name for frame in frames[:3]] == ["top/000000.png", "wrist/000000.png", "top/000001.png"]
    with pytest.raises(ValueError, match="several cameras are those of an episode"):
        find_cameras(data_set)


def test_several_films_are_cameras_of_their_names(tmp_path):
    films = [write_film(tmp_path / f"{camera}.mp4") for camera in ("left", "right")]
    cameras = select_cameras(films)
    frames = frames_of(cameras)
    assert cameras.is_film and cameras.folder is None
    assert [len(each) for each in sets_of(frames)] == [2] * 3
    assert [each.camera_id for each in select_cameras(films, ["l", "r"]).cameras] == ["l", "r"]
    with pytest.raises(ValueError, match="--cameras must name each of the 2 sources"):
        select_cameras(films, ["left"])


def test_folders_elsewhere_are_told_apart_by_what_differs(tmp_path):
    folders = [write_photographs(tmp_path / camera / "data", ["1.png"]) for camera in ("cam0", "cam1")]
    cameras = select_cameras(folders)
    assert [each.camera_id for each in cameras.cameras] == ["cam0", "cam1"] and cameras.folder is None


def test_what_has_no_several_cameras_is_refused(tmp_path):
    write_photographs(tmp_path / "mixed", ["1.png"])
    write_photographs(tmp_path / "mixed" / "left", ["1.png"])
    with pytest.raises(ValueError, match="photographs beside the folders of its cameras"):
        select_cameras([tmp_path / "mixed"])
    with pytest.raises(ValueError, match="has one camera; give a folder with a folder of each camera"):
        select_cameras([write_film(tmp_path / "film.mp4")])
    with pytest.raises(FileNotFoundError, match="is not there"):
        select_cameras([tmp_path / "nothing"])
    with pytest.raises(ValueError, match="all folders of photographs, or all films"):
        select_cameras([tmp_path / "film.mp4", tmp_path / "mixed" / "left"])
    with pytest.raises(ValueError, match="each with its own name"):
        CameraSet((CameraSource("a", tmp_path), CameraSource("a", tmp_path)))
    assert ALL == "all"


def test_a_recording_of_each_camera_is_a_folder_of_it(tmp_path):
    for camera in ("a", "b"):
        with recording.Recorder(tmp_path / camera) as recorder:
            for i in range(2):
                stamp = Stamp(10**18 + i * 10**8, Clock.UTC)
                recorder.write(Frame(i, f"{i}.png", i * 10**8, picture(i), None, captured_at=stamp))
    frames = frames_of(select_cameras([tmp_path]))
    assert [len(each) for each in sets_of(frames)] == [2, 2]


def make_frame(camera: str, step: int, image: np.ndarray) -> Frame:
    ns = step * 10**8
    return Frame(step, f"{camera}/{step}", ns, image, None, captured_at=Stamp(ns, Clock.RECORDING), camera_id=camera)


def test_what_one_camera_adds_takes_the_whole_frame_set():
    scene = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (300, 900, 3), np.uint8), (0, 0), 2)
    scene = cv2.normalize(scene, scene, 0, 255, cv2.NORM_MINMAX)

    def shot(camera, step, x):
        return make_frame(camera, step, np.ascontiguousarray(scene[:240, x : x + 320]))

    frames = []
    for step in range(8):  # one camera moves fast, the other by little: too little to be taken alone, and no copy
        frames += [shot("fast", step, 60 * step), shot("slow", step, 8 * step)]
    config = Config(max_fps=1e9, patience_s=0.0)
    alone = choose([frame for frame in frames if frame.camera_id == "slow"], config, Limits(), 60)
    both = choose(frames, config, Limits(), 60)
    fast = [name.split("/")[1] for name in both.names if name.startswith("fast")]
    slow = [name.split("/")[1] for name in both.names if name.startswith("slow")]
    assert len(alone.names) < len(slow) and fast == slow
    assert both.taken["frame set"] > 0
    few = choose(frames, config, Limits(), 6)
    assert len(few.names) <= 6 and len(few.names) % 2 == 0
    assert {name.split("/")[1] for name in few.names if "slow" in name} == {
        name.split("/")[1] for name in few.names if "fast" in name
    }


def test_an_unusable_image_leaves_its_frame_set_alone():
    images = [picture(seed, (320, 240)) for seed in range(3)]
    frames = []
    for step, image in enumerate(images):
        frames += [make_frame("left", step, image), make_frame("right", step, np.zeros_like(image))]
    choice = choose(frames, Config(max_fps=1e9, patience_s=0.0), Limits(max_blur_px=99.0), 60)
    assert [name for name in choice.names if name.startswith("right")] == []
    assert len(choice.names) == 3
