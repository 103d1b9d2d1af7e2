"""places.json as a whole, and what a similarity does to a scene."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest
import torch

from splatnode.recon.geometry import Similarity
from splatnode.recon.result.export import SceneFileError
from splatnode.recon.result.export.stored import encode_cameras
from splatnode.recon.result.placement import Placement, compute_sh_basis, compute_sh_terms, rotate_sh
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.result.stored_snapshot import SHELL_PIECE, find_pieces, has_scene
from splatnode.recon.result.submap_index import is_map_set, read_map_set
from tests.support.exported import make_camera, make_gaussians
from tests.support.walk import SECOND, TURN, place, record, write_walk

TILTED = Placement(1.7, np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0], np.array([0.4, -2.0, 0.7]))
TILTED = Placement(1.7, TILTED.rotation * np.sign(np.linalg.det(TILTED.rotation)), TILTED.translation)


def random_gaussians(count: int, bases: int = 16) -> GaussianArrays:
    return make_gaussians(count, bases, seed=5)


def test_a_scene_looks_the_same_from_a_camera_that_moved_with_it():
    gaussians = make_gaussians(60, 16)
    T = np.eye(4)
    T[2, 3] = -8.0
    camera = CameraEstimate("a.png", 0, T, np.array([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]]), 80, 60)
    after = TILTED.transform_camera(camera)
    before_image, after_image = (
        render_arrays(scene, each.T_world_camera, each.K, 80, 60).rgb
        for scene, each in ((gaussians, camera), (TILTED.transform_gaussians(gaussians), after))
    )
    assert before_image.std() > 0.02 and np.abs(before_image - after_image).max() < 2e-3


def test_placements_are_similarities():
    as_similarity = Similarity(TILTED.scale, TILTED.rotation, TILTED.translation)
    points = np.random.default_rng(0).normal(size=(5, 3))
    assert np.allclose(TILTED.transform_points(points), as_similarity(points))
    assert np.allclose(TILTED.inverse().transform_points(TILTED.transform_points(points)), points)
    both, theirs = TILTED.after(SECOND), as_similarity.after(Similarity(SECOND.scale, TURN, SECOND.translation))
    assert np.allclose(both.transform_points(points), theirs(points))
    camera = make_camera(1)
    moved = TILTED.transform_camera(camera)
    assert np.allclose(moved.T_world_camera, as_similarity.camera(camera.T_world_camera))
    assert moved.bounds.centre == pytest.approx(1.7 * camera.bounds.centre)
    assert moved.bounds.centre_percent == camera.bounds.centre_percent
    assert np.allclose(moved.bounds.axes, 1.7 * np.array(camera.bounds.axes) @ TILTED.rotation.T)


def test_the_basis_is_orthonormal_and_turns_with_the_world():
    directions = np.random.default_rng(1).normal(size=(400_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = compute_sh_basis(directions, 16)
    assert np.allclose(4 * np.pi * found.T @ found / len(found), np.eye(16), atol=0.02)
    directions = directions[:20]
    x, y, z = torch.from_numpy(directions).unbind(1)
    torchs = torch.stack(compute_sh_terms(x, y, z, 16), 1)
    assert np.allclose(found[:20], torchs.numpy())
    sh = random_gaussians(4).sh
    seen = np.einsum("db,nbc->ndc", compute_sh_basis(directions, 16), sh)
    after = np.einsum(
        "db,nbc->ndc", compute_sh_basis(directions @ TILTED.rotation.T, 16), rotate_sh(sh, TILTED.rotation)
    )
    assert np.allclose(seen, after, atol=1e-5)
    with pytest.raises(ValueError, match="1, 4, 9 or 16"):
        rotate_sh(sh[:, :5], TILTED.rotation)


@pytest.mark.parametrize("poses", [True, False])
def test_scenes_lie_where_poses_say_or_else_where_the_links_lead(tmp_path, poses):
    whole = read_map_set(write_walk(tmp_path, poses=poses, further=(place("scene-0003"),)))
    first, alone = whole.maps
    assert first.name == "scene-0001" and list(first.placements) == ["scene-0001", "scene-0002"]
    there = first.placements["scene-0002"]
    assert np.allclose([there.scale, *there.translation], [0.5, 0.3, -0.1, 0.2]) and np.allclose(there.rotation, TURN)
    assert list(alone.placements) == ["scene-0003"] and not has_scene(whole.submaps["scene-0003"])
    (link,) = whole.links
    assert link.kind == "chain" and link.retracted is None


def test_a_link_that_was_taken_back_places_nothing(tmp_path):
    write_walk(tmp_path, poses=False)
    change(tmp_path, lambda index: index["links"][0].update(kind="loop", retracted="it does not close"))
    assert [each.name for each in read_map_set(tmp_path).maps] == ["scene-0001", "scene-0002"]


def test_a_chain_is_followed_backwards_too(tmp_path):
    write_walk(tmp_path, poses=False)
    back = SECOND.inverse()
    ends = {"scene": "scene-0002", "other": "scene-0001"}
    change(tmp_path, lambda index: index["links"][0].update(**ends, **record(back)))
    (only,) = read_map_set(tmp_path).maps
    assert np.allclose(only.placements["scene-0002"].translation, SECOND.translation)


def change(folder, how) -> None:
    path = folder / "places.json"
    index = json.loads(path.read_text())
    how(index)
    path.write_text(json.dumps(index))


HOSTILE = {
    "no rotation": lambda index: index["poses"][1].update(rotation=[[1, 0, 0], [0, 1, 0], [0, 0, 2]]),
    "a mirror": lambda index: index["links"][0].update(rotation=[[1, 0, 0], [0, 1, 0], [0, 0, -1]]),
    "no scale": lambda index: index["poses"][0].update(scale=0),
    "a folder elsewhere": lambda index: index["places"][0].update(folder="../secrets"),
    "an id elsewhere": lambda index: index["places"][0].update(scene_id="a/../../b"),
    "a terminal's command": lambda index: index["places"][0].update(message="\x1b[2J"),
    "a map elsewhere": lambda index: index["poses"][1].update(map="../../secrets"),
    "a link that rings": lambda index: index["links"][0].update(retracted="\a"),
    "no list": lambda index: index.update(places={}),
}


@pytest.mark.parametrize("how", HOSTILE.values(), ids=HOSTILE)
def test_what_is_no_index_of_places_is_refused_by_name(tmp_path, how):
    change(write_walk(tmp_path), how)
    with pytest.raises(SceneFileError, match="places.json"):
        read_map_set(tmp_path)


def test_a_folder_is_a_whole_where_places_are_listed_and_no_scene_lies_in_it(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"places\.json"):
        read_map_set(tmp_path)
    assert not is_map_set(tmp_path)
    write_walk(tmp_path)
    assert is_map_set(tmp_path) and not is_map_set(tmp_path / "scene-0001")


def test_pieces_are_the_scenes_until_all_of_them_were_merged(tmp_path):
    whole = read_map_set(write_walk(tmp_path))
    (only,) = whole.maps
    raw = find_pieces(whole, only, tmp_path)
    assert not raw.merged and [piece.scene_id for piece in raw.pieces] == ["scene-0001", "scene-0002"]
    assert [camera.name for camera in raw.cameras] == [f"{n}.png" for n in range(6)]
    folder = tmp_path / "map-scene-0001" / "pieces"
    folder.mkdir(parents=True)
    for name in ("scene-0001", SHELL_PIECE):
        (folder / f"{name}.ply").touch()
    assert not find_pieces(whole, only, tmp_path).merged  # the second scene came since
    (folder / "scene-0002.ply").touch()
    (folder.parent / "cameras.json").write_bytes(encode_cameras(raw.cameras[1:]))
    merged = find_pieces(whole, only, tmp_path)
    assert merged.merged and [camera.name for camera in merged.cameras] == [f"{n}.png" for n in range(1, 6)]
    later = (folder / "scene-0002.ply").stat().st_mtime + 10
    os.utime(tmp_path / "scene-0002" / "scene.ply", (later, later))
    assert not find_pieces(whole, only, tmp_path).merged  # it was made anew since
