"""The joint optimisation of a radiance field and its cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass

import msgspec
import numpy as np
import torch
from torch import Tensor, nn

from splatnode.recon.evaluate.rivals.nerf.cameras import Cameras, Focal
from splatnode.recon.evaluate.rivals.nerf.field import Field
from splatnode.recon.evaluate.rivals.nerf.volume_rendering import RenderedRays, render_rays


class FitConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    iterations: int = 1500
    checkpoints: tuple[int, ...] = (400,)
    rays: int = 384  # of one photograph, in each iteration
    field_rate: float = 5e-3  # Adam's step sizes at the start
    camera_rate: float = 3e-3  # of rotations, centres, focal length and whatever a method learns beside them
    field_final: float = 0.1  # to which part they have fallen at the end, exponentially
    camera_final: float = 0.1


@dataclass(frozen=True, eq=False)
class FieldCheckpoint:
    """A field with its cameras after a number of iterations."""

    field: Field
    Ts_world_camera: tuple[Tensor, ...]  # (4, 4) each
    focal: float  # in parts of the longer side
    iterations: int


@dataclass(frozen=True, eq=False)
class FitStep:
    """The renders of an iteration, for further losses."""

    view: int
    pixels: Tensor  # (M, 2)
    rays: RenderedRays
    cameras: Cameras
    progress: float  # of all iterations, in [0, 1)


def fit_field(
    images: Sequence[Tensor],  # (h, w, 3) in [0, 1]
    used: Sequence[Tensor | None],  # (h, w) where the colours of each count; None: everywhere
    focal: Focal,
    config: FitConfig,
    *,
    seed: int,
    further: Callable[[FitStep], Tensor] | None = None,
    beside: Sequence[nn.Parameter] = (),
) -> Iterator[FieldCheckpoint]:
    """The field at every checkpoint and at the end.

    The loss is the mean squared difference of the colours of random pixels, plus what `further` gives; `beside` are
    parameters of its own, learnt like the cameras.
    """
    draws = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        field = Field()
    cameras = Cameras(len(images))
    located = [*cameras.parameters(), *(p for p in focal.parameters() if p.requires_grad), *beside]
    groups = [{"params": list(field.parameters())}, {"params": located}]
    starts, finals = (config.field_rate, config.camera_rate), (config.field_final, config.camera_final)
    adam = torch.optim.Adam(groups, lr=config.field_rate)
    order = np.random.default_rng(seed)
    queue: list[int] = []
    for iteration in range(config.iterations):
        progress = iteration / config.iterations
        for group, start, final in zip(adam.param_groups, starts, finals, strict=True):
            group["lr"] = start * final**progress
        queue = queue or order.permutation(len(images)).tolist()
        view = queue.pop()
        height, width = images[view].shape[:2]
        pixels = torch.rand((config.rays, 2), generator=draws) * torch.tensor([width, height])
        pixels = pixels.floor() + 0.5
        rays = render_rays(field, cameras.T_world_camera(view), focal.K(width, height), pixels, draws)
        columns, rows = pixels.long().unbind(1)
        loss = _compute_colour_loss((rays.rgb - images[view][rows, columns]).square(), used[view], rows, columns)
        if further is not None:
            loss = loss + further(FitStep(view, pixels, rays, cameras, progress))
        adam.zero_grad()
        loss.backward()
        adam.step()
        if iteration + 1 in config.checkpoints and iteration + 1 < config.iterations:
            yield _make_checkpoint(field, cameras, focal, iteration + 1)
    yield _make_checkpoint(field, cameras, focal, config.iterations)


def _compute_colour_loss(squares: Tensor, used: Tensor | None, rows: Tensor, columns: Tensor) -> Tensor:
    """The mean of the squared differences (M, 3) of the pixels that are used."""
    if used is None:
        return squares.mean()
    counted = used[rows, columns]
    return (squares.mean(1) * counted).sum() / counted.sum().clamp_min(1)


def _make_checkpoint(field: Field, cameras: Cameras, focal: Focal, iterations: int) -> FieldCheckpoint:
    Ts = tuple(cameras.T_world_camera(index).detach() for index in range(len(cameras.turns)))
    return FieldCheckpoint(deepcopy(field), Ts, float(focal.root.detach() ** 2), iterations)
