from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.optimize.regularizers import PointRender, render_points

K = np.array([[10.0, 0.0, 4.0], [0.0, 10.0, 3.0], [0.0, 0.0, 1.0]])
FACING = np.array([0.0, 0.0, -1.0])


def at(u: float, v: float, z: float) -> list[float]:
    return [(u - 4.0) * z / 10.0, (v - 3.0) * z / 10.0, z]


def render(points: list[list[float]], colours: list[list[float]], normal=FACING, **settings) -> PointRender:
    normals = np.tile(normal, (len(points), 1)).astype(np.float32)
    return render_points(
        np.array(points, np.float32), np.array(colours, np.float32), normals, np.eye(4), K, 8, 6, **settings
    )


RED, GREEN, BLUE = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]


def test_weights_fall_with_the_distance_in_the_image():
    """Equation 6 by hand: two points of one surface, at 0 and 1 pixels from the centre of pixel (4, 3)."""
    image = render([at(4.5, 3.5, 2.0), at(5.5, 3.5, 2.0)], [RED, BLUE], radius=1.0)
    share = 1 / (1 + np.exp(-1.0))
    np.testing.assert_allclose(image.rgb[3, 4], [share, 0, 1 - share], atol=1e-4)
    assert image.depth[3, 4] == pytest.approx(2.0)
    np.testing.assert_allclose(image.normal[3, 4], FACING, atol=1e-6)


def test_only_the_nearest_count():
    image = render([at(4.5, 3.5, 2.0), at(5.5, 3.5, 2.0)], [RED, BLUE], radius=1.0, nearest=1)
    np.testing.assert_allclose(image.rgb[3, 4], RED, atol=1e-6)


def test_a_surface_hides_what_is_behind_it():
    image = render([at(4.5, 3.5, 4.0), at(4.9, 3.5, 2.0)], [RED, GREEN])
    np.testing.assert_allclose(image.rgb[3, 4], GREEN, atol=1e-6)


def test_white_where_there_is_nothing():
    image = render([at(4.5, 3.5, 2.0)], [RED], radius=0.5)
    assert image.seen.sum() == 1 and image.seen[3, 4]
    assert (image.rgb[~image.seen] == 1).all() and (image.depth[~image.seen] == 0).all()


def test_points_behind_the_camera_outside_or_seen_from_behind_are_not_drawn():
    assert not render([at(4.5, 3.5, -2.0), at(400.0, 3.5, 2.0)], [RED, RED]).seen.any()
    assert not render([at(4.5, 3.5, 2.0)], [RED], normal=-FACING).seen.any()
