"""A step on a GPU takes the time that its launches take: how many there are, counted where there is no GPU."""

from __future__ import annotations

import torch
from msgspec import structs
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from splatnode.recon.optimize.fit import Trainer
from splatnode.recon.optimize.training import RefinementConfig
from tests.support import gsplat_by_torch
from tests.support.known_scene import photographed

# Of torch's operations those that compute nothing: a tensor of the same memory, or memory for one.
_WITHOUT_LAUNCH = {
    *("alias", "as_strided", "detach", "diagonal", "expand", "permute", "select", "slice", "split_with_sizes"),
    *("squeeze", "t", "transpose", "unbind", "unsqueeze", "view", "_unsafe_view"),
    *("empty", "empty_like", "empty_strided", "new_empty"),
}
MOST_LAUNCHES = 115  # outside gsplat's kernels, those of a camera on the processor included; there were 527


class _Counted(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = str(func).split(".")[1]
        if name not in _WITHOUT_LAUNCH:
            self.names.append(name)
        return func(*args, **(kwargs or {}))


class _Projection(torch.autograd.Function):
    """Launches nothing."""

    @staticmethod
    def forward(ctx, means: Tensor, covariances, quats, scales, T_camera_world, K, *options):
        ctx.given = means, covariances, quats, scales, T_camera_world
        count = len(means)
        radii = torch.empty(1, count, 2, dtype=torch.int32)
        ctx.mark_non_differentiable(radii)
        return radii, means.new_empty(1, count, 2), means.new_empty(1, count), means.new_empty(1, count, 3), None

    @staticmethod
    def backward(ctx, *gradients):  # pyright: ignore[reportIncompatibleMethodOverride]
        return *(None if each is None else torch.empty_like(each) for each in ctx.given), *[None] * 11


class _Blending(torch.autograd.Function):
    """Launches nothing."""

    @staticmethod
    def forward(ctx, centres: Tensor, conics, features, opacities, backgrounds, masks, width, height, *options):
        ctx.given = centres, conics, features, opacities
        return centres.new_empty(1, height, width, features.shape[-1]), centres.new_empty(1, height, width, 1)

    @staticmethod
    def backward(ctx, *gradients):  # pyright: ignore[reportIncompatibleMethodOverride]
        return *(torch.empty_like(each) for each in ctx.given), *[None] * 8


def _kernel(name: str):
    tiles = torch.empty(1, dtype=torch.int32)
    return {
        "intersect_tile": lambda *given: (tiles, tiles, tiles),
        "intersect_offset": lambda ids, count, across, down: torch.empty(count, down, across, dtype=torch.int32),
    }[name]


def test_a_step_has_few_launches(monkeypatch):
    gsplat_by_torch.install(monkeypatch)
    for name, substitute in (
        ("_FullyFusedProjection", _Projection),
        ("_RasterizeToPixels", _Blending),
        ("_make_lazy_cuda_func", _kernel),
    ):
        monkeypatch.setattr(f"gsplat.cuda._wrapper.{name}", substitute)
    fit = Trainer(photographed(), structs.replace(RefinementConfig(), control=None), seed=0)
    fit.step(1, 0.1)  # what is computed once
    with _Counted() as counted:
        fit.step(2, 0.1)
    waited = {"nonzero", "sort", "index", "index_put"} & set(counted.names)
    assert not waited  # for sizes that depend on values, which the processor must know
    assert len(counted.names) <= MOST_LAUNCHES, counted.names
