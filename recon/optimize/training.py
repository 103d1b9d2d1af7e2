"""Joint refinement of Gaussians and camera poses against the photographs.

At each checkpoint, and at the end, the scene is asked: has it diverged, is it overfitted?
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import torch
from msgspec import Meta

from splatnode.capture.process.config import Internal
from splatnode.recon import verification
from splatnode.recon.optimize import ensemble as optimize_ensemble
from splatnode.recon.optimize import photometric_losses, regularizers
from splatnode.recon.optimize.control import ControlChoice, prune
from splatnode.recon.optimize.fit import PARAMETERS, Trainer
from splatnode.recon.optimize.photometric_losses import PhotometricLoss, make_training_image, scale_intrinsics
from splatnode.recon.optimize.regularizers import PointRender, PseudoView, render_points, sample_pseudo_views
from splatnode.recon.priors import compute_world_points
from splatnode.recon.rasterize import Camera, render_gaussians
from splatnode.recon.result.snapshot import SHELL
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.scene import Gaussians, Scene, TrainingView, compute_fit_masks, logit
from splatnode.recon.verification import decision

# How many threads torch computes with.


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """One thread for torch inside the block, and as many as before after it.

    The core has its own threads; torch's would only wait for each other over the little that is left to them. Their
    number holds for the whole process: a generator must not be suspended inside the block.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


Share = Annotated[float, Meta(ge=0, le=1)]
Rate = Annotated[float, Meta(ge=0, le=1)]
MIN_SOFT = 100  # iterations below which a refinement begins with opacities as seeded


class LearningRates(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Adam's step sizes at the start. Lengths are relative to the median depth of the scene, which is 1."""

    means: Rate = 0.4  # of positions, in `means_unit`
    # extent: standard deviations of each Gaussian along its axes; depth: the median depth, in every direction alike
    means_unit: Internal[Literal["extent", "depth"]] = "extent"
    quats: Rate = 2e-2  # of orientations, as quaternions
    log_scales: Rate = 1e-1  # of the logarithms of the standard deviations
    logit_opacities: Rate = 1e-1  # of the logits of the opacities
    sh: Rate = 3e-2  # of colours, as spherical harmonics
    translation: Internal[Rate] = 2e-4  # of cameras' positions
    rotation: Internal[Rate] = 2e-4  # of cameras' rotations, radians
    final_means: Internal[Share] = 0.1  # part to which the rate of the means has fallen at the end, exponentially
    final: Internal[Share] = 0.3  # part to which the other rates of the Gaussians have fallen
    final_pose: Internal[Share] = 0.1  # part to which those of the cameras have fallen


# Of few steps: steps of a share of a Gaussian's extent take some hundred to settle. Chosen for a refinement of 500.
CAUTIOUS = LearningRates(means=8e-4, means_unit="depth")


class RefinementConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The refinement of a scene; the preset `balanced` has these values, and fewer steps for doubtful scenes."""

    iterations: Annotated[int, Meta(ge=0)] = 500  # steps of the optimiser, one view each
    # Steps of a scene of which other views confirm little: more of them fit what nothing holds in its place, and cost
    # in views that are held out. null: always `iterations`
    doubtful_iterations: Annotated[int, Meta(ge=0)] | None = None
    # Iterations after which the scene is shown and judged, besides the last one
    checkpoints: Internal[tuple[int, ...]] = (150,)
    looks: Internal[tuple[int, ...]] = ()  # iterations after which it is shown, too, to somebody who watches
    half_resolution_share: Internal[Share] = 0.0  # share of the iterations, at the start, on images of half the size
    ssim_lambda: Share = 0.4  # weight of D-SSIM in the photometric loss; that of L1 is 1 minus it
    # Largest opacity of what photographs seeded, as the refinement of a begun scene starts: soft Gaussians settle more
    # freely, in a hundred steps and more, so they are left as seeded where a time limit may end it. null: as seeded
    first_opacity: Internal[Annotated[float, Meta(gt=0, lt=1)] | None] = 0.1
    perceptual: photometric_losses.PerceptualLossConfig = (
        photometric_losses.PerceptualLossConfig()
    )  # LPIPS of renders against photographs
    dropout: optimize_ensemble.DropoutConfig = optimize_ensemble.DropoutConfig()
    refine_poses: bool = True  # whether cameras are refined together with the Gaussians
    lr: LearningRates = LearningRates()  # Adam's learning rates at the start; lengths over the median depth
    regularizers: regularizers.RegularizerConfig = (
        regularizers.RegularizerConfig()
    )  # losses beside the photometric one; none by default
    # Density control, which adds and removes Gaussians; None: their number stays
    control: ControlChoice | None = ControlChoice("prune", prune.Config())
    ensemble: optimize_ensemble.EnsembleConfig = optimize_ensemble.EnsembleConfig()

    @property
    def steps(self) -> int:
        """Returns the number of steps of all refinements together."""
        one = self.ensemble.members == 1
        return self.iterations if one else self.ensemble.members * self.iterations + self.ensemble.iterations


DOUBTFUL, CERTAIN = 0.4, 0.5  # share of multi-view consistent depth up to which steps are few, and from which all


def limit_iterations(config: RefinementConfig, scene: Scene) -> RefinementConfig:
    """Returns the refinement with fewer iterations where little of the scene's depth is multi-view consistent.

    Between DOUBTFUL and CERTAIN of it their number grows from `doubtful_iterations` to `iterations`.
    """
    shares = [view.consistent_depth for view in scene.views if view.consistent_depth is not None]
    few = config.doubtful_iterations
    if few is None or few >= config.iterations or not shares:
        return config
    certainty = (sum(shares) / len(shares) - DOUBTFUL) / (CERTAIN - DOUBTFUL)
    iterations = round(few + min(max(certainty, 0.0), 1.0) * (config.iterations - few))
    return msgspec.structs.replace(config, iterations=iterations)


def refine(
    scene: Scene,
    config: RefinementConfig,
    *,
    seed: int,
    deadline: float | None = None,
    max_gaussians: int | None = None,
    gone_on: Callable[[int], None] = lambda done: None,
) -> Iterator[Scene]:
    """The scene at every checkpoint and at the end, after at most `config.steps` steps of one view each.

    `deadline` is a time of `time.monotonic()`: the step sizes fall so that they are at their end by then.
    `max_gaussians` is how many there may be at the end; it is for the control to see to that. `gone_on` hears after
    each step how many are done, and may raise to abandon the refinement.
    The first view stays where it is: it is the world. All is computed on the device of the scene's Gaussians, except
    that random numbers are drawn on the processor: they are the same everywhere.

    Of an ensemble the first member is shown until there is a scene that agrees with all of them. Where the deadline
    leaves no time for the others, the first one is the end.
    """
    run = partial(_run_refinement, deadline=deadline, max_gaussians=max_gaussians, gone_on=gone_on)
    if config.ensemble.members == 1:
        yield from run(scene, config, seed=seed)
        return
    started = time.monotonic()
    # Of LPIPS, which takes long, members do without: the refinement after them has it.
    alone = msgspec.structs.replace(config, perceptual=photometric_losses.PerceptualLossConfig())
    first = yield from run(scene, alone, seed=seed)
    took = time.monotonic() - started
    if deadline and started + took * config.steps / max(config.iterations, 1) > deadline:
        return
    members, unseen = [first], msgspec.structs.replace(alone, checkpoints=(), looks=())
    for member in range(1, config.ensemble.members):
        members += run(scene, unseen, seed=optimize_ensemble.seed_of(member, seed), done=member * config.iterations)
    if deadline and time.monotonic() >= deadline:
        return
    with single_torch_thread():
        beside = optimize_ensemble.render_between_views(members, config.ensemble, seed)
    done = sum(member.iterations - scene.iterations for member in members)
    agreeing = replace(first, iterations=scene.iterations + done)
    yield from run(agreeing, _make_agreement_config(config), seed=seed, done=done, beside=beside)


def _run_refinement(
    scene: Scene,
    config: RefinementConfig,
    *,
    seed: int,
    deadline: float | None,
    max_gaussians: int | None,
    gone_on: Callable[[int], None],
    done: int = 0,
    beside: Sequence[TrainingView] = (),
) -> Generator[Scene, None, Scene]:
    """One refinement, after `done` steps of others; its end is returned, too.

    Half of the steps are on the views `beside` those of the scene, if there are any.
    """
    with single_torch_thread():
        fit = Trainer(scene if deadline else _soften_initial_scene(scene, config), config, seed, max_gaussians, beside)
    order = np.random.default_rng(seed)
    own = np.arange(len(scene.views))
    turns = np.concatenate([np.resize(own, max(len(own), len(beside))), len(own) + np.arange(len(beside))])
    started = time.monotonic()
    queue: list[int] = []
    shown = {*config.checkpoints, *config.looks}
    for iteration in range(config.iterations):
        progress = iteration / config.iterations
        if deadline is not None:
            now = time.monotonic()
            if now >= deadline:
                break
            progress = max(progress, (now - started) / max(deadline - started, 1e-9))
        queue = queue or order.permutation(turns).tolist()
        with single_torch_thread():
            fit.step(queue.pop(), progress)
        gone_on(done + iteration + 1)
        if iteration + 1 in shown and iteration + 1 < config.iterations:
            yield fit.scene()
    end = replace(fit.scene(), losses=fit.losses())
    yield end
    return end


def _make_agreement_config(config: RefinementConfig) -> RefinementConfig:
    """Returns the configuration of the refinement after an ensemble."""
    given, rates = config.ensemble, config.lr
    shorter = {name: given.rates * getattr(rates, name) for name in PARAMETERS}
    return msgspec.structs.replace(
        config,
        iterations=given.iterations,
        checkpoints=(),
        looks=(),
        half_resolution_share=0.0,
        lr=msgspec.structs.replace(rates, **shorter),
        control=None,
    )


def _soften_initial_scene(scene: Scene, config: RefinementConfig) -> Scene:
    """A begun scene with its first opacities, if there are steps enough for them to grow.

    How often it is looked at meanwhile does not count: that would make another scene of it.
    """
    if scene.iterations or config.first_opacity is None or config.iterations < MIN_SOFT:
        return scene
    return replace(scene, gaussians=soften_opacities(scene.gaussians, config.first_opacity))


def soften_opacities(gaussians: Gaussians, most: float) -> Gaussians:
    """Limits opacities to `most`, but for the far shell's."""
    logits = gaussians.logit_opacities
    soft = torch.where(gaussians.source_frame == SHELL, logits, logits.clamp_max(logit(most)))
    return replace(gaussians, logit_opacities=soft)


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
    return verification.refuse(verification.DIVERGED, names, before=before, after=after)


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
    image = make_training_image(view, valid, _SCALE, _DSSIM, scene.gaussians.means.device, headroom=scene.headroom)
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
