"""What replay is given: all photographs of a small folder, keyframes of a video or of a large one."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode.api.photographs import names_of
from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Baseline, DroppedFrame, Frame, Intrinsics, RightImage
from splatnode.capture.image_file import decode_image, encode_png
from splatnode.capture.lenses import ALL, Lenses
from splatnode.capture.recording import Recorder
from splatnode.recon import replay_source
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.replay_source import Request, load_recording, load_source, parse_sources, select_frames

WALK = synthetic.Config(views=6, width=160, height=120)
STEPS = 36


@pytest.fixture(scope="module")
def walk() -> list[np.ndarray]:
    positions = np.linspace(0, WALK.views - 1, STEPS)
    return [
        synthetic.render_image(WALK, synthetic._camera_on_path(WALK, float(position)), i)
        for i, position in enumerate(positions)
    ]


@pytest.fixture(scope="module")
def film(walk, tmp_path_factory):
    file = tmp_path_factory.mktemp("film") / "walk.mp4"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 8, (WALK.width, WALK.height))
    for image in walk:
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    return file


def folder_of(images, folder):
    folder.mkdir()
    for i, image in enumerate(images):
        (folder / f"{i:03d}.png").write_bytes(encode_png(image))
    return folder


def framed(images):
    return [Frame(i, f"{i:03d}.png", i, image, None) for i, image in enumerate(images)]


def test_a_folder_of_few_photographs_is_used_whole(walk, tmp_path):
    folder = folder_of(walk[: replay_source.ALL], tmp_path / "few")
    given = load_source(Request(folder))
    assert len(given.frames) == replay_source.ALL and given.choice is None
    assert given.photographs == folder and not given.files() and given.further_bytes == 0


def test_what_is_no_photograph_is_named_and_the_others_are_used(walk, tmp_path):
    folder = folder_of(walk[:2], tmp_path / "mixed")
    (folder / "broken.png").write_bytes(encode_png(walk[2])[:2000])
    (folder / "notes.jpg").write_text("shopping list")
    (folder / "notes.txt").write_text("is not looked at")
    given = load_source(Request(folder)).frames
    assert [item.name for item in given if isinstance(item, Frame)] == ["000.png", "001.png"]
    reasons = {item.name: item.reason for item in given if isinstance(item, DroppedFrame)}
    assert reasons.keys() == {"broken.png", "notes.jpg"}
    assert reasons["broken.png"].startswith("truncated") and reasons["notes.jpg"].startswith("not an image")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="no photographs in .*empty'; give a folder of JPEGs or PNGs"):
        load_source(Request(tmp_path / "empty"))


def test_of_a_large_folder_keyframes_are_chosen_unless_all_are_asked_for(walk, tmp_path):
    folder = folder_of(walk, tmp_path / "many")
    given = load_source(Request(folder))
    assert given.choice is not None and given.choice.examined == STEPS and len(given.frames) < STEPS
    assert given.photographs == folder and not given.files()
    assert len(load_source(Request(folder, every_frame=True)).frames) == STEPS
    assert [frame.name for frame in load_source(Request(folder, views=2)).frames] == ["000.png", "035.png"]


def test_keyframes_of_a_video_are_files_of_the_result(film):
    given = load_source(Request(film))
    assert 2 < len(given.frames) < STEPS and given.choice is not None
    files = given.files()
    assert list(files) == [f"images/{frame.name}" for frame in given.frames]
    for frame, file in zip(given.frames, files.values(), strict=True):
        assert isinstance(frame, Frame) and np.array_equal(decode_image(file)[0], frame.image)
    assert given.further_bytes >= sum(map(len, files.values()))


def test_one_blurred_photograph_takes_no_others_with_it(walk, tmp_path):
    blurred = [cv2.GaussianBlur(image, (0, 0), 4) if i in (10, 20) else image for i, image in enumerate(walk)]
    for given in (load_source(Request(folder_of(blurred, tmp_path / "many"))), select_frames(framed(blurred))):
        assert given.choice is not None and "blurred" in given.choice.left_out
        assert not [reason for reason in given.choice.left_out if reason.startswith("between")]


def test_every_frame_of_a_video_is_used_or_it_says_that_they_are_too_many(film, monkeypatch):
    monkeypatch.setattr(replay_source, "MOST", 10)
    assert len(load_source(Request(film, every_frame=True)).frames) > 20
    monkeypatch.setattr(replay_source, "EVERY", 20)
    with pytest.raises(ValueError, match="'walk.mp4' has more than 20 frames that are .* Leave --every-frame out"):
        load_source(Request(film, every_frame=True))


def test_as_many_views_can_be_had_as_there_are_keyframes(film, monkeypatch):
    keyframes = len(load_recording(Request(film)).choice.names)
    monkeypatch.setattr(replay_source, "MOST", 4)  # of which thinning would leave 3
    for views in range(1, keyframes + 1):
        assert len(load_source(Request(film, views=views)).frames) == views


def test_raw_files_beside_photographs_do_not_count(walk, tmp_path):
    folder = folder_of(walk[: replay_source.ALL], tmp_path / "raw")
    for i in range(replay_source.ALL):
        (folder / f"{i:03d}.nef").write_bytes(b"raw")
    assert [frame.name for frame in load_source(Request(folder, views=3)).frames] == ["000.png", "014.png", "029.png"]
    given = load_source(Request(folder))
    assert given.choice is None and sum(isinstance(each, Frame) for each in given.frames) == replay_source.ALL


def test_it_says_of_what_the_keyframes_are(walk, film, tmp_path):
    assert f"of {STEPS} frames are keyframes" in str(load_source(Request(film)).choice)
    assert f"of {STEPS} photographs are keyframes" in str(
        load_source(Request(folder_of(walk, tmp_path / "many"))).choice
    )


def test_so_many_views_of_a_video_are_spread_evenly(film):
    every, few = load_source(Request(film)).frames, load_source(Request(film, views=3)).frames
    assert [frame.name for frame in few] == [every[i].name for i in (0, round((len(every) - 1) / 2), -1)]
    with pytest.raises(
        ValueError, match=r"1000 views are asked for: \d+ of 36 frames are keyframes .* at most as many"
    ):
        load_source(Request(film, views=1000))


def test_frames_at_hand_are_used_as_those_of_a_folder_are(walk, tmp_path):
    frames = framed(walk)
    assert select_frames(frames[: replay_source.ALL]).frames == tuple(frames[: replay_source.ALL])
    chosen, in_folder = select_frames(frames), load_source(Request(folder_of(walk, tmp_path / "many")))
    assert chosen.choice is not None and in_folder.choice is not None and chosen.choice.names == in_folder.choice.names
    assert select_frames(frames, every_frame=True).frames == tuple(frames)
    assert [frame.name for frame in select_frames(frames, views=2).frames] == ["000.png", "035.png"]
    with pytest.raises(ValueError, match="37 views are asked for: there are 36 photographs"):
        select_frames(frames, views=37)
    assert list(select_frames(frames[:2]).files()) == ["images/000.png", "images/001.png"]


def test_names_are_those_of_photographs(film):
    with pytest.raises(ValueError, match="--frames names photographs of a folder"):
        load_source(Request(film, frames=("a.png",)))


def test_a_file_that_is_no_video_is_told(tmp_path):
    (tmp_path / "notes.txt").write_text("not a video")
    with pytest.raises(ValueError, match="notes.txt' is no video that can be"):
        load_source(Request(tmp_path / "notes.txt"))
    with pytest.raises(FileNotFoundError, match="nothing.mp4' is not there; give a folder .* a video, or an MCAP file"):
        load_source(Request(tmp_path / "nothing.mp4"))
    with pytest.raises(ValueError, match="is an address; nothing is fetched: download it first"):
        load_source(Request(Path("https://a.site/film.mp4")))


def test_a_folder_into_which_results_were_written_is_the_same_recording(walk, film, tmp_path):
    folder = folder_of(walk[:3], tmp_path / "photographs")
    before = load_recording(Request(folder)).identity(ReconstructionConfig())
    (folder / "out").mkdir()
    os.utime(folder, ns=(1, 1))
    assert load_recording(Request(folder)).identity(ReconstructionConfig()) == before
    assert load_recording(Request(folder)).identity(ReconstructionConfig(seed=1)) != before
    assert load_recording(Request(film)).identity(ReconstructionConfig()) != before


def test_photographs_of_one_folder_are_named_one_by_one(walk, tmp_path):
    there = folder_of(walk, tmp_path / "many")
    path, listed = replay_source.parse_paths([there / "007.png", there / "003.png", there / "../many/011.png"])
    assert path == there and listed == ("007.png", "003.png", "011.png")
    given = load_source(Request(path, listed=listed))
    assert [frame.name for frame in given.frames] == ["003.png", "007.png", "011.png"] and given.choice is None
    assert given.photographs == there and not given.files()
    assert [frame.name for frame in load_source(Request(path, views=2, listed=listed)).frames] == ["007.png", "011.png"]
    assert replay_source.parse_paths([there / "000.png"]) == (there, ("000.png",))
    every = tuple(f"{i:03d}.png" for i in range(replay_source.ALL + 1))
    chosen = load_source(Request(there, listed=every))
    assert chosen.choice is not None and chosen.choice.examined == len(every)


def test_a_folder_a_recording_and_a_video_stand_alone(film, tmp_path):
    for path in (tmp_path, film):
        assert replay_source.parse_paths([path]) == (path, ())
    for name in ("a.jpg", "b.jpg", "other/a.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(ValueError, match="is a folder; give one folder alone"):
        replay_source.parse_paths([tmp_path / "a.jpg", tmp_path / "other"])
    with pytest.raises(FileNotFoundError, match="c.jpg' is not there"):
        replay_source.parse_paths([tmp_path / "a.jpg", tmp_path / "c.jpg"])
    with pytest.raises(ValueError, match="a.jpg' lies in another folder than"):
        replay_source.parse_paths([tmp_path / "b.jpg", tmp_path / "other" / "a.jpg"])
    with pytest.raises(ValueError, match="no photograph named notes.txt"):
        (tmp_path / "notes.txt").touch()
        path, listed = replay_source.parse_paths([tmp_path / "a.jpg", tmp_path / "notes.txt"])
        load_source(Request(path, listed=listed))
    with pytest.raises(ValueError, match="they are listed already, so leave it out"):
        load_source(Request(tmp_path, frames=("a",), listed=("a.jpg", "b.jpg")))


def test_a_lens_is_of_all_photographs_or_refused(walk, tmp_path):
    folder = folder_of(walk[:3], tmp_path / "few")
    height, width = walk[0].shape[:2]
    lens = Intrinsics(2 * width, 2 * height, 900, 900, width, height, "calibration", (0.1,), "fisheye")
    given = load_source(Request(folder, lenses=Lenses({ALL: lens}))).frames
    of_map = load_recording(Request(folder, lenses=Lenses({ALL: lens})))
    for frames in (given, of_map.frames()):
        known = {frame.intrinsics for frame in frames if isinstance(frame, Frame)}
        assert known == {lens.resized(width, height)}
    assert of_map.identity(ReconstructionConfig()) != load_recording(Request(folder)).identity(ReconstructionConfig())
    for read in (load_source, load_recording):
        with pytest.raises(ValueError, match="photographs' aspect ratio, got those of 500 x 100"):
            read(Request(folder, lenses=Lenses({ALL: replace(lens, width=500, height=100)})))


def test_each_camera_gets_its_lens(walk, tmp_path):
    folder = folder_of(walk[:4], tmp_path / "few")
    height, width = walk[0].shape[:2]
    one = Intrinsics(width, height, 300, 300, width / 2, height / 2, "calibration")
    other = replace(one, fx=400, fy=400)
    first, *_, last = sorted(path.name for path in folder.iterdir())
    given = Request(folder, lenses=Lenses({first: one, "*.png": other}))
    for frames in (load_source(given).frames, load_recording(given).frames()):
        known = {frame.name: (frame.intrinsics, frame.camera) for frame in frames if isinstance(frame, Frame)}
        assert known[first] == (one, first) and (last not in known or known[last] == (other, "*.png"))
    for read in (load_source, load_recording):
        with pytest.raises(ValueError, match=r"a lens of 'left', which is no photograph's: they are called 000"):
            read(Request(folder, lenses=Lenses({"left": one, "*": other})))


def test_files_of_a_recording_are_its_frames(tmp_path):
    """As a glob of the folder gives them: frames have their recorded names, right images go with theirs."""
    rng, folder = np.random.default_rng(0), tmp_path / "recording"
    images = [rng.integers(0, 255, (144, 192, 3), np.uint8) for _ in range(3)]
    with Recorder(folder) as recorder:
        for index, image in enumerate(images):  # names that are those of other frames' files
            right = RightImage(np.ascontiguousarray(image[..., 0]), Baseline(0.1))
            recorder.write(Frame(index, f"00000{2 - index}.png", index * 10**9, image, None, right=right))
    files = sorted(folder.glob("*.png"))
    assert len(files) == 6
    path, listed, cameras = parse_sources(files[2:])
    found = load_source(Request(path, listed, cameras=cameras))
    assert [each.name for each in found.frames] == ["000001.png", "000000.png"]
    last = found.frames[1]
    assert isinstance(last, Frame) and np.array_equal(last.image, images[2]) and last.right is not None
    assert names_of(files) == ["000002.png", "000001.png", "000000.png"]
    (folder / "stray.png").write_bytes(files[0].read_bytes())
    with pytest.raises(ValueError, match="'stray.png' is no image of the recording"):
        parse_sources([folder / "stray.png"])
