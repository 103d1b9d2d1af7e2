"""The file of each map's free space: it follows the index of places, and is removed when its map is no more."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import replace as changed

import numpy as np
import pytest
from msgspec.structs import replace

from splatnode.capture.process.terminal import Problems
from splatnode.recon.daemon import free_space
from splatnode.recon.daemon.free_space import (
    FOLDER,
    GrowingScene,
    OccupancyConfig,
    ProvisionalMap,
    WholeMapper,
    find_shared_placement,
)
from splatnode.recon.occupancy import OccupancyMap, Upright, VoxelState, occupancy_map
from splatnode.recon.occupancy.files import read_to_map
from splatnode.recon.result.export.limits import SceneFileError
from splatnode.recon.result.submap_index import FILE, read_map_set
from splatnode.recon.result.verdict import Code
from tests.recon.daemon.test_daemon import PATIENCE_S, config, finished, peer, running  # noqa: F401
from tests.support.synthetic import photographs
from tests.support.walk import SECOND, write_walk

AHEAD = np.array([[0.6, 0.0, 0.5], [2.4, 0.0, 0.6]])  # between the wall and the cameras: of the first scene, the second
ON_WALL = AHEAD * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]


def mapper(out, problems: Problems | None = None) -> WholeMapper:
    return WholeMapper(out, 0.05, problems or Problems(), threading.Event())


def read(path) -> tuple[OccupancyMap, list[str]]:
    with np.load(path, allow_pickle=False) as file:
        frame = Upright(file["T_world_map"], str(file["up"]), False)
        return OccupancyMap(file["states"], float(file["voxel"]), file["origin"], frame), file["scenes"].tolist()


def change_index(out, change) -> None:
    index = json.loads((out / FILE).read_text())
    change(index)
    (out / FILE).write_text(json.dumps(index, indent=1) + "\n\n")


def test_all_final_scenes_of_a_map_come_in_one_frame(tmp_path):
    out = write_walk(tmp_path / "out")
    kept = mapper(out)
    assert kept.update() and not kept.update()  # nothing has changed since
    (path,) = (out / FOLDER).iterdir()
    found, scenes = read(path)
    assert path.name == "scene-0001.npz" and scenes == ["scene-0001", "scene-0002"]
    assert found.at(AHEAD).tolist() == [VoxelState.FREE] * 2
    assert found.at(ON_WALL).tolist() == [VoxelState.OCCUPIED] * 2
    behind = AHEAD * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.3]
    assert found.at(behind).tolist() == [VoxelState.NOT_SEEN] * 2


def test_a_rough_scene_and_one_that_is_not_final_add_nothing(tmp_path):
    out = write_walk(tmp_path / "out", second=Code.OK_ROUGH)
    mapper(out).update()
    found, scenes = read(out / FOLDER / "scene-0001.npz")
    assert scenes == ["scene-0001"] and found.at(AHEAD).tolist() == [VoxelState.FREE, VoxelState.NOT_SEEN]
    change_index(out, lambda index: index["places"][0].update(provisional=True))
    mapper(out).update()  # of a process that was started later
    assert not list((out / FOLDER).iterdir())


def test_a_scene_that_is_taken_back_leaves_the_file_and_the_last_one_takes_it_along(tmp_path):
    out = write_walk(tmp_path / "out")
    kept = mapper(out)
    kept.update()
    change_index(out, lambda index: index["places"][1].update(provisional=True, publishable=False))
    assert kept.update()
    assert read(out / FOLDER / "scene-0001.npz")[1] == ["scene-0001"]
    change_index(out, lambda index: index["places"][0].update(provisional=True))
    assert kept.update() and not list((out / FOLDER).iterdir())


def test_scenes_are_mapped_once_and_moved_when_a_link_moves_them(tmp_path, monkeypatch):
    out, mapped = write_walk(tmp_path / "out"), []
    whole = free_space.occupancy_map
    monkeypatch.setattr(free_space, "occupancy_map", lambda *rest, **more: mapped.append(0) or whole(*rest, **more))
    kept = mapper(out)
    kept.update()
    before = (out / FOLDER / "scene-0001.npz").read_bytes()

    def shift(index) -> None:
        (pose,) = [each for each in index["poses"] if each["scene"] == "scene-0002"]
        pose["translation"][0] += 0.5

    change_index(out, shift)
    kept.update()
    assert len(mapped) == 2 and (out / FOLDER / "scene-0001.npz").read_bytes() != before


def test_a_damaged_index_is_a_problem_and_is_looked_at_again(tmp_path, monkeypatch):
    out, problems = write_walk(tmp_path / "out"), Problems()
    index = (out / FILE).read_bytes()
    (out / FILE).write_bytes(b"{")
    with pytest.raises(SceneFileError):
        mapper(out).update()
    assert not mapper(tmp_path / "nothing").update()
    monkeypatch.setattr(free_space, "LOOK_S", 0.01)
    monkeypatch.setattr(free_space, "AGAIN_S", 0.01)
    stopping = threading.Event()
    thread = threading.Thread(target=WholeMapper(out, 0.05, problems, stopping).run)
    thread.start()
    try:
        deadline = time.monotonic() + 20.0
        while not str(problems) and time.monotonic() < deadline:
            time.sleep(0.01)
        (out / FILE).write_bytes(index)
        while not (out / FOLDER / "scene-0001.npz").exists() and time.monotonic() < deadline:
            time.sleep(0.01)
    finally:
        stopping.set()
        thread.join()
    assert "could not be written" in str(problems) and (out / FOLDER / "scene-0001.npz").exists()


def test_a_scene_that_grows_is_added_marked_and_taken_out_with_its_world(tmp_path, monkeypatch):
    """It goes on from the first scene, which is final, and is the second one, which is not yet."""
    out = write_walk(tmp_path / "out")
    monkeypatch.setattr(free_space, "find_shared_placement", lambda *_: SECOND)
    monkeypatch.setattr(free_space, "GROWING_EVERY_S", 0.0)
    snapshot = read_to_map(out / "scene-0002")
    scene = GrowingScene(snapshot, "scene-0002", 7, 1, {}, 0.0)
    made = ProvisionalMap(scene, occupancy_map(snapshot, 0.05))

    def leave_second(index) -> None:
        index["places"][1].update(provisional=True)
        index["poses"] = [each for each in index["poses"] if each["scene"] == "scene-0001"]

    change_index(out, leave_second)
    kept = WholeMapper(out, 0.05, Problems(), threading.Event(), lambda: made)
    assert not kept.update_growing(made)  # there is no final scene yet
    kept.update()
    path = out / FOLDER / "scene-0001.npz"
    assert read(path)[0].at(AHEAD).tolist() == [VoxelState.FREE, VoxelState.NOT_SEEN]
    assert kept.update_growing(made) and not kept.update_growing(made)
    found, scenes = read(path)
    assert found.at(AHEAD).tolist() == [VoxelState.FREE] * 2 and scenes == ["scene-0001"]
    assert found.at(ON_WALL).tolist() == [VoxelState.OCCUPIED] * 2
    with np.load(path) as file:
        assert str(file["growing"]) == "scene-0002"
        told = replace_states(found, file["provisional"])
    assert told.at(AHEAD).tolist() == [0, 1]
    kept.update_growing(None)  # its world is withdrawn
    with np.load(path) as file:
        assert str(file["growing"]) == "" and "provisional" not in file
    assert read(path)[0].at(AHEAD).tolist() == [VoxelState.FREE, VoxelState.NOT_SEEN]


def replace_states(made: OccupancyMap, states: np.ndarray) -> OccupancyMap:
    return OccupancyMap(states.astype(np.uint8), made.voxel, made.origin, made.upright)


def test_a_scene_that_shares_too_little_or_lies_otherwise_is_added_to_no_map(tmp_path):
    out = write_walk(tmp_path / "out")
    found, cameras = read_map_set(out), read_to_map(out / "scene-0001").cameras
    (joined,) = found.maps
    placement = find_shared_placement(cameras, found, joined)
    assert placement is not None and placement.scale == pytest.approx(1.0)
    assert find_shared_placement(cameras[:2], found, joined) is None
    T = cameras[0].T_world_camera.copy()
    T[:3, 3] += 0.5
    bent = [changed(cameras[0], T_world_camera=T), *cameras[1:]]
    assert find_shared_placement(bent, found, joined) is None


def test_a_node_keeps_the_file_of_its_map(config, peer):  # noqa: F811
    with running(replace(config, occupancy=OccupancyConfig(maps=True))):
        for frame in photographs()[:3]:
            peer.server.offer(frame)
        peer.wait(finished(3), "a final scene")
        path, deadline = config.out / FOLDER / "scene-0001.npz", time.monotonic() + PATIENCE_S
        while not path.exists():
            assert time.monotonic() < deadline
            peer.server.serve(0.05)
    found, scenes = read(path)
    assert scenes == ["scene-0001"] and found.shares["free"] > 0.01
