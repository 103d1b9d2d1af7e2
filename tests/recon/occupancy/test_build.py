"""A map of a known room: what is called free is free, what is called occupied is there, the rest is not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.recon.metric.metres import transform_rigidly
from splatnode.recon.occupancy import (
    DepthObservation,
    NoMap,
    OccupancyMap,
    VoxelState,
    mask_narrow_parallax,
    occupancy_map,
)
from splatnode.recon.occupancy.files import encode_nav2
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import Code, FrameName, ReferenceFrame, Scale
from tests.support.exported import make_snapshot
from tests.support.occupied import WALL, room_snapshot


@pytest.fixture(scope="module")
def room() -> Snapshot:
    return room_snapshot()


@pytest.fixture(scope="module")
def made(room) -> OccupancyMap:
    return occupancy_map(room)


def corners(made: OccupancyMap, state: VoxelState) -> np.ndarray:
    """(M, 8, 3) the corners of the voxels in a state, in the world."""
    index = np.argwhere(made.states == state)
    steps = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(-1, 3)
    T = made.T_world_map
    return (made.origin + (index[:, None] + steps) * made.voxel) @ T[:3, :3].T + T[:3, 3]


def test_what_is_free_lies_before_wall_and_above_floor_whole(made):
    free = corners(made, VoxelState.FREE)
    assert len(free) > 1000
    assert free[..., 0].max() < WALL and free[..., 2].min() > 0


def test_what_is_occupied_is_at_a_surface(made):
    occupied = corners(made, VoxelState.OCCUPIED)
    off = np.minimum(np.abs(occupied[..., 0] - WALL).min(1), np.abs(occupied[..., 2]).min(1))
    assert len(occupied) > 300 and off.max() < 0.05


def test_surfaces_that_are_seen_are_found(made, room):
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(0.9, 1.9, 200), rng.uniform(-0.3, 0.3, 200), np.zeros(200)])
    wall = np.column_stack([np.full(200, WALL), rng.uniform(-0.3, 0.3, 200), rng.uniform(0.1, 0.6, 200)])
    assert (made.at(np.concatenate([floor, wall])) == VoxelState.OCCUPIED).mean() > 0.98


def test_behind_the_wall_and_outside_the_map_nothing_is_known(made):
    assert (made.at([[WALL + 0.2, 0, 0.5], [50.0, 0, 0], [np.nan, 0, 0]]) == VoxelState.NOT_SEEN).all()
    with pytest.raises(ValueError, match=r"points must be \(M, 3\)"):
        made.at([0.0, 0, 0])


def test_the_floor_is_zero_and_up_is_its_normal(made):
    assert made.upright.on_floor and "floor" in made.upright.source
    assert np.allclose(made.T_world_map[:3, 2], [0, 0, 1], atol=2e-3)
    assert abs(made.T_world_map[2, 3]) < 5e-3 and np.allclose(made.T_world_map[:2, 3], [0, -0.6], atol=5e-3)


def test_what_is_filled_in_frees_nothing(room, made):
    """Pixels without a confirmed depth, as a plain wall's, tell nothing, whatever Gaussians a scene has there."""
    holes = {name: depth.copy() for name, depth in room.depths.items()}
    for depth in holes.values():
        depth[:, :64] = 0
    fewer = occupancy_map(replace(room, depths=holes))
    assert (fewer.states == VoxelState.FREE).sum() < 0.75 * (made.states == VoxelState.FREE).sum()
    points = np.random.default_rng(1).uniform((0, -1, 0), (WALL, 1, 1), (20000, 3))
    for camera in room.cameras:
        x, _, z = ((points - camera.T_world_camera[:3, 3]) @ camera.T_world_camera[:3, :3]).T
        points = points[(z < 0) | (x * camera.K[0, 0] / z < 0)]  # in the left half of its picture, or not in it
    assert len(points) > 1000
    assert (made.at(points) == VoxelState.FREE).sum() > 500 and not (fewer.at(points) == VoxelState.FREE).any()


def test_a_wider_claim_frees_less(room, made):
    bounds = make_snapshot().cameras[0].bounds
    wide = replace(room, cameras=tuple(replace(camera, bounds=bounds) for camera in room.cameras))
    assert (occupancy_map(wide).states == VoxelState.FREE).sum() < (made.states == VoxelState.FREE).sum()


def test_voxels_of_a_metric_scene_are_round(room):
    metric = replace(room, scale=Scale(True, "a baseline", (0.99, 1.01)))
    assert occupancy_map(metric).voxel in (0.01, 0.02, 0.05)
    assert occupancy_map(metric, voxel=0.04).voxel == 0.04


def test_up_may_be_given(room):
    up = np.array([0.02, 0.0, 1.0])
    given = occupancy_map(room, up=up)
    assert given.upright.source == "given" and np.allclose(given.T_world_map[:3, 2], up / np.linalg.norm(up))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"verdict": make_snapshot(Code.NO_PARALLAX, False).verdict}, "refused: NO_PARALLAX"),
        ({"verdict": make_snapshot(Code.OK_ROUGH).verdict}, "OK_ROUGH"),
        ({"depths": {}}, "no depth.npz"),
        ({"depths": {"0.png": np.zeros((96, 128), np.float16)}}, "next to no depth"),
    ],
)
def test_where_nothing_is_sure_there_is_no_map(room, changed, said):
    with pytest.raises(NoMap, match=said) as raised:
        occupancy_map(replace(room, **changed))
    assert raised.value.exit_code == 65


@pytest.mark.parametrize("shape", [(96, 127), (384, 512), (1, 300)])
def test_depths_of_other_photographs_are_told(room, shape):
    depths = {"1.png": np.ones(shape, np.float16)}
    with pytest.raises(ValueError, match=r"the depth of 1.png has .* not of these cameras"):
        occupancy_map(replace(room, depths=depths))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"voxel": 0.0}, "side above 0"),
        ({"voxel": 1e-5}, "give a voxel of at least"),
        ({"up": np.zeros(3)}, "direction"),
        ({"up": np.ones(2)}, "direction"),
    ],
)
def test_what_cannot_be_used_is_told(room, arguments, said):
    with pytest.raises(ValueError, match=said):
        occupancy_map(room, **arguments)


@pytest.mark.parametrize("name", [FrameName.BASE, FrameName.ODOMETRY, FrameName.UPRIGHT])
def test_a_map_has_the_x_and_y_of_a_frame_whose_z_is_up(room, name):
    lowered = np.eye(4)
    lowered[:3, 3] = [5.0, -2.0, -0.4]  # the frame's origin is .4 above the floor
    moved = transform_rigidly(room, lowered)
    found = occupancy_map(replace(moved, scale=Scale(True, "a marker", None, ReferenceFrame(name))))
    np.testing.assert_allclose(found.T_world_map[:2, :4], np.eye(4)[:2], atol=1e-12)
    np.testing.assert_allclose(found.T_world_map[2], [0, 0, 1, -0.4], atol=0.01)
    assert found.upright.is_of_result and found.upright.on_floor and name.value in found.upright.source
    free = corners(found, VoxelState.FREE)
    assert free[..., 0].max() < WALL + 5.0 and free[..., 2].min() > -0.41
    assert b"x and y are of the result's frame" in encode_nav2(found, (0.3, 0.6))["map.yaml"]


def test_poses_in_a_world_whose_z_is_not_up_give_a_map_no_axes(room):
    tilted = np.eye(4)
    tilted[:3, :3] = Rotation.from_euler("x", 90, degrees=True).as_matrix()  # y is down, as of a tracker
    moved = transform_rigidly(room, tilted)
    frame = ReferenceFrame(FrameName.ODOMETRY)
    found = occupancy_map(replace(moved, scale=Scale(True, "poses", None, frame)))
    np.testing.assert_allclose(found.T_world_map[:3, 2], tilted[:3, 2], atol=0.01)
    assert not found.upright.is_of_result and "the floor" in found.upright.source
    first = occupancy_map(replace(room, scale=Scale(True, "a marker")))
    assert not first.upright.is_of_result  # the first camera's frame has none
    assert b"x is forward of the first camera" in encode_nav2(first, (0.3, 0.6))["map.yaml"]


def _observe(depth: float, at: float) -> DepthObservation:
    """A wall that a camera `at` metres aside sees, 150 pixels of focal length at half the photograph's size."""
    K, T = np.array([[150.0, 0, 60], [0, 150.0, 45], [0, 0, 1]]), np.eye(4)
    T[0, 3] = at
    return DepthObservation(T, K, np.full((90, 120), depth, np.float32))


def test_stereo_from_nearly_one_place_tells_no_free_space_until_a_third_image_confirms_it():
    """2 % of the depth are half a pixel of the photograph at 4.8 degrees: 0.25 m aside of 3 m."""
    near, far = _observe(3.0, 0.1), _observe(3.0, 0.4)
    alone = _observe(3.0, 0.0)
    assert not mask_narrow_parallax([alone, near])[0].carves.any()
    assert mask_narrow_parallax([alone, far])[0].carves[:, 30:].all()
    assert mask_narrow_parallax([alone, near, _observe(3.0, -0.1)])[0].carves[10:-10, 10:-10].all()
    assert not mask_narrow_parallax([alone, _observe(3.2, 0.4)])[0].carves.any(), "it sees something else"
