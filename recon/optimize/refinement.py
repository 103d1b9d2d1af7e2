"""Joint refinement of Gaussians and camera poses against the photographs."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from typing import Annotated, Literal

import msgspec
import numpy as np
import torch
from msgspec import Meta
from torch import Tensor

from splatnode.recon.geometry import exp_se3, twist_gradient
from splatnode.recon.optimize import dropout, perceptual_loss, regularise
from splatnode.recon.optimize.adam import Adam, Moments, adam_direction
from splatnode.recon.optimize.control import prune
from splatnode.recon.optimize.control.control import Control, ControlChoice, Step
from splatnode.recon.optimize.own_axes import Shifts
from splatnode.recon.optimize.pseudo_views import PseudoView
from splatnode.recon.optimize.regularise import Regularisation
from splatnode.recon.optimize.torch_threads import single_torch_thread
from splatnode.recon.optimize.training_image import TrainingImage, training_image
from splatnode.recon.rasterize.gaussian_render import Camera, render_gaussians
from splatnode.recon.rasterize.render import Render
from splatnode.recon.result.sources import SHELL
from splatnode.recon.scene.gaussians import Gaussians, logit
from splatnode.recon.scene.scene import Scene, fitted_pixels

Share = Annotated[float, Meta(ge=0, le=1)]
Rate = Annotated[float, Meta(ge=0, le=1)]
PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh")  # of Gaussians, that are optimised
_SCALES = {False: 1.0, True: 0.5}  # of the photographs' resolution, by whether it is halved
MIN_SOFT = 100  # iterations, at the end or a checkpoint, below which a refinement begins with opacities as seeded
_KEPT_PIXELS = 5_000_000  # of all views: of more, what the loss needs of a photograph is computed at each step
_PROCESSOR = torch.device("cpu")  # where the cameras are, whatever the Gaussians are on
_POSE_BETAS = (0.9, 0.99)  # of Adam for the cameras: each gets one gradient in as many steps as there are views


class Rates(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Adam's step sizes at the start. Lengths are relative to the median depth of the scene, which is 1."""

    means: Rate = 0.4  # of positions, in `means_unit`
    # extent: standard deviations of each Gaussian along its axes; depth: the median depth, in every direction alike
    means_unit: Literal["extent", "depth"] = "extent"
    quats: Rate = 2e-2  # of orientations, as quaternions
    log_scales: Rate = 1e-1  # of the logarithms of the standard deviations
    logit_opacities: Rate = 1e-1  # of the logits of the opacities
    sh: Rate = 3e-2  # of colours, as spherical harmonics
    translation: Rate = 2e-4  # of cameras' positions
    rotation: Rate = 2e-4  # of cameras' rotations, radians
    final_means: Share = 0.1  # part to which the rate of the means has fallen at the end, exponentially
    final: Share = 0.3  # part to which the other rates of the Gaussians have fallen
    final_pose: Share = 0.1  # part to which those of the cameras have fallen


# Of few steps: steps of a share of a Gaussian's extent take some hundred to settle. Chosen for a refinement of 500.
CAUTIOUS = Rates(means=8e-4, means_unit="depth")


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The refinement of the preset `balanced`."""

    iterations: Annotated[int, Meta(ge=0)] = 500  # steps of the optimiser, one view each
    checkpoints: tuple[int, ...] = (150,)  # iterations after which the scene is shown, besides the last one
    half_resolution_share: Share = 0.0  # share of the iterations, at the start, on images of half the size
    dssim: Share = 0.4  # weight of D-SSIM in the photometric loss; that of L1 is 1 minus it
    # Largest opacity of what photographs seeded, as the refinement of a begun scene starts: soft Gaussians settle more
    # freely, in a hundred steps and more, so they are left as seeded where a time limit may end it. null: as seeded
    first_opacity: Annotated[float, Meta(gt=0, lt=1)] | None = 0.1
    perceptual: perceptual_loss.Config = perceptual_loss.Config()  # LPIPS of renders against photographs
    dropout: dropout.Config = dropout.Config()
    refine_poses: bool = True  # whether cameras are refined together with the Gaussians
    rates: Rates = Rates()
    regularise: regularise.Config = regularise.Config()  # losses beside the photometric one; none by default
    # Density control, which adds and removes Gaussians; None: their number stays
    control: ControlChoice | None = ControlChoice("prune", prune.Config())


def refine(
    scene: Scene,
    config: Config,
    *,
    seed: int,
    deadline: float | None = None,
    max_gaussians: int | None = None,
    gone_on: Callable[[int], None] = lambda done: None,
) -> Iterator[Scene]:
    """The scene at every checkpoint and at the end, after at most `config.iterations` steps of one view each.

    `deadline` is a time of `time.monotonic()`: the step sizes fall so that they are at their end by then.
    `max_gaussians` is how many there may be at the end; it is for the control to see to that. `gone_on` hears after
    each step how many are done.
    The first view stays where it is: it is the world. All is computed on the device of the scene's Gaussians, except
    that random numbers are drawn on the processor: they are the same everywhere.
    """
    with single_torch_thread():
        fit = _Fit(scene if deadline else _soft(scene, config), config, seed, max_gaussians)
    order = np.random.default_rng(seed)
    started = time.monotonic()
    queue: list[int] = []
    for iteration in range(config.iterations):
        progress = iteration / config.iterations
        if deadline is not None:
            now = time.monotonic()
            if now >= deadline:
                break
            progress = max(progress, (now - started) / max(deadline - started, 1e-9))
        queue = queue or order.permutation(len(scene.views)).tolist()
        with single_torch_thread():
            fit.step(queue.pop(), progress)
        gone_on(iteration + 1)
        if iteration + 1 in config.checkpoints and iteration + 1 < config.iterations:
            yield fit.scene()
    yield replace(fit.scene(), losses=fit.losses())


def _soft(scene: Scene, config: Config) -> Scene:
    """A begun scene with its first opacities, if there are steps enough for them to grow before it is looked at."""
    if scene.iterations or config.first_opacity is None or min((config.iterations, *config.checkpoints)) < MIN_SOFT:
        return scene
    return replace(scene, gaussians=softened(scene.gaussians, config.first_opacity))


def softened(gaussians: Gaussians, most: float) -> Gaussians:
    """With opacities of at most `most`, but for the far shell's."""
    logits = gaussians.logit_opacities
    soft = torch.where(gaussians.source_frame == SHELL, logits, logits.clamp_max(logit(most)))
    return replace(gaussians, logit_opacities=soft)


class _Fit:
    """Parameters, targets and optimisers of one refinement."""

    def __init__(self, scene: Scene, config: Config, seed: int, max_gaussians: int | None = None) -> None:
        self._scene, self._config, self._max_gaussians = scene, config, max_gaussians
        gaussians = scene.gaussians.map(lambda tensor: tensor.clone())
        self._gaussians = gaussians
        rates = config.rates
        self._rates = {name: getattr(rates, name) for name in PARAMETERS}
        self._finals = dict.fromkeys(PARAMETERS, rates.final) | {"means": rates.final_means}
        self._shifts = Shifts(gaussians) if rates.means_unit == "extent" else None  # who moves the means; None: Adam
        moved = _leaves(gaussians, self._shifts)
        self._adam = Adam(moved, {name: self._rates[name] for name in moved})
        self._control: Control | None = None
        if config.control is not None:
            self._control = config.control.module.load(config.control.config, seed)
        self._dropout = dropout.Dropout(config.dropout, gaussians, scene.views, seed)
        self._Ts_world_camera = [view.T_world_camera.clone() for view in scene.views]
        self._pose_rates = torch.tensor([rates.translation] * 3 + [rates.rotation] * 3)
        self._pose_moments = [Moments(torch.zeros(6), torch.zeros(6)) for _ in scene.views]
        shown = fitted_pixels(scene.views)
        few = sum(view.width * view.height for view in scene.views) <= _KEPT_PIXELS
        device = gaussians.means.device
        self._measure = perceptual_loss.load(config.perceptual, device)
        self._images = {
            half: [
                training_image(*each, scale, config.dssim, device, keep=few, measure=self._measure)
                for each in zip(scene.views, shown, strict=True)
            ]
            for half, scale in _SCALES.items()
            if config.half_resolution_share > 0 or not half
        }
        self._regularisation = _regularisation(scene, config.regularise, seed)
        self._iterations = scene.iterations
        self._losses: list[Tensor] = []  # photometric, of each step

    def step(self, index: int, progress: float) -> None:
        """One iteration on view `index`; `progress` in [0, 1] sets resolution and step sizes."""
        half = progress < self._config.half_resolution_share
        image = self._images[half][index]
        refine_pose = self._config.refine_poses and index > 0
        on_device = self._Ts_world_camera[index].to(self._gaussians.means.device, non_blocking=True)
        T_world_camera = on_device.requires_grad_(refine_pose)
        channels = self._regularisation.channels(progress) if self._regularisation else ("rgb",)
        opacities = self._dropout(self._gaussians.opacities, progress)
        camera = Camera(T_world_camera, image.K, image.width, image.height)
        render = render_gaussians(self._gaussians, camera, channels, opacities=opacities)
        assert render.rgb is not None  # it was asked for
        loss = image.loss(render.rgb)
        self._losses.append(loss.detach())
        weight = self._config.perceptual.in_step(self._done, progress)
        if image.perceptual is not None and weight:
            loss = loss + weight * image.perceptual(render.rgb)
        if self._regularisation is not None:
            loss = loss + self._further_losses(self._regularisation, index, render, progress).to(loss)
        loss.backward()
        self._move_gaussians(progress)
        if refine_pose and T_world_camera.grad is not None:
            gradient = twist_gradient(self._Ts_world_camera[index].detach(), T_world_camera.grad.to(_PROCESSOR))
            self._move_camera(index, gradient, self._config.rates.final_pose**progress)
        self._iterations += 1
        self._control_density(index, self._images[half], progress)
        self._adam.zero_grad()
        self._gaussians.means.grad = None

    @property
    def _done(self) -> int:
        """Steps of this refinement."""
        return self._iterations - self._scene.iterations

    def _move_gaussians(self, progress: float) -> None:
        """An Adam step of all parameters of the Gaussians."""
        rates = {name: rate * self._finals[name] ** progress for name, rate in self._rates.items()}
        if self._shifts is not None:
            self._shifts.step(self._gaussians, rates.pop("means"))
        self._adam.lrs = rates
        self._adam.step()

    def _control_density(self, index: int, images: Sequence[TrainingImage], progress: float) -> None:
        if self._control is None:
            return
        cameras = tuple(T.detach() for T in self._Ts_world_camera)
        change = self._control.after_step(
            Step(
                iteration=self._done,
                iterations=self._config.iterations,
                progress=progress,
                view=index,
                gaussians=self._gaussians,
                Ts_world_camera=cameras,
                images=images,
                max_gaussians=self._max_gaussians,
            )
        )
        if change is not None:
            self._gaussians = change.gaussians
            self._adam.follow(_leaves(change.gaussians, self._shifts), change.origin)
            if self._shifts is not None:
                self._shifts.follow(change.gaussians, change.origin)
            self._dropout.follow(change.gaussians)

    def _further_losses(self, regularisation: Regularisation, index: int, render: Render, progress: float) -> Tensor:
        """The losses beside the photometric one on training view `index`, as rendered, and on a pseudo view.

        They are computed on the processor, where their networks and targets are.
        """

        def draw(view: PseudoView, channels: Collection[str]) -> Render:
            return render_gaussians(self._gaussians, view.camera, channels).on(_PROCESSOR)

        on_training_view = regularisation.training_loss(index, render.on(_PROCESSOR), progress)
        parts = (on_training_view, regularisation.pseudo_loss(draw, progress))
        return sum((part for part in parts if part is not None), torch.zeros(()))

    def _move_camera(self, index: int, gradient: Tensor, decay: float) -> None:
        """An Adam step of the camera in its own frame."""
        direction, self._pose_moments[index] = adam_direction(gradient, self._pose_moments[index], _POSE_BETAS)
        T_world_camera = self._Ts_world_camera[index].detach()
        self._Ts_world_camera[index] = T_world_camera @ exp_se3(-decay * self._pose_rates * direction)

    def losses(self) -> tuple[float, ...]:
        """The photometric one of each step."""
        return tuple(torch.stack(self._losses).tolist()) if self._losses else ()

    def scene(self) -> Scene:
        """What has been learnt so far."""
        views = tuple(
            replace(view, T_world_camera=T.detach().clone())
            for view, T in zip(self._scene.views, self._Ts_world_camera, strict=True)
        )
        learnt = self._gaussians.map(lambda tensor: tensor.detach().clone())
        served_by = {} if self._regularisation is None else dict(self._regularisation.served_by)
        if self._config.perceptual.weight:
            served_by["perceptual"] = self._measure.name if self._measure else "nothing: no weights"
        return Scene(views, learnt, self._iterations, served_by=served_by, headroom=self._scene.headroom)


def _leaves(gaussians: Gaussians, shifts: Shifts | None) -> dict[str, Tensor]:
    """What Adam moves, by name: all parameters, but for the means where `shifts` moves them."""
    leaves = {name: getattr(gaussians, name).requires_grad_(True) for name in PARAMETERS}
    if shifts is not None:
        del leaves["means"]
    return leaves


def _regularisation(scene: Scene, config: regularise.Config, seed: int) -> Regularisation | None:
    """The losses beside the photometric one; None where all weights are 0.

    Raises ValueError where they would compare with what is known of a view, and nothing is.
    """
    if not config.weighted:
        return None
    pointmaps = []
    for view in scene.views:
        if view.pointmap is None:
            raise ValueError(f"{view.name} has no point map, which the losses in `regularise` compare with")
        T_world_camera = view.T_world_camera.double().numpy()
        pointmaps.append(replace(view.pointmap, T_world_camera=T_world_camera, K=view.K.double().numpy()))
    return Regularisation(pointmaps, [view.image for view in scene.views], config, seed=seed)
