"""Which views train and which test, for every layout of folder that data sets come in."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode.extras.evaluate.dataset import EvaluationFileError, Split, load_scene, load_split, make_paper_split
from splatnode.recon.result.export.formats.colmap import encode_colmap
from splatnode.recon.result.export.formats.nerfstudio import encode_nerfstudio
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays

NAMES = tuple(f"{i:02d}.png" for i in range(8))


def test_paper_split_of_24_frames():
    names = [str(i) for i in range(24)]
    assert make_paper_split(names, 3).train == ("0", "11", "23")
    assert make_paper_split(names, 6).train == ("0", "5", "9", "13", "17", "23")
    assert make_paper_split(names, 12).train == ("0", "3", "5", "7", "9", "11", "13", "15", "17", "19", "21", "23")
    assert make_paper_split(names, 3).test == ("1", "2", "4", "6", "8", "10", "12", "14", "16", "18", "20", "22")


@pytest.mark.parametrize("count", [6, 11, 23, 30, 100])
def test_no_image_both_trains_and_tests(count):
    names = [f"{i:03d}" for i in range(count)]
    split = make_paper_split(names, 3)
    assert len(set(split.train)) == 3 and not set(split.train) & set(split.test)
    assert len(split.test) == min(12, count // 2)
    assert split.train[0] == names[0] and split.train[-1] == names[-1]


def test_more_views_than_there_are_is_a_clear_error():
    with pytest.raises(ValueError, match="views must be 1 to 5 for 10 images, got 6"):
        make_paper_split([str(i) for i in range(10)], 6)


def test_listed_split_wins_over_the_paper_s(tmp_path):
    (tmp_path / "splits.json").write_text(json.dumps({"garden": {"train3": NAMES[:3], "test": NAMES[3:5]}}))
    assert load_split(tmp_path / "garden", NAMES, 3) == Split(NAMES[:3], NAMES[3:5])
    with pytest.raises(ValueError, match="must list train6 and test for garden, has"):
        load_split(tmp_path / "garden", NAMES, 6)
    assert load_split(tmp_path / "elsewhere", NAMES, 2) == make_paper_split(NAMES, 2)


@pytest.mark.parametrize(
    ("listed", "said"),
    [
        ({"train3": ["00.png", "01.png", "9.png"], "test": ["03.png"]}, r"photographs with a true camera; .*: 9\.png"),
        ({"train3": ["00.png"], "test": ["02.png", "00.png"]}, r"each photograph once; these are there twice: 00\.png"),
        ({"train3": ["00.png", "00.png"], "test": ["02.png"]}, r"each photograph once; these are there twice: 00\.png"),
    ],
)
def test_a_split_of_photographs_that_are_not_there_or_train_and_test_is_refused(listed, said, tmp_path):
    (tmp_path / "splits.json").write_text(json.dumps({"garden": listed}))
    with pytest.raises(ValueError, match=rf"splits\.json, train3 and test of garden must .*{said}"):
        load_split(tmp_path / "garden", NAMES, 3)


def test_a_scene_that_has_not_enough_photographs_is_named(tmp_path):
    with pytest.raises(ValueError, match="garden: views must be 1 to 4 for 8 images, got 6"):
        load_split(tmp_path / "garden", NAMES, 6)
    with pytest.raises(ValueError, match="garden must have photographs with a true camera"):
        load_split(tmp_path / "garden", [], 3)


def test_photographs_are_in_the_order_of_their_numbers(tmp_path):
    names = ["frame_1.png", "frame_2.png", "frame_10.png"]
    write_images(tmp_path / "images", [*names, ".hidden.png"])
    (tmp_path / "images" / "folder.png").mkdir()
    (tmp_path / "transforms.json").write_bytes(encode_nerfstudio(cameras(names)))
    assert list(load_scene(tmp_path).paths) == list(load_scene(tmp_path).cameras) == names
    (tmp_path / "transforms.json").write_bytes(encode_nerfstudio(cameras(["other.png"])))
    with pytest.raises(EvaluationFileError, match=r"no photograph in .*images has a camera in .*transforms\.json"):
        load_scene(tmp_path)


def write_images(folder: Path, names: Sequence[str]) -> None:
    folder.mkdir(parents=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((6, 8, 3), np.uint8))


def cameras(names: Sequence[str]) -> list[CameraEstimate]:
    """One for each name, side by side."""
    K = np.array([[8.0, 0, 4], [0, 8.0, 3], [0, 0, 1]])
    Ts = np.tile(np.eye(4), (len(names), 1, 1))
    Ts[:, 0, 3] = np.arange(len(names))
    return [CameraEstimate(name, i, T, K, 8, 6) for i, (name, T) in enumerate(zip(names, Ts, strict=True))]


def write_colmap(folder: Path, names: Sequence[str]) -> None:
    for name, data in encode_colmap(cameras(names), GaussianArrays.empty()).items():
        (folder / "sparse" / "0" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "sparse" / "0" / name).write_bytes(data)


PAPER_3, PAPER_TEST = (0, 11, 23), (1, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22)


@pytest.mark.parametrize("given", ["Family", "Family/24_views"])
def test_tanks_and_temples_and_mvimgnet_as_instantsplat_gives_them(tmp_path, given):
    """Both are <scene>/24_views/{images,sparse/0}; the scene's name is that of the folder above."""
    pytest.importorskip("pycolmap", reason="pycolmap reads COLMAP models (the extra bench)")
    names = [f"{7 * i:06d}.jpg" for i in range(24)]
    write_images(tmp_path / "Family" / "24_views" / "images", names)
    write_colmap(tmp_path / "Family" / "24_views", names)
    scene = load_scene(tmp_path / given)
    assert scene.name == "Family" and list(scene.cameras) == names
    split = load_split(tmp_path / given, list(scene.cameras), 3)
    assert split == Split(tuple(names[i] for i in PAPER_3), tuple(names[i] for i in PAPER_TEST))
    (tmp_path / "splits.json").write_text(json.dumps({"Family": {"train3": names[:3], "test": names[3:4]}}))
    assert load_split(tmp_path / given, names, 3).test == (names[3],)


def test_colmap_folder_is_thinned_to_24_frames_of_known_camera(tmp_path):
    pytest.importorskip("pycolmap", reason="pycolmap reads COLMAP models (the extra bench)")
    names = [f"IMG_{i:03d}.jpg" for i in range(72)]
    write_images(tmp_path / "images", names)
    write_colmap(tmp_path, names[:70])  # two images could not be placed
    scene = load_scene(tmp_path)
    assert len(scene.paths) == 72 and list(scene.cameras) == names[:70]
    split = load_split(tmp_path, list(scene.cameras), 3)
    assert split.train == (names[0], names[33], names[69])  # frames 0, 11, 23 of every third
    assert len(split.test) == 12 and split.test[:3] == (names[3], names[6], names[12])


def test_nerfstudio_folder(tmp_path):
    names = [f"frame_{i:05d}.png" for i in range(24)]
    write_images(tmp_path / "images", names)
    (tmp_path / "transforms.json").write_bytes(encode_nerfstudio(cameras(names)))
    scene = load_scene(tmp_path)
    split = load_split(tmp_path, list(scene.cameras), 12)
    assert split.test == tuple(names[i] for i in PAPER_TEST)
    assert split.train == tuple(name for name in names if name not in split.test)


def test_recorded_scenes_are_complete(shared):
    splits = json.loads((shared / "scenes" / "splits.json").read_text())
    for name in splits:
        folder = shared / "scenes" / name
        scene = load_scene(folder)
        split = load_split(folder, list(scene.paths), 3)
        assert len(split.train) == 3 and not set(split.train) & set(split.test)
        assert set(split.train + split.test) <= set(scene.cameras), f"{name} must know its cameras"
