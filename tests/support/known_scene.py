"""A tiny scene whose answer is known, and the same disturbed: what refinements are tried on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from splatnode.recon.geometry import exp_se3
from splatnode.recon.rasterize import Camera, render_gaussians
from splatnode.recon.scene import Gaussians, Scene, TrainingView
from tests.support.synthetic import tiny_scene


def render(gaussians: Gaussians, view: TrainingView) -> torch.Tensor:
    camera = Camera(view.T_world_camera, view.K, view.width, view.height)
    return render_gaussians(gaussians, camera).rgb.clamp(0, 1)


def photographed() -> Scene:
    """Three photographs of Gaussians, and these Gaussians."""
    tiny = tiny_scene(seed=3, width=64, height=48)
    views = []
    for index, (T, K) in enumerate(zip(tiny.Ts_world_camera, tiny.Ks, strict=True)):
        empty = np.zeros((tiny.height, tiny.width, 3), np.uint8)
        view = TrainingView(f"{index}.png", index, empty, T, K)
        image = (255 * render(tiny.gaussians, view)).round().byte().numpy()
        views.append(replace(view, image=image))
    return Scene(tuple(views), tiny.gaussians, iterations=7)


def disturbed(scene: Scene) -> Scene:
    """Other colours, places and sizes."""
    generator = torch.Generator().manual_seed(0)

    def noise(like: torch.Tensor) -> torch.Tensor:
        return torch.randn(like.shape, generator=generator)

    gaussians = scene.gaussians
    return replace(
        scene,
        gaussians=replace(
            gaussians,
            means=gaussians.means + 0.03 * noise(gaussians.means),
            log_scales=gaussians.log_scales + 0.1 * noise(gaussians.log_scales),
            sh=gaussians.sh + 0.4 * noise(gaussians.sh),
        ),
    )


def many_gaussians() -> Scene:
    """5000 Gaussians in photographs of noise, 320 x 240: a step's tensors are as large as those of a real scene."""
    scene, generator = photographed(), torch.Generator().manual_seed(0)
    drawn = torch.randint(len(scene.gaussians), (5000,), generator=generator)
    K = torch.tensor([[320.0, 0, 160], [0, 320, 120], [0, 0, 1]])
    noise = torch.randint(256, (len(scene.views), 240, 320, 3), generator=generator, dtype=torch.uint8).numpy()
    views = tuple(replace(view, image=image, K=K) for view, image in zip(scene.views, noise, strict=True))
    return replace(scene, views=views, gaussians=disturbed(scene).gaussians.subset(drawn))


def turned(scene: Scene, degrees: float = 0.7, shift: float = 0.02) -> Scene:
    """All cameras but the first held wrongly."""
    twist = torch.tensor([shift, -shift, 0.5 * shift, *np.radians([degrees, -degrees, 0.5 * degrees])]).float()
    views = [
        replace(view, T_world_camera=view.T_world_camera @ exp_se3(twist * (-1) ** index)) if index else view
        for index, view in enumerate(scene.views)
    ]
    return replace(scene, views=tuple(views))
