"""The Gaussians of a scene, in the unconstrained parameters that the optimiser moves."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from splatnode.recon.geometry import multiply_quats, quat_from_matrix

SH_C0 = 0.28209479177387814  # the constant basis function of the real spherical harmonics


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N anisotropic 3D Gaussians (equation 1). Raw parameters carry their space; activated values are properties."""

    means: Tensor  # (N, 3) world
    quats: Tensor  # (N, 4) wxyz, not necessarily of unit length
    log_scales: Tensor  # (N, 3)
    logit_opacities: Tensor  # (N,)
    sh: Tensor  # (N, B, 3) spherical harmonics, B = 1, 4, 9 or 16; colour = 0.5 + sum of basis * sh
    source_frame: Tensor  # (N,) int32: where it comes from: see recon.result.sources; -1 for the far shell

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Tensor:
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        return self.logit_opacities.sigmoid()

    @property
    def rgb(self) -> Tensor:
        """(N, 3) colour without its view-dependent part."""
        return self.sh[:, 0] * SH_C0 + 0.5

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """`function` applied to every tensor."""
        return Gaussians(*(function(getattr(self, field.name)) for field in fields(self)))

    def subset(self, index: Tensor) -> Gaussians:
        """The Gaussians at `index` (integers or a mask)."""
        return self.map(lambda tensor: tensor[index])

    def scale_brightness(self, factor: float) -> Gaussians:
        """The Gaussians with colours `factor` times as bright."""
        sh = factor * self.sh
        sh[:, 0] += (factor - 1.0) * 0.5 / SH_C0
        return replace(self, sh=sh)

    def transform(self, scale: float, rotation: Tensor, translation: Tensor) -> Gaussians:
        """The Gaussians after the similarity x -> scale * rotation @ x + translation; SH are not rotated.

        `rotation` is (3, 3) and `translation` (3,). View-dependent colour therefore keeps its old directions.
        """
        rotation = rotation.to(self.means)
        return replace(
            self,
            means=scale * self.means @ rotation.T + translation.to(self.means),
            quats=multiply_quats(quat_from_matrix(rotation), self.quats),
            log_scales=self.log_scales + math.log(scale),
        )


def logit(opacity: float) -> float:
    """The raw parameter of an opacity, which lies between 0 and 1."""
    return float(np.log(opacity / (1 - opacity)))


def concatenate(parts: list[Gaussians]) -> Gaussians:
    """All Gaussians of `parts`, in order; lower SH degrees are padded with zeros."""
    bases = max(part.sh.shape[1] for part in parts)
    padded = [replace(part, sh=torch.nn.functional.pad(part.sh, (0, 0, 0, bases - part.sh.shape[1]))) for part in parts]
    return Gaussians(*(torch.cat([getattr(part, field.name) for part in padded]) for field in fields(Gaussians)))
