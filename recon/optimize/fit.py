"""Fit: the parameters, targets and optimisers of one refinement, and its steps.

The optimiser is Adam (Kingma and Ba 2015, algorithm 1): of all Gaussians at once, whose rows come and go, and of a
tangent vector."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon import rasterize
from splatnode.recon.core import library
from splatnode.recon.geometry import exp_se3, matrices_from_quats, twist_gradient
from splatnode.recon.optimize import ensemble, photometric_losses, regularizers
from splatnode.recon.optimize.control import Control, OptimizerStep
from splatnode.recon.optimize.photometric_losses import TrainingImage, make_training_image
from splatnode.recon.optimize.regularizers import PseudoView, Regularizer
from splatnode.recon.rasterize import Camera, render_gaussians
from splatnode.recon.rasterize.reference import Render
from splatnode.recon.scene import Gaussians, Scene, TrainingView, compute_fit_masks

if TYPE_CHECKING:
    from splatnode.recon.optimize.training import RefinementConfig


_EACH: Any = torch  # has functions of many tensors at once; its pages list them, though their names begin with _


class Adam:
    """Adam of all parameters in one native call, on other devices by torch; `torch.optim.Adam` but for rounding.

    Parameters are named; rows are Gaussians (or cameras). `lrs` may be changed between steps. A row that is added
    starts with moments of 0 but shares its parameter's count of steps, so its first steps are about three times as
    long as a new parameter's, as in 3DGS.
    """

    def __init__(
        self,
        params: Mapping[str, Tensor],  # float32 leaves on one device, contiguous, any shape
        lrs: Mapping[str, float],  # by the same names
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
    ):
        if set(params) != set(lrs):
            raise ValueError(f"params and lrs must have the same names, got {sorted(params)} and {sorted(lrs)}")
        self.lrs = dict(lrs)
        self.betas = betas
        self.eps = eps
        self._groups = {name: _new_group(name, param) for name, param in params.items()}

    @property
    def params(self) -> dict[str, Tensor]:
        return {name: group.param for name, group in self._groups.items()}

    def zero_grad(self) -> None:
        for group in self._groups.values():
            group.param.grad = None

    @torch.no_grad()
    def step(self, lr_factors: Mapping[str, Tensor] | None = None) -> None:
        """One update of every parameter that has a gradient.

        `lr_factors[name]`, one number a row (N,), multiplies the learning rate; of names left out it is 1.
        """
        factors = {name: _row_factors(name, value, self._groups) for name, value in (lr_factors or {}).items()}
        moving = {name: group for name, group in self._groups.items() if group.param.grad is not None}
        gradients = {name: _gradient(name, group.param) for name, group in moving.items()}
        for group in moving.values():
            group.steps += 1
        if all(rasterize.is_on_cpu(group.param) for group in moving.values()):
            self._step_natively(moving, gradients, factors)
            return
        self._step_by_torch(moving, gradients, factors)

    def _step_size(self, name: str, group: _Group) -> float:
        return self.lrs[name] / (1 - self.betas[0] ** group.steps)

    def _step_natively(
        self, moving: Mapping[str, _Group], gradients: Mapping[str, Tensor], factors: Mapping[str, Tensor]
    ) -> None:
        native = (_NativeGroup * len(moving))()
        for slot, (name, group) in zip(native, moving.items(), strict=True):
            slot.parameter, slot.gradient = group.param.data_ptr(), gradients[name].data_ptr()
            slot.first, slot.second = group.first.data_ptr(), group.second.data_ptr()
            slot.row_factors = factors[name].data_ptr() if name in factors else None
            slot.count = group.param.numel()
            slot.row_size = group.param[0].numel() if len(group.param) else 1
            slot.step_size = self._step_size(name, group)
            slot.root_correction = (1 - self.betas[1] ** group.steps) ** -0.5
        library().core_adam(native, len(moving), *map(ctypes.c_double, (*self.betas, self.eps)))
        for group in moving.values():
            torch.autograd.graph.increment_version(group.param)

    def _step_by_torch(
        self, moving: Mapping[str, _Group], gradients: Mapping[str, Tensor], factors: Mapping[str, Tensor]
    ) -> None:
        """Steps as the core does, on any device: one launch for each operation, over all parameters at once."""
        given, groups = list(gradients.values()), list(moving.values())
        firsts, seconds = [group.first for group in groups], [group.second for group in groups]
        _EACH._foreach_lerp_(firsts, given, 1 - self.betas[0])
        _EACH._foreach_mul_(seconds, self.betas[1])
        _EACH._foreach_addcmul_(seconds, given, given, 1 - self.betas[1])
        roots = [(1 - self.betas[1] ** group.steps) ** 0.5 for group in groups]  # of the correction of the second
        spreads = _EACH._foreach_sqrt(seconds)
        _EACH._foreach_add_(spreads, [self.eps * root for root in roots])
        sizes = [-self._step_size(name, group) for name, group in moving.items()]
        sizes = [size * root for size, root in zip(sizes, roots, strict=True)]
        moves = [_scale_rows(first, factors.get(name)) for name, first in zip(moving, firsts, strict=True)]
        _EACH._foreach_addcdiv_([group.param for group in groups], moves, spreads, sizes)

    def follow(self, params: Mapping[str, Tensor], origin: Tensor) -> None:
        """Goes on with `params`, of M rows each, in place of the old ones.

        `origin` (M,) is the old row whose state each goes on with; one of -1 starts with moments of 0.
        """
        if set(params) != set(self._groups):
            raise ValueError(f"params must have the names {sorted(self._groups)}, got {sorted(params)}")
        fresh = origin < 0
        for name, param in params.items():
            group = self._groups[name]
            if param.shape != (len(origin), *group.param.shape[1:]):
                shape = (len(origin), *group.param.shape[1:])
                raise ValueError(f"{name} must be {shape} for these origins, got {tuple(param.shape)}")
            first, second = (moment[origin].masked_fill_(_broadcast_rows(fresh, moment), 0) for moment in group.moments)
            self._groups[name] = _Group(_check_param(name, param), first, second, group.steps)


@dataclass(frozen=True, eq=False)
class Moments:
    """Adam's state of one parameter after `steps` updates."""

    first: Tensor  # running mean of the gradient
    second: Tensor  # running mean of its square, element by element
    steps: int = 0


def adam_direction(
    gradient: Tensor, moments: Moments, betas: tuple[float, float], eps: float = 1e-15
) -> tuple[Tensor, Moments]:
    """The direction of Adam's next step, of the gradient's shape, and the moments after it.

    For a parameter on a manifold, such as a camera pose: the gradient is that of a tangent vector at the current point,
    and the caller moves the point along minus the learning rate times the direction.
    """
    steps = moments.steps + 1
    first = betas[0] * moments.first + (1 - betas[0]) * gradient
    second = betas[1] * moments.second + (1 - betas[1]) * gradient**2
    direction = (first / (1 - betas[0] ** steps)) / ((second / (1 - betas[1] ** steps)).sqrt() + eps)
    return direction, Moments(first, second, steps)


@dataclass(eq=False)
class _Group:
    """A parameter with its moments, as in `Moments`, which the core updates in place."""

    param: Tensor
    first: Tensor
    second: Tensor
    steps: int

    @property
    def moments(self) -> tuple[Tensor, Tensor]:
        return self.first, self.second


class _NativeGroup(ctypes.Structure):
    """AdamGroup of recon/core/adam.cpp."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("parameter", "first", "second", "gradient", "row_factors")),
        ("count", ctypes.c_int64),
        ("row_size", ctypes.c_int64),
        ("step_size", ctypes.c_float),
        ("root_correction", ctypes.c_float),
    ]


def _scale_rows(values: Tensor, factors: Tensor | None) -> Tensor:
    return values if factors is None else values * _broadcast_rows(factors.to(values), values)


def _broadcast_rows(rows: Tensor, values: Tensor) -> Tensor:
    """`rows` (N,) in a shape that broadcasts with `values` (N, ...)."""
    return rows.view(-1, *[1] * (values.dim() - 1))


def _new_group(name: str, param: Tensor) -> _Group:
    zeros = torch.zeros_like(_check_param(name, param), requires_grad=False)
    return _Group(param, zeros, zeros.clone(), 0)


def _check_param(name: str, param: Tensor) -> Tensor:
    if param.dtype != torch.float32 or not param.is_contiguous() or param.dim() == 0:
        raise ValueError(
            f"{name} must be a contiguous float32 tensor with at least one dimension, "
            f"got {param.dtype} of shape {tuple(param.shape)} and strides {param.stride()}"
        )
    if not (param.is_leaf and param.requires_grad):
        raise ValueError(f"{name} must be a leaf that requires its gradient (call .requires_grad_())")
    return param


def _gradient(name: str, param: Tensor) -> Tensor:
    assert param.grad is not None
    if param.grad.is_sparse:
        raise ValueError(f"the gradient of {name} must be dense")
    return param.grad.contiguous()


def _row_factors(name: str, factors: Tensor, groups: Mapping[str, _Group]) -> Tensor:
    if name not in groups:
        raise ValueError(f"lr_factors names {name!r}; there are {sorted(groups)}")
    rows = len(groups[name].param)
    if tuple(factors.shape) != (rows,):
        raise ValueError(f"lr_factors[{name!r}] must be ({rows},), got {tuple(factors.shape)}")
    return factors.to(torch.float32).contiguous()


# Steps of positions along each Gaussian's own axes, in its standard deviations.
#
# A Gaussian shows a shift along its thin axis far sooner than one along its long axis. Its covariance is the metric in
# which both count alike, so that this is the natural gradient of a Gaussian's mean (Amari, "Natural gradient works
# efficiently in learning", 1998) under Adam. A step is a share of the Gaussian's extent, in whatever unit the scene
# is.

LARGEST_EXTENT = 0.2  # standard deviation that counts at most, in median depths: the far shell's are many times that


class Shifts:
    """Adam of the offsets (N, 3) by which each mean has moved along its Gaussian's axes; it starts at 0 each step."""

    def __init__(self, gaussians: Gaussians) -> None:
        self._adam = Adam({"offsets": _zeros(gaussians)}, {"offsets": 0.0})

    @torch.no_grad()
    def step(self, gaussians: Gaussians, rate: float) -> None:
        """Moves `gaussians.means`, which must have their gradient, by about `rate` standard deviations."""
        assert gaussians.means.grad is not None
        offsets, turned = self._adam.params["offsets"], make_axis_rotation(gaussians)
        offsets.grad = turned(gaussians.means.grad, to_world=False)
        self._adam.lrs = {"offsets": rate}
        self._adam.step()
        gaussians.means.add_(turned(offsets, to_world=True))
        offsets.zero_()

    def follow(self, gaussians: Gaussians, origin: Tensor) -> None:
        """Goes on with these Gaussians; `origin` (N,) is as in `Adam.follow`."""
        self._adam.follow({"offsets": _zeros(gaussians)}, origin)


def make_axis_rotation(gaussians: Gaussians) -> Callable[..., Tensor]:
    """A function of vectors (N, 3) and of `to_world`, by which vectors along the axes of `gaussians` turn into it."""
    quats, log_scales = gaussians.quats.detach(), gaussians.log_scales.detach()
    if rasterize.is_on_cpu(quats):
        return partial(_rotate_by_core, quats, log_scales)
    return partial(rotate_by_torch, axes_by_torch(quats, log_scales))


def _rotate_by_core(quats: Tensor, log_scales: Tensor, vectors: Tensor, to_world: bool) -> Tensor:
    given = [tensor.to(torch.float32).contiguous() for tensor in (quats, log_scales, vectors.detach())]
    result = torch.empty_like(given[2])
    addresses = [ctypes.c_void_p(tensor.data_ptr()) for tensor in given]
    largest, count = ctypes.c_double(LARGEST_EXTENT), ctypes.c_int64(len(result))
    library().core_own_axes(*addresses, count, largest, int(to_world), ctypes.c_void_p(result.data_ptr()))
    return result.to(vectors.dtype)


def axes_by_torch(quats: Tensor, log_scales: Tensor) -> Tensor:
    """(N, 3, 3) the axes in columns, as long as their standard deviations count."""
    return matrices_from_quats(quats) * log_scales.exp().clamp_max(LARGEST_EXTENT)[:, None, :]


def rotate_by_torch(axes: Tensor, vectors: Tensor, to_world: bool) -> Tensor:
    """Rotates as the core does, on any device."""
    beside = vectors[:, None, :] if to_world else vectors[:, :, None]
    return (axes * beside).sum(2 if to_world else 1)


def _zeros(gaussians: Gaussians) -> Tensor:
    return torch.zeros_like(gaussians.means, requires_grad=True)


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
                make_training_image(view, mask, scale, config.ssim_lambda, device, few, measure, scene.headroom)
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
            raise ValueError(f"{view.name} has no point map, which the losses in `regularizers` compare with")
        T_world_camera = view.T_world_camera.double().numpy()
        pointmaps.append(replace(view.pointmap, T_world_camera=T_world_camera, K=view.K.double().numpy()))
    images = [view.image for view in scene.views]
    return Regularizer(pointmaps, images, config, seed=seed, shown=fitted)
