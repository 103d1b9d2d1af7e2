"""The scene: training views and Gaussians, and how they begin (completion, seeding, far shell), grow and warp.

Scene: the training views and the Gaussians that are fitted to them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.capture.frame import Intrinsics
from splatnode.recon import keyframes
from splatnode.recon.geometry import multiply_quats, quat_from_matrix
from splatnode.recon.priors import Pointmap
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays

# The Gaussians of a scene, in the unconstrained parameters that the optimiser moves.

SH_C0 = 0.28209479177387814  # the constant basis function of the real spherical harmonics


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N anisotropic 3D Gaussians (equation 1). Raw parameters carry their space; activated values are properties."""

    means: Tensor  # (N, 3) world
    quats: Tensor  # (N, 4) wxyz, not necessarily of unit length
    log_scales: Tensor  # (N, 3)
    logit_opacities: Tensor  # (N,)
    sh: Tensor  # (N, B, 3) spherical harmonics, B = 1, 4, 9 or 16; colour = 0.5 + sum of basis * sh
    source_frame: Tensor  # (N,) int32: where it comes from: see recon.result.snapshot; -1 for the far shell

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


@dataclass(frozen=True, eq=False)
class Exposure:
    """How a photograph differs from its image in a scene of one light."""

    gains: tuple[float, float, float]  # red, green, blue: of the photograph over the image, in its middle
    falloff: float  # the light at its corners is exp(-falloff) of that in its middle
    saturated: npt.NDArray[np.bool_] | None  # (h, w, 3), True: what it shows is at least so bright; None: nowhere
    sigmas: tuple[float, float, float] | None = None  # standard deviations of the gains' logarithms; None: not known


@dataclass(frozen=True, eq=False)
class TrainingView:
    """A keyframe that the Gaussians are fitted to, with its camera as refined so far."""

    name: str
    frame_id: int
    image: npt.NDArray[np.uint8]  # (h, w, 3) RGB at modelled size
    T_world_camera: Tensor  # (4, 4)
    K: Tensor  # (3, 3) at modelled size
    pointmap: Pointmap | None = None  # with the camera as registered; None: there is none
    mask: npt.NDArray[np.bool_] | None = None  # (h, w), True: the scene is fitted to it; None: to all pixels
    exposure: Exposure | None = None  # that was taken out of the photograph; None: nothing was
    lens: Intrinsics | None = None  # estimated, whose distortion was taken out of the photograph; None: nothing was
    moved: float = 0.0  # share of the photograph that the mask hides because other views see through it
    # Share of the pixels that the scene is fitted to whose depth another view confirms; None: nobody has compared them
    consistent_depth: float | None = None

    @property
    def width(self) -> int:
        return self.image.shape[1]

    @property
    def height(self) -> int:
        return self.image.shape[0]


def compute_fit_masks(views: Sequence[TrainingView]) -> list[npt.NDArray[np.bool_]]:
    """Returns each view's pixels (h, w) that the scene is fitted to: neither in a dark rim nor masked."""
    shown = keyframes.valid_masks([view.image for view in views])
    return [rim if view.mask is None else rim & view.mask for view, rim in zip(views, shown, strict=True)]


@dataclass(frozen=True, eq=False)
class Scene:
    """K views and N Gaussians in one world frame; the median depth of the views' points is about 1."""

    views: tuple[TrainingView, ...]
    gaussians: Gaussians
    iterations: int = 0  # of refinement so far
    losses: tuple[float, ...] = ()  # photometric, of each iteration of a refinement that has ended
    num_unlimited: int = 0  # Gaussians that it would have begun with without a limit
    served_by: Mapping[str, str] = field(default_factory=dict)  # by loss that was used: the network or measure in it
    # Published colours over those in here: dark photographs tell of things that are brighter than white in the light
    # of the median, so that photographs are kept darker than that.
    headroom: float = 1.0

    def move_to_device(self, device: torch.device) -> Scene:
        """The same scene with its Gaussians on `device`. Cameras and photographs stay on the processor."""
        return replace(self, gaussians=self.gaussians.map(lambda tensor: tensor.to(device)))

    def cameras(self) -> tuple[CameraEstimate, ...]:
        """The views' cameras as they are published, without what the scene does not know: copies, in float64."""
        return tuple(
            CameraEstimate(
                name=view.name,
                frame_id=view.frame_id,
                T_world_camera=view.T_world_camera.double().numpy().copy(),
                K=view.K.double().numpy().copy(),
                width=view.width,
                height=view.height,
                lens=view.lens,
                consistent_depth=view.consistent_depth,
            )
            for view in self.views
        )

    def images(self) -> dict[str, npt.NDArray[np.uint8]]:
        """The photographs (h, w, 3) in the light of what is published, by name."""
        if self.headroom == 1.0:
            return {view.name: view.image for view in self.views}
        table = np.minimum(np.rint(self.headroom * np.arange(256)), 255).astype(np.uint8)
        return {view.name: table[view.image] for view in self.views}

    def gains(self) -> dict[str, tuple[float, float, float]]:
        """Red, green and blue of the photographs whose light was changed, over what is published; by name."""
        lit = {view.name: view.exposure.gains for view in self.views if view.exposure is not None}
        published = {name: (r / self.headroom, g / self.headroom, b / self.headroom) for name, (r, g, b) in lit.items()}
        return published if any(gains != (1.0, 1.0, 1.0) for gains in published.values()) else {}

    def gain_sigmas(self) -> dict[str, tuple[float, float, float]]:
        """Returns standard deviations of the logarithms of `gains`, by name, where they are known."""
        lit = {view.name: view.exposure.sigmas for view in self.views if view.exposure is not None}
        return {name: sigmas for name, sigmas in lit.items() if sigmas is not None} if self.gains() else {}

    def arrays(self) -> GaussianArrays:
        """The Gaussians as they are published: activated copies, with quaternions of unit length.

        Colours above 1 are brighter than white in the light of the median.
        """
        gaussians = self.gaussians if self.headroom == 1.0 else self.gaussians.scale_brightness(self.headroom)
        quats = gaussians.quats / gaussians.quats.norm(dim=1, keepdim=True).clamp_min(1e-12)
        return GaussianArrays(
            means=gaussians.means.numpy().copy(),
            quats=quats.numpy(),
            scales=gaussians.scales.numpy(),
            opacities=gaussians.opacities.numpy(),
            sh=gaussians.sh.numpy().copy(),
            source_frame=gaussians.source_frame.numpy().copy(),
        )
