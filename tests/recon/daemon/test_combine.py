"""One map of several scenes: in one frame and unit, occupied where any says so, and free only where it is safe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon.daemon.free_space import PlacedMap, combine_maps
from splatnode.recon.occupancy import OccupancyMap, Upright, VoxelState, occupancy_map
from splatnode.recon.result.placement import IDENTITY, Placement
from splatnode.recon.result.snapshot import Snapshot
from tests.support.occupied import WALL, room_snapshot, small_map

ROTATION = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
ELSEWHERE = Placement(2.5, ROTATION, np.array([3.0, -1.0, 0.5]))


def in_other_world(snapshot: Snapshot, by: Placement) -> Snapshot:
    cameras = tuple(map(by.transform_camera, snapshot.cameras))
    depths = {name: (by.scale * depth).astype(np.float16) for name, depth in snapshot.depths.items()}
    return replace(snapshot, cameras=cameras, depths=depths)


def free_points(made: OccupancyMap) -> np.ndarray:
    """(M, 3) in the world."""
    T = made.T_world_map
    return (made.origin + (np.argwhere(made.states == VoxelState.FREE) + 0.5) * made.voxel) @ T[:3, :3].T + T[:3, 3]


def test_two_scenes_of_one_room_give_its_free_space_in_one_frame():
    room = room_snapshot()
    one = occupancy_map(room, 0.05)
    other = occupancy_map(in_other_world(room, ELSEWHERE.inverse()), 0.05 / ELSEWHERE.scale)
    both = combine_maps([PlacedMap(one, IDENTITY), PlacedMap(other, ELSEWHERE)])
    assert both.voxel == pytest.approx(0.05) and np.allclose(both.T_world_map, one.T_world_map)
    points = free_points(both)
    assert len(points) > 0.5 * (one.states == VoxelState.FREE).sum()
    assert points[:, 0].max() < WALL and points[:, 2].min() > 0.0  # before the wall, above the floor
    assert set(one.at(points).tolist()) <= {VoxelState.FREE, VoxelState.NOT_SEEN}
    again = combine_maps([PlacedMap(other, ELSEWHERE), PlacedMap(one, IDENTITY)])  # in the frame of the first
    assert np.allclose(again.T_world_map[:3, :3], ROTATION @ other.T_world_map[:3, :3])
    assert abs(len(free_points(again)) / len(points) - 1) < 0.2


def test_a_voxel_that_scenes_disagree_on_is_occupied_and_what_lies_beside_the_unknown_is_not_free():
    free = small_map(np.full((6, 6, 6), VoxelState.FREE), voxel=0.25, first=(0, 0, 0))
    wall = np.zeros((6, 6, 6), np.uint8)
    wall[3, 3, 3] = VoxelState.OCCUPIED
    made = combine_maps([PlacedMap(free, IDENTITY), PlacedMap(small_map(wall, 0.25, (0, 0, 0)), IDENTITY)])
    assert made.at([[0.875, 0.875, 0.875]]).tolist() == [VoxelState.OCCUPIED]
    assert made.at([[0.4, 0.4, 0.4]]).tolist() == [VoxelState.FREE]
    assert made.at([[0.1, 0.1, 0.1]]).tolist() == [VoxelState.NOT_SEEN]  # its neighbours are not known
    alone = combine_maps([PlacedMap(free, IDENTITY)])
    assert (alone.states == VoxelState.FREE).sum() == 4**3 and not (alone.states == VoxelState.OCCUPIED).any()


def test_a_surface_stays_a_surface_wherever_the_voxels_of_all_lie():
    rng = np.random.default_rng(0)
    wall = np.zeros((8, 8, 8), np.uint8)
    wall[:, :, 4] = VoxelState.OCCUPIED
    for _ in range(5):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        placement = Placement(float(rng.uniform(0.5, 2)), q * np.sign(np.linalg.det(q)), rng.normal(size=3))
        part = PlacedMap(small_map(wall, 0.25, (0, 0, 0)), placement)
        made = combine_maps([PlacedMap(small_map(np.full((2, 2, 2), 1), part.voxel, (0, 0, 0)), IDENTITY), part])
        points = part.transform_to_all(np.stack([*rng.uniform(0.0, 2.0, (2, 500)), rng.uniform(1.0, 1.25, 500)], 1))
        found = made.at(points)
        assert (found == VoxelState.OCCUPIED).mean() > 0.98 and not (found == VoxelState.FREE).any()


def test_far_scenes_get_larger_voxels_rather_than_too_many(monkeypatch):
    monkeypatch.setattr("splatnode.recon.daemon.free_space.MOST_VOXELS", 10_000)
    near = small_map(np.full((4, 4, 4), 1), 0.25, (0, 0, 0))
    far = PlacedMap(near, Placement(1.0, np.eye(3), np.array([50.0, 0.0, 0.0])))
    made = combine_maps([PlacedMap(near, IDENTITY), far])
    assert made.voxel > 0.25 and made.states.size <= 10_000
    with pytest.raises(ValueError, match="at least one, got none"):
        combine_maps([])


def test_a_part_is_added_to_what_was_combined_before_and_opens_no_wall():
    wall = np.full((6, 6, 6), VoxelState.FREE, np.uint8)
    wall[:, :, 5] = VoxelState.OCCUPIED
    base = combine_maps([PlacedMap(small_map(wall, 0.25, (0, 0, 0)), IDENTITY)])
    beside = Placement(1.0, np.eye(3), np.array([0.5, 0.0, 0.75]))  # which calls the wall free
    part = PlacedMap(small_map(np.full((6, 6, 6), VoxelState.FREE), 0.25, (0, 0, 0)), beside)
    made = combine_maps([part], base=base)
    T = base.T_world_map
    known = (base.origin + (np.argwhere(base.states) + 0.5) * base.voxel) @ T[:3, :3].T + T[:3, 3]
    assert np.array_equal(made.at(known), base.at(known)) and np.array_equal(made.T_world_map, T)
    assert made.at([[1.1, 0.6, 1.9]]).tolist() == [VoxelState.FREE] and base.at([[1.1, 0.6, 1.9]]).tolist() == [0]
    far = PlacedMap(part.occupancy, Placement(1.0, np.eye(3), np.array([1e4, 1e4, 0.0])))
    with pytest.raises(ValueError, match="choose a larger voxel"):
        combine_maps([far], base=base)


def test_a_part_that_knows_nothing_adds_nothing():
    nothing = OccupancyMap(np.zeros((2, 2, 2), np.uint8), 0.25, np.zeros(3), Upright(np.eye(4), "", False))
    made = combine_maps([PlacedMap(nothing, IDENTITY)])
    assert not made.states.any()
