"""What a scene begins with, and what it tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatnode.capture.process.config import parse_config
from splatnode.recon import keyframes
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.priors import Pointmap
from splatnode.recon.result.snapshot import decode_frame_id
from splatnode.recon.scene import Scene, background, initialization
from splatnode.recon.scene.initialization import initialize_scene
from tests.support.synthetic import plane_pointmap

WIDTH, HEIGHT = 32, 24


def begun(max_gaussians: int | None = None, by_pixel: initialization.PixelwiseConfig | None = None) -> Scene:
    """Two views of a wall of noise, one step apart."""
    step = np.eye(4)
    step[0, 3] = 0.3
    pointmaps = tuple(
        plane_pointmap(T, confidence=c, frame_id=i) for i, (T, c) in enumerate([(np.eye(4), 0.9), (step, 0.5)])
    )
    return scene_of(pointmaps, max_gaussians, by_pixel)


def scene_of(
    pointmaps: tuple[Pointmap, ...],
    max_gaussians: int | None = None,
    by_pixel: initialization.PixelwiseConfig | None = None,
) -> Scene:
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    images = {pointmap.name: noise for pointmap in pointmaps}
    config = initialization.SceneInitializationConfig(pixelwise=by_pixel, max_gaussians=max_gaussians)
    return initialize_scene(pointmaps, images, config)


def test_a_scene_begins_with_the_registered_cameras_and_a_gaussian_for_what_they_saw():
    scene = begun()
    assert [(view.name, view.frame_id) for view in scene.views] == [("00.png", 0), ("01.png", 1)]
    assert float(scene.views[1].T_world_camera[0, 3]) == pytest.approx(0.3)
    sources = decode_frame_id(scene.gaussians.source_frame)
    # Every pixel of noise from the surer view; from the other what only it sees: 0.3 * 35.2 / 2 = 5.3 of 32 columns.
    assert int((sources == 0).sum()) == 32 * 24
    assert 4 * 24 <= int((sources == 1).sum()) <= 6 * 24
    assert int((sources == background.SHELL).sum()) > 10


def test_depths_that_stereo_does_not_believe_in_move_neither_surfaces_nor_the_shell():
    sure = tuple(plane_pointmap(np.eye(4), confidence=c, frame_id=i) for i, c in enumerate((0.9, 0.8)))
    doubtful = tuple(replace(pointmap, depth=pointmap.depth.copy()) for pointmap in sure)
    for pointmap in (sure[1], doubtful[1]):
        pointmap.confidence[:8] = 0.05
    doubtful[1].depth[:8] = 50.0
    assert torch.equal(scene_of(sure).gaussians.means, scene_of(doubtful).gaussians.means)


@pytest.mark.parametrize("by_pixel", [None, initialization.PixelwiseConfig()])
def test_nothing_begins_where_photographs_do_not_show_the_scene(by_pixel, monkeypatch):
    right = np.broadcast_to(np.arange(WIDTH) >= 8, (HEIGHT, WIDTH))
    monkeypatch.setattr(keyframes, "valid_masks", lambda images: [right] * len(images))
    scene = begun(by_pixel=by_pixel)
    for view in scene.views:
        assert view.pointmap is not None and not view.pointmap.depth[~right].any()
        own = scene.gaussians.means[decode_frame_id(scene.gaussians.source_frame) == view.frame_id]
        x, _, z = ((own - view.T_world_camera[:3, 3]) @ view.K.T).unbind(1)
        assert len(own) > 0 and bool((x / z > 7.9).all())


@pytest.mark.parametrize("most", [None, 100])
def test_by_pixel_a_scene_has_what_stereo_knows_and_nothing_else(most):
    scene = begun(most, initialization.PixelwiseConfig(opacity=0.1))
    assert len(scene.views) == 2 and set(scene.gaussians.source_frame.tolist()) == {0, 1}
    assert len(scene.gaussians) == most or len(scene.gaussians) > WIDTH * HEIGHT
    torch.testing.assert_close(scene.gaussians.opacities, torch.full((len(scene.gaussians),), 0.1))


def test_a_gaussian_a_pixel_is_asked_for_by_naming_it_in_the_configuration():
    assert ReconstructionConfig().pixelwise is None
    chosen = parse_config({"pixelwise": {"opacity": 0.2}}, ReconstructionConfig).pixelwise
    assert chosen is not None and chosen.opacity == 0.2


@pytest.mark.parametrize("most", [150, 20])
def test_a_bound_on_gaussians_counts_the_shell(most):
    scene = begun(most)
    assert most // 4 <= len(scene.gaussians) <= most
    assert int((scene.gaussians.source_frame == background.SHELL).sum()) <= most // 10


def test_what_is_published_is_activated_and_a_copy():
    scene = begun()
    arrays, cameras = scene.arrays(), scene.cameras()
    np.testing.assert_allclose(np.linalg.norm(arrays.quats, axis=1), 1, rtol=1e-5)
    np.testing.assert_allclose(arrays.scales, np.exp(scene.gaussians.log_scales.numpy()), rtol=1e-6)
    assert arrays.opacities.min() > 0 and arrays.opacities.max() < 1
    assert (cameras[1].name, cameras[1].width, cameras[1].height) == ("01.png", WIDTH, HEIGHT)
    assert cameras[1].T_world_camera.dtype == np.float64
    means, centre = scene.gaussians.means.clone(), scene.views[1].T_world_camera.clone()
    arrays.means[:], cameras[1].T_world_camera[:] = 0, 0
    assert torch.equal(scene.gaussians.means, means) and torch.equal(scene.views[1].T_world_camera, centre)


def test_a_gaussian_a_pixel_may_begin_with_our_surroundings():
    """A stripe that stereo does not know: empty as published, before the shell, or filled and before the shell."""
    pointmaps = tuple(plane_pointmap(np.eye(4), confidence=c, frame_id=i) for i, c in enumerate((0.9, 0.8)))
    for pointmap in pointmaps:
        pointmap.confidence[:4] = 0.01
    begun = {
        each: scene_of(pointmaps, None, initialization.PixelwiseConfig(surroundings=each))
        for each in ("none", "shell", "fill")
    }
    shell = {each: int((scene.gaussians.source_frame == background.SHELL).sum()) for each, scene in begun.items()}
    surfaces = {each: len(scene.gaussians) - shell[each] for each, scene in begun.items()}
    assert shell["none"] == 0 and shell["shell"] == shell["fill"] > 10
    assert surfaces["none"] == surfaces["shell"] == 20 * WIDTH
    assert surfaces["fill"] == 24 * WIDTH
    filled = begun["fill"].views[0].pointmap
    assert filled is not None and (filled.depth[:4] > 0).all() and (filled.confidence[:4] > 0.05).all()
    limited = scene_of(pointmaps, 200, initialization.PixelwiseConfig(surroundings="fill"))
    assert len(limited.gaussians) <= 200
