"""Completion: holes are filled as the stated prior says, and nothing ever hides what another view knows."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from splatnode.recon.priors import Pointmap
from splatnode.recon.scene.background import (
    DepthCompletionConfig,
    _leave_cameras,
    complete,
    find_free_path,
    smooth_depth,
)
from tests.support.synthetic import plane_pointmap, without

WIDTH, HEIGHT = 64, 48
GREY = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)


def box(rows: slice, columns: slice) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[rows, columns] = True
    return mask


HOLE = box(slice(18, 30), slice(26, 38))


def wall(depth: float = 2.0, x: float = 0.0, confidence: float = 0.8) -> Pointmap:
    """The plane z = `depth` from a camera at (x, 0, 0) that looks along z."""
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = x
    return plane_pointmap(T_world_camera, point=(0, 0, depth), width=WIDTH, height=HEIGHT, confidence=confidence)


def slanted() -> Pointmap:
    return plane_pointmap(np.eye(4), (0.36, 0.48, -0.8), (0, 0, 2), WIDTH, HEIGHT)


def looking(T_world_camera: np.ndarray, depth: float) -> Pointmap:
    """The wall at that depth before a camera that stands anywhere."""
    return replace(wall(depth), T_world_camera=T_world_camera, frame_id=1)


def facing_each_other(distance: float) -> np.ndarray:
    """T_world_camera of a camera so far before that at the origin, and turned to it."""
    opposite = np.diag([-1.0, 1.0, -1.0, 1.0])
    opposite[2, 3] = distance
    return opposite


def move_ahead(z: float) -> np.ndarray:
    T = np.eye(4)
    T[2, 3] = z
    return T


@pytest.mark.parametrize("pointmap", [wall(), slanted()], ids=["facing", "slanted"])
def test_a_hole_in_a_plane_is_filled_on_the_plane(pointmap):
    config = DepthCompletionConfig()
    (filled,) = complete([without(pointmap, HOLE)], [GREY], config)
    np.testing.assert_allclose(filled.depth[HOLE], pointmap.depth[HOLE], rtol=0.01)
    np.testing.assert_allclose(filled.confidence[HOLE], config.confidence)
    assert np.array_equal(filled.depth[~HOLE], pointmap.depth[~HOLE])
    assert np.array_equal(filled.confidence[~HOLE], pointmap.confidence[~HOLE])
    assert np.array_equal(filled.normal[~HOLE], pointmap.normal[~HOLE])


def test_filled_pixels_have_unit_normals_that_face_the_camera():
    (filled,) = complete([without(wall(), HOLE)], [GREY], DepthCompletionConfig())
    rays = filled.points / filled.depth[..., None]
    np.testing.assert_allclose(np.linalg.norm(filled.normal[HOLE], axis=-1), 1, rtol=1e-5)
    assert ((filled.normal * rays).sum(-1)[HOLE] < 0).all()


def test_the_input_is_left_alone():
    holed = without(wall(), HOLE)
    before = holed.depth.copy()
    complete([holed], [GREY], DepthCompletionConfig())
    assert np.array_equal(holed.depth, before)


def test_depth_jumps_at_the_edge_of_the_image_not_in_the_middle_of_the_hole():
    pointmap, image = wall(), GREY.copy()
    pointmap.depth[:, 32:] = 4.0
    image[:, :32], image[:, 32:] = 20, 230
    band = box(slice(None), slice(24, 52))  # the edge, at 32, is far from its middle
    smooth = smooth_depth(without(pointmap, band), image, DepthCompletionConfig())
    np.testing.assert_allclose(smooth[:, :30], 2.0, rtol=0.05)
    np.testing.assert_allclose(smooth[:, 34:], 4.0, rtol=0.05)
    without_edge = smooth_depth(without(pointmap, band), GREY, DepthCompletionConfig())
    assert 2.2 < without_edge[24, 32] < 3.0  # inverse depth goes evenly across


def test_smooth_depth_stays_within_twice_what_is_known():
    steep = plane_pointmap(np.eye(4), (0.86, 0.0, -0.51), (0, 0, 2), WIDTH, HEIGHT)
    known = box(slice(None), slice(28, 36))
    smooth = smooth_depth(without(steep, ~known), GREY, DepthCompletionConfig())
    assert smooth.min() >= 0.5 * steep.depth[known].min() and smooth.max() <= 2 * steep.depth[known].max() * 1.001


def test_stereos_own_doubtful_depth_comes_first():
    pointmap = wall()
    pointmap.confidence[HOLE] = 0.2
    pointmap.depth[HOLE] = 2.6
    config = DepthCompletionConfig(min_confidence=0.3)
    (filled,) = complete([pointmap], [GREY], config)
    np.testing.assert_allclose(filled.depth[HOLE], 2.6)
    np.testing.assert_allclose(filled.confidence[HOLE], config.confidence)


def test_what_another_view_shows_is_left_empty():
    first, second = without(wall(confidence=0.9), HOLE), wall(x=0.1)
    filled, _ = complete([first, second], [GREY, GREY], DepthCompletionConfig())
    assert not filled.depth[HOLE].any()
    np.testing.assert_allclose(filled.depth[~HOLE], 2.0)


def contradicted() -> tuple[Pointmap, Pointmap]:
    """The second view sees, at depth 4, past all points of the first one's hole that are nearer."""
    hole = box(slice(21, 27), slice(45, 50))
    # f = 70.4: from 0.9 to the right, the hole's columns are 13 to 18 at depth 2, 24 to 29 at depth 3, 29 to 34 at 4.
    seen = box(slice(15, 33), slice(8, 29))
    far = wall(4.0, x=0.9, confidence=0.5)
    return without(wall(confidence=0.9), hole), without(far, ~seen)


def test_nothing_is_filled_before_a_known_surface_of_another_view():
    holed, beyond = contradicted()
    hole = holed.depth == 0
    filled, _ = complete([holed, beyond], [GREY, GREY], DepthCompletionConfig(background_depth=1.5))
    assert not filled.depth[hole].any()  # neither on the wall, at 2, nor at 3: both would hide what is at 4
    (alone,) = complete([holed], [GREY], DepthCompletionConfig(background_depth=1.5))
    np.testing.assert_allclose(alone.depth[hole], 2.0, rtol=1e-3)


def test_the_background_is_taken_where_nothing_nearer_is_possible():
    holed, beyond = contradicted()
    hole = holed.depth == 0
    filled, _ = complete([holed, beyond], [GREY, GREY], DepthCompletionConfig(background_depth=3.0))
    np.testing.assert_allclose(filled.depth[hole], 6.0, rtol=1e-5)


def test_the_background_lies_outside_the_sphere_around_the_cameras():
    """Cameras .9 apart, a sphere of 50 times their distance from their middle, and rays that nearly go straight out."""
    holed, beyond = contradicted()
    hole = holed.depth == 0
    config = DepthCompletionConfig(background_depth=3.0, surround=50.0)
    filled, _ = complete([holed, beyond], [GREY, GREY], config)
    points = filled.points @ filled.T_world_camera[:3, :3].T + filled.T_world_camera[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(points[hole] - [0.45, 0.0, 0.0], axis=1), 0.45 * 50.0, rtol=1e-4)


def test_of_cameras_that_look_at_each_other_it_lies_behind_the_other():
    both = [wall(), looking(facing_each_other(4.0), 2.0)]
    assert all(depth.min() > 4.0 for depth in _leave_cameras(both, DepthCompletionConfig().surround))


def test_cameras_beside_each_other_leave_the_background_where_it_was():
    near = _leave_cameras([wall(), wall(x=0.3)], DepthCompletionConfig().surround)
    assert max(depth.max() for depth in near) < 1.5 * 2.0


def test_no_guess_lies_where_another_camera_stands():
    """A hole in a wall at 4, behind which another camera stands that looks to the side."""
    aside = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 4.2], [0.0, 0.0, 0.0, 1.0]])
    near, other = wall(4.0), looking(aside, 1.5)
    config = DepthCompletionConfig(most_partners=0)  # what hides surfaces of the other view is another matter
    holed = without(near, HOLE)
    path = find_free_path([holed, other], config.clearance)
    assert path.contains(near.points[HOLE].astype(float)).all()
    filled, _ = complete([holed, other], [GREY, GREY], config)
    assert not path.contains(filled.points[HOLE].astype(float)).any()
    assert filled.depth[HOLE].min() > 4.2  # behind the other camera, not before it
    assert filled.depth[HOLE].max() < 1.2 * (4.2 + path.radii.max())  # no farther than need be
    touching = msgspec.structs.replace(config, clearance=0.0)
    as_before, _ = complete([holed, other], [GREY, GREY], touching)
    np.testing.assert_allclose(as_before.depth[HOLE], 4.0, rtol=0.01)


def test_a_floor_below_the_path_hardly_moves():
    """Two cameras, one 3 metres before the other, half a metre above a floor that each knows but for a hole."""
    floor = [plane_pointmap(T, (0.0, -1.0, 0.0), (0.0, 0.5, 0.0), WIDTH, HEIGHT) for T in (np.eye(4), move_ahead(3.0))]
    seen = [np.where((each.depth > 0) & (each.depth < 8.0), each.depth, np.float32(0.0)) for each in floor]
    known = [replace(each, depth=depth, frame_id=i) for i, (each, depth) in enumerate(zip(floor, seen, strict=True))]
    hole = box(slice(40, 46), slice(26, 38))
    assert known[0].depth[hole].min() > 0 and known[0].depth[hole].max() < 3.0  # before it reaches the second camera

    def fill_floor(clearance: float) -> np.ndarray:
        config = DepthCompletionConfig(most_partners=0, clearance=clearance)
        filled, _ = complete([without(known[0], hole), known[1]], [GREY, GREY], config)
        return filled.depth[hole] / known[0].depth[hole]

    np.testing.assert_allclose(fill_floor(0.0), 1.0, rtol=0.1)
    assert fill_floor(1.0).min() > 0.9 and fill_floor(1.0).max() < 1.3
    assert fill_floor(3.0).max() > 2.0  # as wide as the nearest depth along the view


def test_a_wall_beside_the_path_goes_on_nearer_than_what_is_known():
    """A wall at 2 of which one of two cameras knows only what is far to the side."""
    both = [wall(2.0), wall(2.0, x=0.3)]
    hole = box(slice(0, HEIGHT), slice(0, 56))
    config = DepthCompletionConfig(most_partners=0, clearance=2.0)
    holed = without(both[0], hole)
    path = find_free_path([holed, both[1]], config.clearance)
    assert path.contains(both[0].points[hole].astype(float)).any()
    filled, _ = complete([holed, both[1]], [GREY, GREY], config)
    np.testing.assert_allclose(filled.depth[hole], 2.0, rtol=0.01)


def test_the_path_leads_from_camera_to_camera_and_is_as_wide_as_what_is_nearest_there():
    row = [replace(wall(2.0, x=x), frame_id=i) for i, x in enumerate((0.0, 4.0, 8.0, 12.0))]
    path = find_free_path(row, 1.0)
    points = np.array([[2.0, 0.0, 1.9], [2.0, 0.0, 2.1], [-1.9, 0.0, 0.0], [-2.1, 0.0, 0.0], [14.1, 0.0, 0.0]])
    assert path.contains(points).tolist() == [True, False, True, False, False]
    assert not find_free_path(row, 0.0).contains(points).any()


def test_a_camera_that_knows_no_depth_makes_no_path():
    blind = without(wall(x=1.0), np.ones((HEIGHT, WIDTH), bool))
    assert not find_free_path([wall(), blind], 1.0).contains(np.array([[0.5, 0.0, 0.0]])).any()
    assert not find_free_path([wall()], 1.0).contains(np.zeros((1, 3))).any()


def test_a_view_that_knows_nothing_stays_empty():
    nothing = without(wall(), np.ones((HEIGHT, WIDTH), bool))
    filled, _ = complete([nothing, wall()], [GREY, GREY], DepthCompletionConfig())
    assert not filled.depth.any() and not filled.confidence.any()


def test_views_keep_their_order():
    pointmaps = [replace(wall(confidence=c), frame_id=i) for i, c in enumerate((0.4, 0.9, 0.6))]
    assert [pointmap.frame_id for pointmap in complete(pointmaps, [GREY] * 3, DepthCompletionConfig())] == [0, 1, 2]


@pytest.mark.parametrize(("step", "depth"), [(0.9, 0.8), (0.1, 0.0)])
def test_what_stands_before_another_views_surface_is_put_close_to_the_camera(step, depth):
    """Red where the other view shows grey wall. That view, if it is near, would see something at 0.4 * 2 as well."""
    hole = box(slice(16, 32), slice(40, 56))
    image = GREY.copy()
    image[hole] = 255, 0, 0
    pointmaps = [without(wall(confidence=0.9), hole), wall(x=step)]
    filled, _ = complete(pointmaps, [image, GREY], DepthCompletionConfig(foreground_depth=0.4))
    inside = box(slice(19, 29), slice(43, 53))
    np.testing.assert_allclose(filled.depth[inside], depth, rtol=1e-5)
    assert np.array_equal(filled.depth[~hole], pointmaps[0].depth[~hole])


def test_a_few_pixels_of_another_colour_are_noise_and_not_an_object():
    hole = box(slice(20, 23), slice(45, 48))
    image = GREY.copy()
    image[hole] = 255, 0, 0
    filled, _ = complete(
        [without(wall(confidence=0.9), hole), wall(x=0.9)], [image, GREY], DepthCompletionConfig(min_object_px=7)
    )
    assert not filled.depth[hole].any()
