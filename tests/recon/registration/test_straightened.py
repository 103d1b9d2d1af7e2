"""An estimated distortion is taken out of photographs and observations where it is large, and else nothing changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.capture import lenses
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.lenses import undistort_frame
from splatnode.recon.keyframes import Features, Keyframe
from splatnode.recon.matching import view_graph as matching
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.registration import (
    LEAST_SHIFT,
    Registration,
    apply_known_lenses,
    corner_shift,
    radial_of,
    undistort_keyframe,
    undistort_keyframes,
)
from tests.support.row_of_views import NO_FEATURES, graph_of, registration_of

LENS = Intrinsics(160, 120, 150.0, 150.0, 80.5, 59.5, "estimated", (-0.25, 0.0, 0.0, 0.0))


def pattern(lens: Intrinsics) -> np.ndarray:
    """(H, W, 3) smooth colours by direction, as `lens` shows them."""
    pixels = np.stack(np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5), -1).reshape(-1, 2)
    x, y = (20.0 * lenses.unproject_opencv(pixels, lens)[:, :2]).T
    colours = 127.5 + 120.0 * np.stack([np.sin(x), np.cos(y), np.sin(x + y)], -1)
    return np.rint(colours).astype(np.uint8).reshape(lens.height, lens.width, 3)


def photograph() -> Frame:
    return Frame(0, "a.png", 0, pattern(LENS), None)


def seen(lens: Intrinsics) -> tuple[ViewGraph, Registration, np.ndarray]:
    """A photograph through `lens`, its registration with points in its view, and these (P, 3)."""
    frame = photograph()
    generator = np.random.default_rng(0)
    points = np.column_stack([generator.uniform(-0.6, 0.6, (400, 2)) * (1.0, 0.75), np.ones(400)]) * 3.0
    pixels = lenses.project_opencv(points, lens)
    features = Features(pixels, np.zeros((0, 128), np.uint8), np.zeros(0, np.int64), np.zeros(0))
    graph = ViewGraph(matching.MatchingConfig(), (Keyframe(frame, frame.image, features),))
    camera = replace(
        registration_of(1).cameras[0],
        focal=lens.fx,
        principal=np.array([lens.cx, lens.cy]),
        radial=np.array(radial_of(lens)),
    )
    registration = replace(
        registration_of(1),
        cameras=(camera,),
        points=points,
        observed_by=np.zeros(400, np.int64),
        observed_point=np.arange(400),
        observed_pixels=pixels,
    )
    return graph, registration, points


def test_a_corner_moves_by_the_cube_of_its_slope():
    lens = Intrinsics(400, 300, 250.0, 250.0, 200.0, 150.0, "estimated", (0.1,))
    assert corner_shift(lens) == pytest.approx(0.1 * 1.0**3 * 250 / 400)  # the corner is at a slope of 1
    assert corner_shift(replace(lens, distortion=(-0.1,))) == pytest.approx(-0.0625)
    assert corner_shift(replace(lens, distortion=())) == corner_shift(None) == 0.0
    second = replace(lens, distortion=(0.0, 0.1))
    assert corner_shift(second) == pytest.approx(0.0625)  # and to the fifth power


def test_observations_are_those_of_the_pinhole():
    graph, registration, points = seen(LENS)
    straight_graph, found = undistort_keyframes(graph, registration)
    (keyframe,), (camera,) = straight_graph.keyframes, found.cameras
    lens = keyframe.lens
    assert lens == LENS and not camera.radial.any()
    at = points[found.observed_point]
    expected = camera.focal * at[:, :2] / at[:, 2:] + camera.principal
    np.testing.assert_allclose(found.observed_pixels, expected, atol=1e-3)
    shown = np.all((expected >= 0) & (expected < (160, 120)), axis=1)
    assert shown.all() and 200 < len(shown) < 400  # what the pinhole does not show is left out
    np.testing.assert_allclose(keyframe.features.points[found.observed_point], expected, atol=1e-3)
    as_it_came = registration.cameras[0].radial.tolist()
    assert graph.keyframes[0].lens is None and as_it_came == [-0.25, 0.0]


def test_the_photograph_is_that_of_the_pinhole():
    graph, registration, _ = seen(LENS)
    keyframe = undistort_keyframes(graph, registration)[0].keyframes[0]
    true, before = pattern(keyframe.frame.intrinsics), graph.keyframes[0].image
    errors, others = (np.abs(image.astype(float) - true).mean() for image in (keyframe.image, before))
    assert keyframe.image.shape == true.shape and errors < 1.0 < 5.0 < others


def test_a_large_photograph_and_its_mask_are_straightened_at_twice_the_modelled_size():
    frame = photograph()
    mask = np.ones((120, 160), bool)
    mask[50:70, 70:90] = False
    small = np.ascontiguousarray(frame.image[1::4, 1::4])
    known = Keyframe(replace(frame, mask=mask), small, NO_FEATURES)
    found = undistort_keyframe(known, LENS)
    assert found.image.shape == small.shape and (found.frame.width, found.frame.height) == (80, 60)
    assert found.mask is not None and 0.8 < found.mask.mean() < 1.0
    exact = undistort_frame(replace(frame, intrinsics=LENS))
    assert found.frame.intrinsics.fx == pytest.approx(exact.intrinsics.fx / 2, rel=1e-3)


@pytest.mark.parametrize("radial", [0.0, 0.01, -0.03])
def test_nothing_changes_where_the_shift_is_small(radial):
    lens = replace(LENS, distortion=(radial, 0.0))
    assert abs(corner_shift(lens)) < LEAST_SHIFT
    graph, registration, _ = seen(lens)
    same = undistort_keyframes(graph, registration)
    assert same[0] is graph and same[1] is registration


def test_a_lens_that_folds_the_picture_over_is_not_believed(caplog):
    graph, registration, _ = seen(LENS)
    folds = replace(registration, cameras=(replace(registration.cameras[0], radial=np.array([-3.0, 0.0])),))
    found = undistort_keyframes(graph, folds)
    assert found[0] is graph and found[1] is folds
    assert "stay as they are" in caplog.text


def test_only_the_photographs_of_a_bending_lens_are_straightened():
    graph, registration = graph_of(2), registration_of(2)
    cameras = registration.cameras[0], replace(registration.cameras[1], radial=np.array([-0.4, 0.0]))
    found, straight_registration = undistort_keyframes(graph, replace(registration, cameras=cameras))
    assert found.keyframes[0] is graph.keyframes[0] and straight_registration.cameras[0] is cameras[0]
    assert found.keyframes[1].lens is not None and isinstance(found.keyframes[1].frame, Frame)


def test_a_known_lens_is_that_of_all_cameras_that_share_it():
    graph, registration = graph_of(3), registration_of(3)
    *shared, other = registration.cameras
    apart = replace(registration, cameras=(*shared, replace(other, lens=1)))
    lens = Intrinsics(64, 48, 80.0, 80.0, 33.0, 23.0, "estimated", (-0.4, 0.0, 0.0, 0.0))
    found = apply_known_lenses(apart, graph, {"00.png": lens, "02.png": None}).cameras
    known = [(camera.focal, *camera.principal, *camera.radial) for camera in found[:2]]
    assert known == [(40.0, 16.5, 11.5, -0.4, 0.0)] * 2
    assert found[2] is apart.cameras[2]
