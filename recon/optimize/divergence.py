"""Whether the refinement ruined a scene: then it is no result, however right its cameras were at the start."""

from __future__ import annotations

import math

import numpy as np

from splatnode.recon.optimize.refinement import PARAMETERS
from splatnode.recon.optimize.training_image import training_image
from splatnode.recon.rasterize.gaussian_render import Camera, render_gaussians
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.scene.scene import Scene, TrainingView
from splatnode.recon.verification import refusals

WORSE = 1.1  # times the misfit that the scene began with; refinements that work end between .2 and .8 of it
_LOOKED_AT = 4  # views at most
_SCALE = 0.5  # of the photographs' size
_DSSIM = 0.2


def refusal(before: float, scene: Scene) -> Verdict | None:
    """The verdict on `scene` where its misfit is worse than the one `before` the refinement; else None."""
    after = misfit(scene)
    if after <= WORSE * before:
        return None
    names = [view.name for view in scene.views]
    return refusals.refuse(refusals.DIVERGED, names, before=before, after=after)


def misfit(scene: Scene) -> float:
    """The mean photometric loss over some views; infinite where the scene has become numbers that none can show."""
    if not all(bool(getattr(scene.gaussians, name).isfinite().all()) for name in PARAMETERS):
        return math.inf
    views = scene.views[:: math.ceil(len(scene.views) / _LOOKED_AT)]
    return sum(_misfit(scene, view) for view in views) / len(views)


def _misfit(scene: Scene, view: TrainingView) -> float:
    image = training_image(view, np.ones((view.height, view.width), np.bool_), _SCALE, _DSSIM)
    camera = Camera(view.T_world_camera, image.K, image.width, image.height)
    rgb = render_gaussians(scene.gaussians, camera).rgb
    assert rgb is not None  # it was asked for
    return float(image.loss(rgb))
