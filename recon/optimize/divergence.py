"""Whether a refinement diverged: a scene that shows its photographs worse than before is no result."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from splatnode.recon.optimize.refinement import PARAMETERS
from splatnode.recon.optimize.torch_threads import single_torch_thread
from splatnode.recon.optimize.training_image import make_training_image
from splatnode.recon.rasterize.gaussian_render import Camera, render_gaussians
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.scene.scene import Scene, TrainingView, compute_fit_masks
from splatnode.recon.verification import refusals

WORSE = 1.1  # times the misfit that the scene began with; refinements that work end between .2 and .8 of it
_VIEWS = 4  # that are compared, at most
_SCALE = 0.5  # of the photographs' size
_DSSIM = 0.2  # weight of D-SSIM in the loss, as in 3DGS, whatever the refinement's is


def check_divergence(before: float, scene: Scene) -> Verdict | None:
    """The verdict on `scene` where its misfit is worse than the one `before` the refinement; else None."""
    after = misfit(scene)
    if after <= WORSE * before:
        return None
    names = [view.name for view in scene.views]
    return refusals.refuse(refusals.DIVERGED, names, before=before, after=after)


def misfit(scene: Scene) -> float:
    """The mean photometric loss over some training views, without the black border of undistorted photographs.

    Infinite where the scene has parameters that are not finite, which nothing can render.
    """
    if not all(bool(getattr(scene.gaussians, name).isfinite().all()) for name in PARAMETERS):
        return math.inf
    valid = compute_fit_masks(scene.views)
    compared = list(zip(scene.views, valid, strict=True))[:: math.ceil(len(scene.views) / _VIEWS)]
    with single_torch_thread():
        return sum(_misfit(scene, *each) for each in compared) / len(compared)


def _misfit(scene: Scene, view: TrainingView, valid: npt.NDArray[np.bool_]) -> float:
    image = make_training_image(view, valid, _SCALE, _DSSIM, scene.gaussians.means.device)
    camera = Camera(view.T_world_camera, image.K, image.width, image.height)
    rgb = render_gaussians(scene.gaussians, camera).rgb
    assert rgb is not None  # it was asked for
    return float(image.loss(rgb))
