"""The measure of needles and floaters marks what hangs before a wall that is known, and leaves the wall alone."""

from __future__ import annotations

import numpy as np

from splatnode.recon.geometry import Similarity
from splatnode.recon.result.snapshot import GaussianArrays
from tests.bench.quality.known_surfaces import KnownSurfaces, KnownView
from tests.bench.quality.unfounded import Covered, covered, footing
from tests.bench.quality.viewpoints import COUNT, Viewpoint, viewpoints

SIZE, FOCAL, WALL = 64, 70.0, 2.0
K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def camera(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


KNOWN = KnownSurfaces(
    {str(x): KnownView(camera(x), K, np.full((SIZE, SIZE), WALL, np.float32)) for x in (-0.3, 0.0, 0.3)}
)


def scene(*further: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]):
    """A red wall, and further Gaussians by their centres, extents and colours."""
    steps = np.arange(-1.5, 1.51, 0.05)
    wall = [((x, y, WALL), (0.05, 0.05, 0.002), RED) for x in steps for y in steps]
    means, scales, colours = (np.array(each, np.float32) for each in zip(*wall, *further, strict=True))
    count = len(means)
    sh = ((colours - 0.5) * 2 * np.sqrt(np.pi)).astype(np.float32)[:, None]
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    return GaussianArrays(means, quats, scales, np.full(count, 0.95, np.float32), sh, np.zeros(count, np.int32))


def seen(gaussians: GaussianArrays, x: float = 0.1) -> Covered:
    return covered(gaussians, footing(gaussians, KNOWN), KNOWN, Viewpoint(camera(x), K, SIZE, SIZE))


def test_a_wall_is_not_covered():
    found = seen(scene())
    assert not found.either.any() and found.rgb[SIZE // 2, SIZE // 2, 0] > 0.8


def test_what_hangs_before_the_wall_is_a_floater():
    found = seen(scene(((0.1, 0, 1.0), (0.06, 0.06, 0.06), BLUE)))
    assert found.floaters[SIZE // 2, SIZE // 2] and not found.needles.any()
    assert 0.01 < found.either.mean() < 0.1


def test_a_long_one_that_sticks_out_of_the_wall_is_a_needle_where_it_is_seen_as_long():
    needle = ((0.0, 0.0, 1.7), (0.015, 0.015, 0.4), BLUE)
    assert seen(scene(needle), x=0.5).needles.mean() > 0.002
    assert not seen(scene(needle), x=0.0).needles.any()  # from there one looks along it


def test_a_long_one_on_the_wall_and_one_of_the_walls_colour_cover_nothing():
    assert not seen(scene(((0.0, 0.0, WALL), (0.5, 0.01, 0.002), BLUE))).either.any()
    assert not seen(scene(((0.1, 0, 1.0), (0.06, 0.06, 0.06), RED))).either.any()


def test_what_nobody_photographs_but_hides_the_wall_is_a_floater():
    """It hangs beside the pictures of all three cameras, and before that of the viewpoint between them."""
    near = ((0.15, 0.0, 0.2), (0.012, 0.012, 0.012), BLUE)
    through, _ = KNOWN.crossed(np.array([near[0]]))
    assert not through.any()
    assert seen(scene(near), x=0.15).floaters.any()


def test_what_is_known_moves_with_the_world():
    twice = Similarity(2.0, np.eye(3), np.array([1.0, 0, 0]))
    points = np.array([[0.0, 0, 1.0], [0, 0, WALL]])
    for known, at in ((KNOWN, points), (KNOWN.moved(twice), twice(points))):
        through, on = known.crossed(at)
        assert through.tolist() == [True, False] and on.tolist() == [False, True]


def test_viewpoints_are_between_and_beside_the_cameras_and_look_at_the_place():
    views = list(KNOWN.views.values())
    found = viewpoints(views)
    again = viewpoints(views)
    assert len(found) == COUNT
    for one, other in zip(found, again, strict=True):
        assert np.array_equal(one.T_world_camera, other.T_world_camera)
        rotation, centre = one.T_world_camera[:3, :3], one.T_world_camera[:3, 3]
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert np.abs(centre).max() <= 0.3 + 0.25 * WALL and rotation[2, 2] > 0.9
    assert np.allclose(found[0].T_world_camera, camera(-0.29))
    assert (
        len({tuple(np.sign(v.T_world_camera[1:3, 3].round(6))) for v in found}) == 4
    )  # on the path, below, above, back
