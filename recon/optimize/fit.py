"""Fit: the parameters, targets and optimisers of one refinement, and its steps."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.geometry import exp_se3, twist_gradient
from splatnode.recon.optimize import ensemble, photometric_losses, regularizers
from splatnode.recon.optimize.control.control import Control, OptimizerStep
from splatnode.recon.optimize.optimizer import Adam, Moments, Shifts, adam_direction
from splatnode.recon.optimize.pseudo_views import PseudoView
from splatnode.recon.optimize.regularizers import Regularizer
from splatnode.recon.optimize.training_image import TrainingImage, make_training_image
from splatnode.recon.rasterize.dispatch import Camera, render_gaussians
from splatnode.recon.rasterize.reference import Render
from splatnode.recon.scene.scene import Gaussians, Scene, TrainingView, compute_fit_masks

if TYPE_CHECKING:
    from splatnode.recon.optimize.training import RefinementConfig

PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh")  # of Gaussians, that are optimised
_SCALES = {False: 1.0, True: 0.5}  # of the photographs' resolution, by whether it is halved
_KEPT_PIXELS = 5_000_000  # of all views: of more, what the loss needs of a photograph is computed at each step
_PROCESSOR = torch.device("cpu")  # where the cameras are, whatever the Gaussians are on
_POSE_BETAS = (0.9, 0.99)  # of Adam for the cameras: each gets one gradient in as many steps as there are views


class Trainer:
    """Parameters, targets and optimisers of one refinement.

    The views of the scene are fitted with their cameras; those `beside` them have cameras that stay as they are.
    """

    def __init__(
        self,
        scene: Scene,
        config: RefinementConfig,
        seed: int,
        max_gaussians: int | None = None,
        beside: Sequence[TrainingView] = (),
    ) -> None:
        self._scene, self._config, self._max_gaussians = scene, config, max_gaussians
        gaussians = scene.gaussians.map(lambda tensor: tensor.clone())
        self._gaussians = gaussians
        rates = config.lr
        self._rates = {name: getattr(rates, name) for name in PARAMETERS}
        self._finals = dict.fromkeys(PARAMETERS, rates.final) | {"means": rates.final_means}
        self._shifts = Shifts(gaussians) if rates.means_unit == "extent" else None  # who moves the means; None: Adam
        moved = _leaves(gaussians, self._shifts)
        self._adam = Adam(moved, {name: self._rates[name] for name in moved})
        self._control: Control | None = None
        if config.control is not None:
            self._control = config.control.module.load(config.control.config, seed)
        self._dropout = ensemble.Dropout(config.dropout, gaussians, scene.views, seed)
        self._Ts_world_camera = [view.T_world_camera.clone() for view in scene.views]
        self._Ts_beside = [view.T_world_camera for view in beside]
        self._pose_rates = torch.tensor([rates.translation] * 3 + [rates.rotation] * 3)
        self._pose_moments = [Moments(torch.zeros(6), torch.zeros(6)) for _ in scene.views]
        views = (*scene.views, *beside)
        fitted = compute_fit_masks(scene.views)
        shown = (*fitted, *(np.ones((view.height, view.width), bool) for view in beside))
        few = sum(view.width * view.height for view in views) <= _KEPT_PIXELS
        device = gaussians.means.device
        self._measure = photometric_losses.load(config.perceptual, device)
        measures = (*(self._measure for _ in scene.views), *(None for _ in beside))
        self._images = {
            half: [
                make_training_image(view, mask, scale, config.ssim_lambda, device, keep=few, measure=measure)
                for view, mask, measure in zip(views, shown, measures, strict=True)
            ]
            for half, scale in _SCALES.items()
            if config.half_resolution_share > 0 or not half
        }
        self._regularisation = _regularisation(scene, fitted, config.regularizers, seed)
        self._iterations = scene.iterations
        # Photometric, of each step on a view of the scene. In one block: small tensors that are kept among those of the
        # steps would split the memory that these give back.
        self._losses = torch.empty(config.iterations, device=device)
        self._measured = 0  # losses so far

    def step(self, index: int, progress: float) -> None:
        """One iteration on view `index`, where those beside the scene's come after them.

        `progress` in [0, 1] sets resolution and step sizes. There are at most `config.iterations` steps.
        """
        half = progress < self._config.half_resolution_share
        image = self._images[half][index]
        own = index < len(self._Ts_world_camera)
        refine_pose = own and self._config.refine_poses and index > 0
        given = (*self._Ts_world_camera, *self._Ts_beside)[index]
        on_device = given.to(self._gaussians.means.device, non_blocking=True)
        T_world_camera = on_device.requires_grad_(refine_pose)
        channels = self._regularisation.channels(progress) if self._regularisation else ("rgb",)
        opacities = self._dropout(self._gaussians.opacities, progress)
        camera = Camera(T_world_camera, image.K, image.width, image.height)
        render = render_gaussians(self._gaussians, camera, channels, opacities=opacities)
        assert render.rgb is not None  # it was asked for
        loss = image.loss(render.rgb)
        if own:
            self._losses[self._measured] = loss.detach()
            self._measured += 1
        weight = self._config.perceptual.weight_in_step(self._num_steps_done, progress)
        if image.perceptual is not None and weight:
            loss = loss + weight * image.perceptual(render.rgb)
        if own and self._regularisation is not None:
            loss = loss + self._further_losses(self._regularisation, index, render, progress).to(loss)
        loss.backward()
        self._move_gaussians(progress)
        if refine_pose and T_world_camera.grad is not None:
            gradient = twist_gradient(self._Ts_world_camera[index].detach(), T_world_camera.grad.to(_PROCESSOR))
            self._move_camera(index, gradient, self._config.lr.final_pose**progress)
        self._iterations += 1
        self._control_density(index, self._images[half], progress)
        self._adam.zero_grad()
        self._gaussians.means.grad = None

    @property
    def _num_steps_done(self) -> int:
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
            OptimizerStep(
                iteration=self._num_steps_done,
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

    def _further_losses(self, regularisation: Regularizer, index: int, render: Render, progress: float) -> Tensor:
        """The losses beside the photometric one on training view `index`, as rendered, and on a pseudo view.

        They are computed on the processor, where their networks and targets are.
        """

        def draw(view: PseudoView, channels: Collection[str]) -> Render:
            return render_gaussians(self._gaussians, view.camera, channels).move_to_device(_PROCESSOR)

        on_training_view = regularisation.training_loss(index, render.move_to_device(_PROCESSOR), progress)
        parts = (on_training_view, regularisation.pseudo_loss(draw, progress))
        return sum((part for part in parts if part is not None), torch.zeros(()))

    def _move_camera(self, index: int, gradient: Tensor, decay: float) -> None:
        """An Adam step of the camera in its own frame."""
        direction, self._pose_moments[index] = adam_direction(gradient, self._pose_moments[index], _POSE_BETAS)
        T_world_camera = self._Ts_world_camera[index].detach()
        self._Ts_world_camera[index] = T_world_camera @ exp_se3(-decay * self._pose_rates * direction)

    def losses(self) -> tuple[float, ...]:
        """The photometric one of each step on a view of the scene."""
        return tuple(self._losses[: self._measured].tolist())

    def scene(self) -> Scene:
        """Returns the scene as it is optimized so far."""
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
    """Returns the parameters that Adam moves, by name: all, but for the means where `shifts` moves them."""
    leaves = {name: getattr(gaussians, name).requires_grad_(True) for name in PARAMETERS}
    if shifts is not None:
        del leaves["means"]
    return leaves


def _regularisation(
    scene: Scene, fitted: Sequence[npt.NDArray[np.bool_]], config: regularizers.RegularizerConfig, seed: int
) -> Regularizer | None:
    """The losses beside the photometric one, in the pixels (h, w) that are `fitted`; None where all weights are 0.

    Raises ValueError where they would compare with what is known of a view, and nothing is.
    """
    if not config.active_losses:
        return None
    pointmaps = []
    for view in scene.views:
        if view.pointmap is None:
            raise ValueError(f"{view.name} has no point map, which the losses in `regularise` compare with")
        T_world_camera = view.T_world_camera.double().numpy()
        pointmaps.append(replace(view.pointmap, T_world_camera=T_world_camera, K=view.K.double().numpy()))
    images = [view.image for view in scene.views]
    return Regularizer(pointmaps, images, config, seed=seed, shown=fitted)
