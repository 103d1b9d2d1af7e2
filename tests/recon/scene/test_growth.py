"""A scene that takes further views in, or lets views go, keeps what it has learnt to the bit."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from msgspec.structs import replace as changed
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import Frame
from splatnode.recon.config import Config
from splatnode.recon.frames.keyframe import Features, Keyframe
from splatnode.recon.geometry import Similarity
from splatnode.recon.matching import config as matching
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.registration.register import RegisteredCamera, Registration
from splatnode.recon.scene import background
from splatnode.recon.scene.growth import NEIGHBOURS, carried, grow, in_world_of, moved, without
from splatnode.recon.scene.scene import Scene, begin
from tests.support.synthetic import plane_pointmap

WIDTH, HEIGHT, STEP = 32, 24, 0.3
WORLD = Similarity(1.7, Rotation.from_euler("xyz", [20, -40, 10], degrees=True).as_matrix(), np.array([0.3, -1.0, 2.0]))
NO_FEATURES = Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8), np.zeros(0, np.int64), np.zeros(0))


def camera(index: int) -> np.ndarray:
    """T_world_camera, `index` steps to the right of a wall of noise's first view."""
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = STEP * index
    return T_world_camera


def graph_of(count: int) -> ViewGraph:
    """Views in a row; the nearer two are, the more matches they have."""
    graph = ViewGraph(matching.Config())
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH + 16 * count, 3)).astype(np.uint8)
    for index in range(count):
        image = np.ascontiguousarray(noise[:, index : index + WIDTH])
        graph.keyframes.append(Keyframe(Frame(index, f"{index:02d}.png", 0, image, None), image, NO_FEATURES))
    pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    graph.pairs.update({(i, j): SimpleNamespace(matches=np.zeros((100 - 9 * (j - i), 2))) for i, j in pairs})
    return graph


def registration_of(count: int, world: Similarity | None = None) -> Registration:
    world = world or Similarity(1.0, np.eye(3), np.zeros(3))
    principal = np.array([WIDTH / 2, HEIGHT / 2])
    return Registration(
        cameras=tuple(
            RegisteredCamera(i, world.camera(camera(i)), 0, 1.1 * WIDTH, principal, 0.0, 0.1, 0.01)
            for i in range(count)
        ),
        points=np.array([[0.0, 0.0, 2.0]]) * world.scale @ world.rotation.T + world.translation,
        observed_by=np.zeros(0, np.int64),
        observed_point=np.zeros(0, np.int64),
        observed_pixels=np.zeros((0, 2)),
        agreement={},
        focal_sigma=0.0,
        median_angle_deg=10.0,
        rms_px=0.3,
    )


def maps_of(indices: range) -> dict[str, Pointmap]:
    maps = [plane_pointmap(camera(index), confidence=0.9 - 0.01 * index, frame_id=index) for index in indices]
    return {pointmap.name: pointmap for pointmap in maps}


def scene_of(count: int, graph: ViewGraph, config: Config | None = None) -> Scene:
    config = config or Config()
    return begin(
        tuple(maps_of(range(count)).values()),
        {keyframe.name: keyframe.image for keyframe in graph.keyframes},
        registration_of(count).cameras,
        config.completion,
        config.seeding,
        config.background,
    )


def with_view(scene: Scene, index: int, T_world_camera: torch.Tensor) -> Scene:
    views = list(scene.views)
    views[index] = replace(views[index], T_world_camera=T_world_camera)
    return replace(scene, views=tuple(views))


def test_a_registration_in_another_world_is_carried_into_that_of_the_scene():
    graph = graph_of(4)
    placed = in_world_of(scene_of(3, graph), registration_of(4, WORLD), graph)
    for index, found in enumerate(placed.cameras):
        np.testing.assert_allclose(found.T_world_camera, camera(index), atol=1e-6)
    np.testing.assert_allclose(placed.points, [[0, 0, 2]], atol=1e-6)


def test_a_view_that_is_no_longer_placed_means_a_fresh_start():
    graph, registration = graph_of(4), registration_of(4)
    assert in_world_of(scene_of(3, graph), replace(registration, cameras=registration.cameras[1:]), graph) is None


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
    maps = carried(maps_of(range(2)), observed(registration_of(3, WORLD), 2.0 * WORLD.scale), graph)
    assert list(maps) == ["00.png", "01.png"]
    for index, pointmap in enumerate(maps.values()):
        np.testing.assert_allclose(pointmap.depth, WORLD.scale * 2.0, rtol=1e-6)
        np.testing.assert_allclose(pointmap.T_world_camera, WORLD.camera(camera(index)), atol=1e-9)


def test_a_scene_moves_with_its_point_maps():
    graph, scene, before = graph_of(3), scene_of(3, graph_of(3)), maps_of(range(3))
    wider = registration_of(3)
    wider = replace(wider, cameras=tuple(replace(each, focal=each.focal / 1.25) for each in wider.cameras))
    after = carried(before, observed(wider, 1.6), graph)
    changed_ = moved(scene, before, after, 0.1)
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
    turned = moved(scene, before, after, 0.1)
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
    assert moved(scene, before, after, 0.1) is None


def test_growing_adds_a_further_views_gaussians_and_leaves_all_others_as_they_are():
    graph, before = graph_of(4), 3
    scene = scene_of(before, graph)
    grown = grow(scene, maps_of(range(4)), graph, registration_of(4), Config())
    count = len(scene.gaussians)
    assert [view.name for view in grown.views] == ["00.png", "01.png", "02.png", "03.png"]
    assert torch.equal(grown.gaussians.means[:count], scene.gaussians.means)
    added = grown.gaussians.subset(torch.arange(count, len(grown.gaussians)))
    assert set(added.source_frame.tolist()) == {3}
    # Only what it sees to the right of the view before it is new: a step of 0.3 at depth 2 is 5.3 of 32 columns.
    visible_before = (STEP * 2) + 2.0 * (WIDTH / 2) / (1.1 * WIDTH)
    assert len(added) > 20 and float(added.means[:, 0].min()) > visible_before - 0.3


def test_a_further_view_is_compared_with_its_neighbours_only():
    count = NEIGHBOURS + 3
    graph = graph_of(count)
    near = maps_of(range(count - NEIGHBOURS - 1, count))  # growing does not ask for the maps of the others
    grown = grow(scene_of(count - 1, graph), near, graph, registration_of(count), Config())
    assert len(grown.views) == count


def test_without_a_further_view_nothing_changes():
    graph = graph_of(3)
    scene = scene_of(3, graph)
    assert grow(scene, {}, graph, registration_of(3), Config()) is scene


def test_a_bound_on_gaussians_keeps_those_that_cover_most():
    graph = graph_of(4)
    scene = scene_of(3, graph)
    limit = len(scene.gaussians) // 2
    grown = grow(scene, maps_of(range(4)), graph, registration_of(4), changed(Config(), max_gaussians=limit))
    assert len(grown.gaussians) == limit
    assert int((grown.gaussians.source_frame == background.SHELL).sum()) > 0


def test_a_view_that_goes_takes_its_gaussians_along_and_the_next_becomes_the_world():
    graph = graph_of(3)
    scene = scene_of(3, graph)
    rest = without(scene, {"00.png"})
    assert [view.name for view in rest.views] == ["01.png", "02.png"]
    assert 0 not in rest.gaussians.source_frame
    np.testing.assert_allclose(rest.views[0].T_world_camera, np.eye(4), atol=1e-6)
    kept = scene.gaussians.subset(scene.gaussians.source_frame != 0)
    torch.testing.assert_close(rest.gaussians.means, kept.means - torch.tensor([STEP, 0, 0]), rtol=0, atol=1e-5)
    assert without(scene, {"00.png", "01.png", "02.png"}).views == ()
