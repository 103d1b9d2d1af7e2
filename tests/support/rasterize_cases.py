"""Gaussians and cameras that rasterisers are compared on, and how far two of them are apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from splatnode.recon.rasterize import reference
from splatnode.recon.rasterize.reference import Render

NAMES = ("means", "quats", "scales", "opacities", "sh", "T_world_camera", "K")
WIDTH, HEIGHT = 46, 37  # more than one tile, not multiples of a block
COUNT = 120


@dataclass(frozen=True, eq=False)
class Case:
    """Gaussians and a camera, in float64 but exactly representable in float32."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    T_world_camera: Tensor
    K: Tensor

    def tensors(self, dtype: torch.dtype = torch.float64) -> list[Tensor]:
        return [getattr(self, name).clone().to(dtype).requires_grad_() for name in NAMES]


def random_case(seed: int, count: int = COUNT, bases: int = 16, width: int = WIDTH, height: int = HEIGHT) -> Case:
    """Gaussians of about 8 pixels around a camera's optical axis; some are behind it, some beside its view."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    T_world_camera = torch.eye(4, dtype=torch.float64)
    T_world_camera[:3, :3] = reference.compute_rotations(torch.tensor([[1.0, 0, 0, 0]]).double() + 0.1 * normal(1, 4))[
        0
    ]
    T_world_camera[:3, 3] = 0.2 * normal(3)
    K = torch.tensor([[0.9 * width, 0, 0.51 * width], [0, 0.93 * width, 0.48 * height], [0, 0, 1]]).double()
    return rounded(
        means=normal(count, 3) * torch.tensor([1.5, 1.1, 1.5]) + torch.tensor([0, 0, 4.0]),
        quats=normal(count, 4),
        scales=(normal(count, 3) * 0.6 - 2.2).exp(),
        opacities=torch.sigmoid(2 * normal(count)),
        sh=0.4 * normal(count, bases, 3),
        T_world_camera=T_world_camera,
        K=K,
    )


def rounded(**tensors: Tensor) -> Case:
    return Case(**{name: tensor.float().double() for name, tensor in tensors.items()})


def changed(case: Case, **changes: Tensor) -> Case:
    return rounded(**{**{name: getattr(case, name) for name in NAMES}, **changes})


def moderate(seed: int) -> Case:
    """Well inside the image, and nothing nearly opaque: where gsplat and the reference are meant to be equal."""
    case = random_case(seed, count=40, bases=4)
    means = case.means * torch.tensor([0.4, 0.4, 0.3]) + torch.tensor([0, 0, 2.8])
    return changed(case, means=means, opacities=case.opacities.clamp(0.02, 0.9))


def needles(seed: int) -> Case:
    case = random_case(seed)
    scales = case.scales.clone()
    scales[:, 0], scales[:, 1:] = 0.5, 0.002
    return changed(case, scales=scales)


def pancakes(seed: int) -> Case:
    case = random_case(seed)
    scales = case.scales.clone()
    scales[:, 2] = 1e-5
    return changed(case, scales=scales)


def at_the_border(seed: int) -> Case:
    case = random_case(seed)
    means = case.means.clone()
    means[:, 0] = means[:, 2] * torch.where(means[:, 1] > 0, 0.56, -0.56)
    return changed(case, means=means)


def behind_and_near(seed: int) -> Case:
    case = random_case(seed)
    means = case.means.clone()
    means[: COUNT // 2, 2] -= 4
    return changed(case, means=means)


def nearly_clear_and_nearly_opaque(seed: int) -> Case:
    case = random_case(seed)
    opacities = torch.where(torch.arange(COUNT) % 2 == 0, 1 / 255 + 1e-3, 0.9999)
    return changed(case, opacities=opacities)


def equal_depths(seed: int) -> Case:
    """In the camera's own axes, so that equal depths are equal after rounding too."""
    case = random_case(seed)
    means = case.means.clone()
    means[:, 2] = 3 + (torch.arange(COUNT) // 12) * 0.25
    return changed(case, means=means, T_world_camera=torch.eye(4))


CASES: list[Callable[[int], Case]] = [
    random_case, needles, pancakes, at_the_border, behind_and_near, nearly_clear_and_nearly_opaque, equal_depths,
]  # fmt: skip
TWENTY_SCENES = [(CASES[seed % len(CASES)], seed) for seed in range(21)]


def images(render: Render) -> list[Tensor]:
    return [image for image in (render.rgb, render.depth, render.normal, render.alpha) if image is not None]


def image_weights(shape_like: list[Tensor]) -> list[Tensor]:
    generator = torch.Generator().manual_seed(7)
    return [torch.randn(image.shape, generator=generator, dtype=torch.float64) for image in shape_like]


def render_and_differentiate(
    rasterize, case: Case, dtype=torch.float64, **options
) -> tuple[list[Tensor], list[Tensor]]:
    """The images and the gradients of their product with fixed random weights."""
    tensors = case.tensors(dtype)
    rendered = images(rasterize(*tensors, width=WIDTH, height=HEIGHT, **options))
    weighted = [(image * weight).sum() for image, weight in zip(rendered, image_weights(rendered), strict=True)]
    torch.stack(weighted).sum().backward()
    return [image.detach() for image in rendered], [
        torch.zeros_like(tensor) if tensor.grad is None else tensor.grad for tensor in tensors
    ]


def relative_error(actual: Tensor, expected: Tensor) -> float:
    return float((actual - expected).norm() / expected.norm().clamp(min=1e-12))


def single(mean=(0.0, 0.0, 2.0), opacity=0.5, scale=0.1) -> list[Tensor]:
    """One round white Gaussian in front of a camera with its principal point on a pixel's centre."""
    sh = torch.full((1, 1, 3), 0.5 / 0.28209479177387814)
    K = torch.tensor([[20.0, 0, 8.5], [0, 20, 8.5], [0, 0, 1]])
    return [
        torch.tensor([mean]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), scale), torch.tensor([opacity]),
        sh, torch.eye(4), K,
    ]  # fmt: skip
