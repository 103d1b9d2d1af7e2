"""What is asked of a scene at each checkpoint of its refinement, and at the end: has it diverged, is it overfitted?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
import torch

from splatnode.recon.optimize.photometric_losses import PhotometricLoss
from splatnode.recon.optimize.point_render import PointRender, render_points
from splatnode.recon.optimize.pseudo_views import PseudoView, sample_pseudo_views
from splatnode.recon.optimize.training import PARAMETERS, single_torch_thread
from splatnode.recon.optimize.training_image import make_training_image, scale_intrinsics
from splatnode.recon.priors.pointmap import compute_world_points
from splatnode.recon.rasterize.dispatch import Camera, render_gaussians
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.scene.scene import Gaussians, Scene, TrainingView, compute_fit_masks
from splatnode.recon.verification import decision, rejections

# Whether a refinement diverged: a scene that shows its photographs worse than before is no result.

WORSE = 1.1  # times the misfit that the scene began with; refinements that work end between .2 and .8 of it
_VIEWS = 4  # that are compared, at most
_SCALE = 0.5  # of the photographs' size
_DSSIM = 0.2  # weight of D-SSIM in the loss, as in 3DGS, whatever the refinement's is


def check_divergence(before: float, scene: Scene) -> Verdict | None:
    """The verdict on `scene` where its misfit is worse than the one `before` the refinement; else None."""
    after = compute_photometric_misfit(scene)
    if after <= WORSE * before:
        return None
    names = [view.name for view in scene.views]
    return rejections.refuse(rejections.DIVERGED, names, before=before, after=after)


def compute_photometric_misfit(scene: Scene) -> float:
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


# Whether a refinement made a scene worse where it was not fitted: between the photographs.
#
# From pseudo views, renders are compared with what the points of multi-view stereo show there. The points do not
# change with the refinement, whereas Gaussians that explain each photograph by themselves show as blur, spots and
# needles. View-dependent colours that serve a single photograph hardly show: scenes have none (docs/tried.md has the
# figures).

# Times the best misfit so far. With the presets it rose to 1.14 of it at most; with step sizes ten times as large, to
# 1.9 where held-out views lost at most .3 dB, and to 2.3 and 2.4 where they lost more than 1 dB.
OVERFITTED = 2.0
_PSEUDO_VIEWS = 2  # that are compared
_OFF_PATH = 0.1  # of a pseudo view, at most, in distances of neighbouring cameras
_STEP = 2  # pixels of a photograph, across and down, to one of the comparison
_SEEN_FROM = 2  # training views, the nearest ones, whose points show a pseudo view
_MIN_CONFIDENCE = 0.3  # of a point
_RADIUS_PX = 1.0  # of a point
_NEAREST_POINTS = 4  # that are blended in a pixel

Array = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ExpectedView:
    """A pseudo view as stereo predicts it."""

    camera: Camera
    loss: PhotometricLoss  # D-SSIM of a render, where there are points


def make_expectations(scene: Scene) -> tuple[ExpectedView, ...]:
    """Predicts views between the training views of `scene`; none with fewer than two point maps."""
    views = [view for view in scene.views if view.pointmap is not None]
    found = sample_pseudo_views(views, _PSEUDO_VIEWS, off_path=_OFF_PATH, rng=np.random.default_rng(0))
    with single_torch_thread():
        return tuple(_make_expected_view(views, view, scene.gaussians.means.device) for view in found)


def compute_dssim_misfit(expectations: Sequence[ExpectedView], gaussians: Gaussians) -> float:
    """The mean D-SSIM between what the Gaussians show and what is expected; 0 where nothing is expected."""
    with single_torch_thread():
        losses = [float(each.loss(_render_rgb(gaussians, each.camera))) for each in expectations]
    return sum(losses) / max(len(losses), 1)


def _render_rgb(gaussians: Gaussians, camera: Camera) -> torch.Tensor:
    rgb = render_gaussians(gaussians, camera).rgb
    assert rgb is not None  # it was asked for
    return rgb


def _make_expected_view(views: Sequence[TrainingView], pseudo: PseudoView, device: torch.device) -> ExpectedView:
    centre = pseudo.T_world_camera[:3, 3]
    distances = [float(np.linalg.norm(view.T_world_camera[:3, 3].double().numpy() - centre)) for view in views]
    nearest = [views[i] for i in np.argsort(distances, kind="stable")[:_SEEN_FROM]]
    T_world_camera, K = pseudo.camera.T_world_camera, pseudo.camera.K
    camera = Camera(T_world_camera, *scale_intrinsics(K, pseudo.width, pseudo.height, 1 / _STEP))
    shown = _point_render(nearest, pseudo.T_world_camera, camera)
    weights = torch.from_numpy(shown.seen.astype(np.float32)).to(device)
    return ExpectedView(camera, PhotometricLoss(torch.from_numpy(shown.rgb).to(device), 1.0, weights))


def _point_render(
    views: Sequence[TrainingView], T_world_camera: npt.NDArray[np.float64], camera: Camera
) -> PointRender:
    """The confident points of `views`, one for each pixel of the comparison, as `camera` sees them."""
    parts = [_points(view) for view in views]
    points, colours, normals = (np.concatenate(part) for part in zip(*parts, strict=True))
    return render_points(
        points,
        colours,
        normals,
        T_world_camera,
        camera.K.double().numpy(),
        camera.width,
        camera.height,
        nearest=_NEAREST_POINTS,
        radius=_RADIUS_PX,
    )


def _points(view: TrainingView) -> tuple[Array, Array, Array]:
    """Points (M, 3), colours (M, 3) in [0, 1] and normals (M, 3) in the world, of every other row and column."""
    pointmap = view.pointmap
    assert pointmap is not None  # `make_expectations` looks at no others
    depth, confidence = pointmap.depth[::_STEP, ::_STEP], pointmap.confidence[::_STEP, ::_STEP]
    kept = (confidence >= _MIN_CONFIDENCE) & (depth > 0)
    T_world_camera, K = view.T_world_camera.double().numpy(), view.K.double().numpy()
    points = compute_world_points(depth, T_world_camera, K / np.array([[_STEP], [_STEP], [1.0]]))
    image = cv2.resize(view.image, depth.shape[::-1], interpolation=cv2.INTER_AREA)
    normals = pointmap.normal[::_STEP, ::_STEP][kept] @ T_world_camera[:3, :3].T
    colours = image[kept].astype(np.float32)
    colours /= 255.0
    return points[kept], colours, normals.astype(np.float32)


# Iterations up to which a refinement is not tested for overfitting, because the test takes as long as 10 of them: no
# set of photographs lost held-out quality within 200.
SHORT = 250


@dataclass(frozen=True, eq=False)
class RefinementWatch:
    """The reference that later scenes of a refinement are compared with."""

    begun_misfit: float  # photometric loss of the scene before the refinement
    expectations: tuple[ExpectedView, ...]  # between the photographs
    best: Scene  # of those so far, the one that fits the expectations best
    best_misfit: float  # of that one with the expectations


def start_watch(begun: Scene, iterations: int) -> RefinementWatch:
    """The watch over a refinement of `begun` in so many iterations."""
    expectations = make_expectations(begun) if iterations > SHORT else ()
    return RefinementWatch(
        compute_photometric_misfit(begun), expectations, begun, compute_dssim_misfit(expectations, begun.gaussians)
    )


def examine(watch: RefinementWatch, later: Scene) -> tuple[RefinementWatch, Verdict | None]:
    """The watch over what comes after `later`, and a verdict where the refinement should end with it; else None.

    DIVERGED is not publishable: there is no scene. OVERFIT is publishable with the scene `watch.best`.
    """
    diverged = check_divergence(watch.begun_misfit, later)
    if diverged is not None:
        return watch, diverged
    misfit = compute_dssim_misfit(watch.expectations, later.gaussians)
    if misfit > OVERFITTED * watch.best_misfit:
        names = [view.name for view in later.views]
        kept = watch.best.iterations
        return watch, decision.make_overfit_verdict(names, later.iterations, kept, watch.best_misfit, misfit)
    if misfit < watch.best_misfit:
        watch = replace(watch, best=later, best_misfit=misfit)
    return watch, None
