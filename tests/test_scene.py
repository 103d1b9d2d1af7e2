"""The scene: what it starts from, what it tells, and how it is carried along when further views come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from recon import background, completion, density
from recon.gaussians import concatenate
from recon.geometry import Similarity
from recon.registration.register import RegisteredCamera
from recon.scene import Scene, View, begin, extend
from tests.synthetic import TinyScene, plane_pointmap, tiny_scene

WIDTH, HEIGHT = 32, 24
WORLD = Similarity(1.7, Rotation.from_euler("xyz", [20, -40, 10], degrees=True).as_matrix(), np.array([0.3, -1.0, 2.0]))


def view(index: int, T_world_camera: torch.Tensor, K: torch.Tensor) -> View:
    pointmap = plane_pointmap(T_world_camera.double().numpy(), frame_id=index)
    image = np.full((HEIGHT, WIDTH, 3), 10 * index, np.uint8)
    return View(pointmap.name, index, image, T_world_camera, K, 0.1 * (index + 1), 0.01 * (index + 1))


def scene_of(tiny: TinyScene, num_views: int, similarity: Similarity | None = None, iterations: int = 0) -> Scene:
    """The first views of a tiny scene in the world of their first camera, then moved by `similarity`."""
    Ts = tiny.Ts_world_camera.double().numpy()
    anchor = np.linalg.inv(Ts[0])
    moved = similarity or Similarity(1.0, np.eye(3), np.zeros(3))
    gaussians = tiny.gaussians.transformed(1.0, torch.from_numpy(anchor[:3, :3]), torch.from_numpy(anchor[:3, 3]))
    gaussians = gaussians.transformed(
        moved.scale, torch.from_numpy(moved.rotation), torch.from_numpy(moved.translation)
    )
    views = [
        view(i, torch.from_numpy(moved.camera(anchor @ T)).float(), K)
        for i, (T, K) in enumerate(zip(Ts, tiny.Ks, strict=True))
    ]
    frames = torch.arange(len(gaussians), dtype=torch.int32) % num_views
    return Scene(tuple(views[:num_views]), replace(gaussians, source_frame=frames), iterations)


def with_shell(scene: Scene, colour: float) -> Scene:
    """The scene with three more Gaussians that are its far shell."""
    shell = replace(
        scene.gaussians.subset(torch.arange(3)),
        sh=torch.full((3, 1, 3), colour),
        source_frame=torch.full((3,), background.SOURCE_FRAME, dtype=torch.int32),
    )
    return replace(scene, gaussians=concatenate([scene.gaussians, shell]))


def from_frame(scene: Scene, frame_id: int) -> torch.Tensor:
    return scene.gaussians.means[scene.gaussians.source_frame == frame_id]


def distances(scene: Scene) -> torch.Tensor:
    """(N, C) from every Gaussian to every camera: what no rigid motion changes."""
    centres = torch.stack([view.T_world_camera[:3, 3] for view in scene.views])
    return torch.cdist(scene.gaussians.means, centres)


def test_what_was_learnt_is_carried_through_a_similarity():
    tiny = tiny_scene(num_cameras=4)
    old, new = scene_of(tiny, 3, WORLD, iterations=70), scene_of(tiny, 4)
    old = replace(old, gaussians=replace(old.gaussians, sh=old.gaussians.sh + 1))  # learnt: all are brighter
    grown = extend(old, new)
    assert [view.name for view in grown.views] == ["00.png", "01.png", "02.png", "03.png"]
    assert grown.iterations == 70
    learnt = grown.gaussians.subset(torch.arange(len(old.gaussians)))
    assert torch.equal(learnt.sh, old.gaussians.sh) and torch.equal(learnt.source_frame, old.gaussians.source_frame)
    torch.testing.assert_close(learnt.means, scene_of(tiny, 3).gaussians.means, rtol=0, atol=1e-5)
    torch.testing.assert_close(learnt.scales, scene_of(tiny, 3).gaussians.scales, rtol=1e-4, atol=0)
    for grown_view, new_view in zip(grown.views, new.views, strict=True):
        torch.testing.assert_close(grown_view.T_world_camera, new_view.T_world_camera, rtol=0, atol=1e-5)


def test_only_new_views_bring_new_gaussians():
    tiny = tiny_scene(num_cameras=4)
    old, new = scene_of(tiny, 3), scene_of(tiny, 4)
    grown = extend(old, new)
    assert len(grown.gaussians) == len(old.gaussians) + len(from_frame(new, 3))
    torch.testing.assert_close(from_frame(grown, 3), from_frame(new, 3), rtol=0, atol=1e-5)


def test_the_far_shell_is_the_new_one():
    tiny = tiny_scene(num_cameras=4)
    grown = extend(with_shell(scene_of(tiny, 3), colour=0.1), with_shell(scene_of(tiny, 4), colour=0.9))
    shell = grown.gaussians.subset(grown.gaussians.source_frame == background.SOURCE_FRAME)
    assert len(shell) == 3 and (shell.sh == 0.9).all()


def test_refined_poses_are_kept_and_the_world_stays_the_first_cameras_frame():
    tiny = tiny_scene(num_cameras=4)
    old, new = scene_of(tiny, 3, WORLD), scene_of(tiny, 4)
    refined = old.views[1].T_world_camera.clone()
    refined[0, 3] += 0.01
    old = replace(old, views=(old.views[0], replace(old.views[1], T_world_camera=refined), old.views[2]))
    grown = extend(old, new)
    torch.testing.assert_close(grown.views[0].T_world_camera, torch.eye(4), rtol=0, atol=1e-6)
    # Among the views and Gaussians of the old scene nothing has changed but the scale.
    before, after = distances(old), distances(grown)[: len(old.gaussians), :3]
    ratio = after / before
    assert float(ratio.std() / ratio.mean()) < 1e-4
    assert float((grown.views[1].T_world_camera - new.views[1].T_world_camera).abs().max()) > 1e-3


@pytest.mark.parametrize("by", ["centre", "rotation"])
def test_a_camera_that_moved_means_a_fresh_start(by):
    tiny = tiny_scene(num_cameras=4)
    old, new = scene_of(tiny, 3), scene_of(tiny, 4)
    moved = old.views[1].T_world_camera.clone()
    if by == "centre":
        moved[:3, 3] += torch.tensor([0.1, 0.0, 0.0])
    else:
        turn = Rotation.from_euler("y", 5, degrees=True).as_matrix()
        moved[:3, :3] = moved[:3, :3] @ torch.from_numpy(turn).float()
    old = replace(old, views=(old.views[0], replace(old.views[1], T_world_camera=moved), old.views[2]))
    assert extend(old, new, tolerance=0.02) is new
    assert extend(old, new, tolerance=0.2) is not new


def test_a_focal_length_that_changed_means_a_fresh_start():
    tiny = tiny_scene(num_cameras=4)
    old, new = scene_of(tiny, 3), scene_of(tiny, 4)
    longer = torch.diag(torch.tensor([1.1, 1.1, 1.0]))
    zoomed = replace(old, views=tuple(replace(view, K=view.K @ longer) for view in old.views))
    assert extend(old, new) is not new
    assert extend(zoomed, new) is new


def test_one_view_in_common_is_too_little_to_carry_anything():
    tiny = tiny_scene(num_cameras=4)
    old, new = scene_of(tiny, 4), scene_of(tiny, 4)
    assert extend(replace(old, views=old.views[:1]), new) is new
    assert extend(replace(old, views=old.views[:2]), new) is not new


def begun(max_gaussians: int | None = None) -> Scene:
    """Two views of a wall of noise, one step apart."""
    step = np.eye(4)
    step[0, 3] = 0.3
    pointmaps = tuple(
        plane_pointmap(T, confidence=c, frame_id=i) for i, (T, c) in enumerate([(np.eye(4), 0.9), (step, 0.5)])
    )
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    principal = np.array([WIDTH / 2, HEIGHT / 2])
    cameras = tuple(
        RegisteredCamera(i, pointmap.T_world_camera, 1.1 * WIDTH, principal, 0.0, 0.1 + i, 0.01)
        for i, pointmap in enumerate(pointmaps)
    )
    images = {pointmap.name: noise for pointmap in pointmaps}
    return begin(pointmaps, images, cameras, completion.Config(), density.Config(), background.Config(), max_gaussians)


def test_a_scene_begins_with_the_registered_cameras_and_a_gaussian_for_what_they_saw():
    scene = begun()
    assert [(view.name, view.frame_id, view.rotation_sigma_deg) for view in scene.views] == [
        ("00.png", 0, 0.1),
        ("01.png", 1, 1.1),
    ]
    assert float(scene.views[1].T_world_camera[0, 3]) == pytest.approx(0.3)
    sources = scene.gaussians.source_frame
    # 16 x 12 cells of noise from the surer view; from the other what only it sees: 0.3 * 35.2 / 2 = 5.3 of 32 columns.
    assert int((sources == 0).sum()) == 16 * 12
    assert 2 * 12 <= int((sources == 1).sum()) <= 4 * 12
    assert int((sources == background.SOURCE_FRAME).sum()) > 10


@pytest.mark.parametrize("most", [150, 20])
def test_a_bound_on_gaussians_counts_the_shell(most):
    scene = begun(most)
    assert most // 4 <= len(scene.gaussians) <= most
    assert int((scene.gaussians.source_frame == background.SOURCE_FRAME).sum()) <= most // 10


def test_what_is_published_is_activated_and_a_copy():
    scene = scene_of(tiny_scene(), 3)
    arrays, cameras = scene.arrays(), scene.cameras()
    np.testing.assert_allclose(np.linalg.norm(arrays.quats, axis=1), 1, rtol=1e-5)
    np.testing.assert_allclose(arrays.scales, np.exp(scene.gaussians.log_scales.numpy()), rtol=1e-6)
    assert arrays.opacities.min() > 0 and arrays.opacities.max() < 1
    assert (cameras[1].name, cameras[1].width, cameras[1].height) == ("01.png", WIDTH, HEIGHT)
    assert cameras[1].T_world_camera.dtype == np.float64
    means, centre = scene.gaussians.means.clone(), scene.views[1].T_world_camera.clone()
    arrays.means[:], cameras[1].T_world_camera[:] = 0, 0
    assert torch.equal(scene.gaussians.means, means) and torch.equal(scene.views[1].T_world_camera, centre)
