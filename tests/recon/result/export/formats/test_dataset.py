"""A data set for trainers: its cameras are those of the photographs that lie beside them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode import command_line
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.image_file import decode_image, encode_png
from splatnode.capture.lenses import project, undistort_frame
from splatnode.recon.pipeline import _add_given_lenses
from tests.support.exported import make_snapshot, write

WIDTH, HEIGHT = 1024, 768
RAYS = np.array([[-0.4, -0.3, 1.0], [0.35, 0.2, 1.0], [0.0, 0.25, 1.0]])
LENS = Intrinsics(WIDTH, HEIGHT, 800.0, 800.0, 520.0, 380.0, "estimated", (-0.15, 0.03))


def photograph(lens: Intrinsics) -> np.ndarray:
    """Black, with a white spot for each ray."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for x, y in project(RAYS, lens):
        cv2.circle(image, (round(16 * (x - 0.5)), round(16 * (y - 0.5))), 16 * 5, (255, 255, 255), -1, cv2.LINE_AA, 4)
    return image


def spots(image: np.ndarray) -> np.ndarray:
    """(3, 2) pixels of the middles of the spots, from the top."""
    found = cv2.connectedComponentsWithStats((image[..., 0] > 127).astype(np.uint8))[3][1:] + 0.5
    return found[np.argsort(found[:, 1])]


def result(folder: Path, names: tuple[str, str]) -> Path:
    """A result whose first photograph bends lines and whose second does not; both were modelled at half their size."""
    straight = replace(LENS, distortion=())
    cameras = []
    for name, camera, lens in zip(names, make_snapshot().cameras, (LENS, straight), strict=True):
        (folder / "images").mkdir(exist_ok=True, parents=True)
        (folder / "images" / name).write_bytes(encode_png(photograph(lens)))
        pinhole = undistort_frame(Frame(0, name, 0, photograph(lens), lens)).intrinsics
        assert pinhole is not None
        K = pinhole.resized(camera.width, camera.height).K
        cameras.append(replace(camera, name=name, K=K, lens=lens if lens is LENS else None))
    write(replace(make_snapshot(), cameras=tuple(cameras)), folder)
    return folder


@pytest.mark.parametrize("names", [("a.png", "b.jpg"), ("a b.png", "c.webp")])
def test_points_are_where_the_cameras_see_them(tmp_path, names):
    folder = result(tmp_path / "out", names)
    assert command_line.main(["export", str(folder), "--to", "dataset"]) == 0
    frames = json.loads((folder / "dataset" / "transforms.json").read_text())["frames"]
    kept = [name if name.endswith(("png", "jpg")) else f"{name}.png" for name in names]
    assert [frame["file_path"] for frame in frames] == [f"images/{name}" for name in kept]
    for frame in frames:
        image = decode_image((folder / "dataset" / frame["file_path"]).read_bytes())[0]
        assert (frame["w"], frame["h"]) == (WIDTH, HEIGHT) == image.shape[1::-1]
        seen = RAYS[:, :2] * [frame["fl_x"], frame["fl_y"]] + [frame["cx"], frame["cy"]]
        assert np.abs(spots(image) - seen[np.argsort(seen[:, 1])]).max() < 0.3  # bent ones are up to 20 pixels off


def test_colmap_reads_it(tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap reads COLMAP models (the extra bench)")
    folder = result(tmp_path, ("a.png", "b.jpg"))
    assert command_line.main(["export", str(folder), "--to", "dataset"]) == 0
    model = pycolmap.Reconstruction(folder / "dataset" / "sparse" / "0")
    assert {(camera.width, camera.height) for camera in model.cameras.values()} == {(WIDTH, HEIGHT)}
    assert len(model.points3D) == len(make_snapshot().gaussians)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda path: path.unlink(), "the photograph a.png is not in "),
        (lambda path: path.write_bytes(path.read_bytes()[:500]), "a.png: "),
        (lambda path: path.write_bytes(encode_png(np.zeros((90, 60, 3), np.uint8))), "it is another one"),
    ],
    ids=["gone", "damaged", "another"],
)
def test_without_its_photographs_there_is_none(tmp_path, capsys, damage, said):
    folder = result(tmp_path, ("a.png", "b.jpg"))
    damage(folder / "images" / "a.png")
    assert command_line.main(["export", str(folder), "--to", "dataset"]) != 0
    told = capsys.readouterr().err
    assert said in told and told.count("\n") == 1 and not (folder / "dataset").exists()


def test_nerfstudio_finds_the_points(tmp_path):
    """Where nerfstudio looks, in the world of its cameras; Open3D, by which it reads, takes these properties."""
    folder = result(tmp_path, ("a.png", "b.jpg"))
    assert command_line.main(["export", str(folder), "--to", "dataset"]) == 0
    content = json.loads((folder / "dataset" / "transforms.json").read_text())
    assert content["ply_file_path"] == "sparse_pc.ply"
    data = (folder / "dataset" / content["ply_file_path"]).read_bytes()
    head, _, body = data.partition(b"end_header\n")
    assert head.decode().splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(make_snapshot().gaussians)}",
        *(f"property float {name}" for name in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
    ]
    rows = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    model = (folder / "dataset" / "sparse" / "0" / "points3D.txt").read_text().splitlines()
    told = np.array([line.split()[1:7] for line in model if not line.startswith("#")], float)
    assert np.allclose(rows["xyz"], told[:, :3], atol=1e-5) and np.array_equal(rows["rgb"], told[:, 3:])


def test_photographs_of_several_cameras_lie_in_their_folders(tmp_path):
    folder = tmp_path / "out"
    (folder / "images" / "left").mkdir(parents=True)
    (folder / "images" / "right").mkdir()
    result(folder, ("left/1.png", "right/1.png"))
    assert command_line.main(["export", str(folder), "--to", "dataset"]) == 0
    frames = json.loads((folder / "dataset" / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == ["images/left/1.png", "images/right/1.png"]
    assert all((folder / "dataset" / frame["file_path"]).is_file() for frame in frames)


@pytest.mark.parametrize(
    "given",
    [replace(LENS, source="given"), replace(LENS, source="given", distortion=(), fy=760.0)],
    ids=["distortion", "pixels that are not square"],
)
def test_a_lens_that_was_given_is_taken_out_and_told(tmp_path, given):
    """cameras.json has K of the picture as it was modelled; the two focal lengths that were given stay two numbers."""
    folder = tmp_path / "out"
    (folder / "images").mkdir(parents=True)
    (folder / "images" / "a.png").write_bytes(encode_png(photograph(given)))
    frame = Frame(0, "a.png", 0, photograph(given), given)
    camera, *_ = make_snapshot().cameras
    pinhole = undistort_frame(frame).intrinsics.resized(camera.width, camera.height)
    snapshot = replace(make_snapshot(), cameras=(replace(camera, name="a.png", K=pinhole.K),))
    write(_add_given_lenses(snapshot, [frame]), folder)
    told = json.loads((folder / "cameras.json").read_text())["cameras"][0]
    assert (told["given_lens"]["fx"], told["given_lens"]["fy"]) == (given.fx, given.fy) and told["lens"] is None
    assert command_line.main(["export", str(folder), "--to", "dataset"]) == 0
    (shown,) = json.loads((folder / "dataset" / "transforms.json").read_text())["frames"]
    image = decode_image((folder / "dataset" / shown["file_path"]).read_bytes())[0]
    seen = RAYS[:, :2] * [shown["fl_x"], shown["fl_y"]] + [shown["cx"], shown["cy"]]
    assert np.abs(spots(image) - seen[np.argsort(seen[:, 1])]).max() < 0.3
