"""Scene: the training views and the Gaussians that are fitted to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.capture.frame import Intrinsics
from splatnode.capture.stamp import Stamp
from splatnode.recon.frames import border
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.result.bounds import Bounds
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.scene.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class Exposure:
    """How a photograph differs from its image in a scene of one light."""

    gains: tuple[float, float, float]  # red, green, blue: of the photograph over the image, in its middle
    falloff: float  # the light at its corners is exp(-falloff) of that in its middle
    saturated: npt.NDArray[np.bool_] | None  # (h, w, 3), True: what it shows is at least so bright; None: nowhere


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
    shown = border.valid_masks([view.image for view in views])
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

    def cameras(
        self,
        bounds: Mapping[str, Bounds] = MappingProxyType({}),
        captured_at: Mapping[str, Stamp] = MappingProxyType({}),
    ) -> tuple[CameraEstimate, ...]:
        """The views' cameras as they are published: copies, in float64.

        `bounds` of their errors, and when their photographs were captured, are by name, as far as they are known.
        """
        return tuple(
            CameraEstimate(
                name=view.name,
                frame_id=view.frame_id,
                T_world_camera=view.T_world_camera.double().numpy().copy(),
                K=view.K.double().numpy().copy(),
                width=view.width,
                height=view.height,
                bounds=bounds.get(view.name),
                captured_at=captured_at.get(view.name),
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
