"""Pictures without torch are those of the rasteriser."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon import rasterize
from splatnode.recon.rasterize import reference
from splatnode.recon.result.rendering import NEAR, render_arrays
from splatnode.recon.result.snapshot import GaussianArrays
from tests.support.synthetic import TinyScene, tiny_scene


def arrays(scene: TinyScene) -> GaussianArrays:
    gaussians = scene.gaussians
    return GaussianArrays(
        means=gaussians.means.numpy(),
        quats=gaussians.quats.numpy(),
        scales=gaussians.scales.numpy(),
        opacities=gaussians.opacities.numpy(),
        sh=gaussians.sh.numpy(),
        source_frame=gaussians.source_frame.numpy(),
    )


@pytest.mark.parametrize("bases", [1, 4])
def test_every_channel_equals_the_rasterisers(bases):
    scene = tiny_scene(bases=bases)
    gaussians = scene.gaussians
    render = rasterize.rasterize_on_cpu(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh,
        scene.Ts_world_camera[1], scene.Ks[1], scene.width, scene.height,
    )  # fmt: skip
    T_world_camera, K = scene.Ts_world_camera[1].numpy(), scene.Ks[1].numpy()
    channels = ("rgb", "depth", "normal", "alpha")
    picture = render_arrays(arrays(scene), T_world_camera, K, scene.width, scene.height, channels=channels)
    for name in channels:
        assert np.array_equal(getattr(picture, name), getattr(render, name).numpy()), name
    assert picture.alpha.max() > 0.5


def test_channels_that_nobody_asked_for_are_empty():
    scene = tiny_scene()
    camera = scene.Ts_world_camera[0].numpy(), scene.Ks[0].numpy(), scene.width, scene.height
    picture = render_arrays(arrays(scene), *camera, channels=("depth",))
    assert picture.depth.shape == (scene.height, scene.width) and picture.rgb.size == 0 and picture.normal.size == 0


def test_what_cannot_be_drawn_is_refused():
    scene = tiny_scene()
    camera = scene.Ts_world_camera[0].numpy(), scene.Ks[0].numpy(), scene.width, scene.height
    whole = arrays(scene)
    with pytest.raises(ValueError, match="must have the shapes"):
        render_arrays(replace(whole, scales=whole.scales[:-1]), *camera)
    with pytest.raises(ValueError, match="opacities must be from 0 to 1"):
        render_arrays(replace(whole, opacities=whole.opacities + 2), *camera)
    with pytest.raises(ValueError, match="channels must be of"):
        render_arrays(whole, *camera, channels=("colour",))


def test_the_near_plane_is_the_definitions():
    assert NEAR == reference.NEAR
