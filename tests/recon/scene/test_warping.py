"""A scene follows a new registration of its cameras, or is not moved at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import Intrinsics
from splatnode.recon.geometry import Similarity
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.registration import Registration, undistort_keyframe
from splatnode.recon.scene.growth import registration_in_scene_world, replace_images, update_pointmaps, warp_scene
from tests.support.row_of_views import HEIGHT, STEP, WIDTH, camera, graph_of, maps_of, registration_of, scene_of

WORLD = Similarity(1.7, Rotation.from_euler("xyz", [20, -40, 10], degrees=True).as_matrix(), np.array([0.3, -1.0, 2.0]))


def test_a_registration_in_another_world_is_carried_into_that_of_the_scene():
    graph = graph_of(4)
    placed = registration_in_scene_world(scene_of(3, graph), registration_of(4, WORLD), graph)
    for index, found in enumerate(placed.cameras):
        np.testing.assert_allclose(found.T_world_camera, camera(index), atol=1e-6)
    np.testing.assert_allclose(placed.points, [[0, 0, 2]], atol=1e-6)


def test_a_view_that_is_no_longer_placed_means_a_fresh_start():
    graph, registration = graph_of(4), registration_of(4)
    lacking = replace(registration, cameras=registration.cameras[1:])
    assert registration_in_scene_world(scene_of(3, graph), lacking, graph) is None


def observed(registration: Registration, depth: float) -> Registration:
    """With points at this depth, in the world of its first camera, that all cameras see in a grid of pixels."""
    u, v = np.meshgrid(np.arange(4, WIDTH, 6) + 0.5, np.arange(4, HEIGHT, 6) + 0.5)
    pixels = np.stack([u.ravel(), v.ravel()], 1)
    points, index = [], []
    for camera_ in registration.cameras:
        rays = np.column_stack([(pixels - camera_.principal) / camera_.focal, np.ones(len(pixels))])
        T = camera_.T_world_camera
        points.append(depth * rays @ T[:3, :3].T + T[:3, 3])
        index.append(np.full(len(pixels), camera_.index))
    count = len(pixels) * len(registration.cameras)
    return replace(
        registration,
        points=np.concatenate(points),
        observed_by=np.concatenate(index),
        observed_point=np.arange(count),
        observed_pixels=np.tile(pixels, (len(registration.cameras), 1)),
    )


def test_point_maps_are_carried_to_where_the_registration_has_its_points():
    graph = graph_of(3)
    maps = update_pointmaps(maps_of(range(2)), observed(registration_of(3, WORLD), 2.0 * WORLD.scale), graph)
    assert list(maps) == ["00.png", "01.png"]
    for index, pointmap in enumerate(maps.values()):
        np.testing.assert_allclose(pointmap.depth, WORLD.scale * 2.0, rtol=1e-6)
        np.testing.assert_allclose(pointmap.T_world_camera, WORLD.camera(camera(index)), atol=1e-9)


def test_a_scene_moves_with_its_point_maps():
    graph, scene, before = graph_of(3), scene_of(3, graph_of(3)), maps_of(range(3))
    wider = registration_of(3)
    wider = replace(wider, cameras=tuple(replace(each, focal=each.focal / 1.25) for each in wider.cameras))
    after = update_pointmaps(before, observed(wider, 1.6), graph)
    changed_ = warp_scene(scene, before, after, 0.1)
    # The same pixels show the same Gaussians: with a focal length of 1 / 1.25, at 1.6 / 2 of the depth.
    of_view = scene.gaussians.source_frame == 1
    means, were = changed_.gaussians.means[of_view], scene.gaussians.means[of_view]
    centre = torch.tensor([STEP, 0.0, 0.0])
    torch.testing.assert_close(means[:, 2], 0.8 * were[:, 2], rtol=1e-4, atol=1e-5)
    for place in (0, 1):
        before_px, after_px = (
            (x - centre)[:, place] / x[:, 2] * f for x, f in ((were, 1.1 * WIDTH), (means, 0.88 * WIDTH))
        )
        torch.testing.assert_close(after_px, before_px, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(changed_.views[1].K[0, 0], 0.88 * WIDTH, rtol=1e-5)


def test_gaussians_turn_with_their_camera():
    scene, before = scene_of(3, graph_of(3)), maps_of(range(3))
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", 2, degrees=True).as_matrix()
    after = before | {"01.png": replace(before["01.png"], T_world_camera=before["01.png"].T_world_camera @ turn)}
    turned = warp_scene(scene, before, after, 0.1)
    of_view = scene.gaussians.source_frame == 1
    centre = torch.tensor([STEP, 0.0, 0.0])
    expected = (scene.gaussians.means[of_view] - centre) @ torch.from_numpy(turn[:3, :3]).float().T + centre
    torch.testing.assert_close(turned.gaussians.means[of_view], expected, rtol=0, atol=1e-5)
    assert torch.equal(turned.gaussians.means[~of_view], scene.gaussians.means[~of_view])


@pytest.mark.parametrize("what", ["centre", "depth", "missing"])
def test_a_scene_that_would_not_hold_together_is_not_moved(what):
    scene, before = scene_of(3, graph_of(3)), maps_of(range(3))
    after, last = dict(before), before["02.png"]
    if what == "centre":
        T = last.T_world_camera.copy()
        T[1, 3] += 0.2
        after["02.png"] = replace(last, T_world_camera=T)
    elif what == "depth":
        after["02.png"] = replace(last, depth=np.float32(3) * last.depth)
    else:
        del after["02.png"]
    assert warp_scene(scene, before, after, 0.1) is None


def test_photographs_follow_a_lens_that_changed_little_and_a_scene_begins_anew_after_another():
    graph = graph_of(2)
    scene = scene_of(2, graph)
    assert replace_images(scene, graph).views == scene.views

    def bent(radial: float) -> ViewGraph:
        lens = Intrinsics(WIDTH, HEIGHT, 35.0, 35.0, 16.0, 12.0, "estimated", (radial, 0.0, 0.0, 0.0))
        return replace(graph, keyframes=tuple(undistort_keyframe(keyframe, lens) for keyframe in graph.keyframes))

    assert replace_images(scene, bent(-0.2)) is None  # it was not bent before
    first, second = bent(-0.2), bent(-0.205)
    views = [replace(view, image=k.image, lens=k.lens) for view, k in zip(scene.views, first.keyframes, strict=True)]
    found = replace_images(replace(scene, views=tuple(views)), second)
    assert [view.lens for view in found.views] == [keyframe.lens for keyframe in second.keyframes]
    assert all(view.image is keyframe.image for view, keyframe in zip(found.views, second.keyframes, strict=True))
    assert replace_images(replace(scene, views=tuple(views)), graph_of(1)) is None
