"""Scene: the cameras and the Gaussians while they are being optimised."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.frames import border
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.registration.register import RegisteredCamera
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.scene import background, completion, pixelwise, seeding
from splatnode.recon.scene.gaussians import Gaussians, concatenate


@dataclass(frozen=True, eq=False)
class View:
    """A keyframe that the Gaussians are fitted to."""

    name: str
    frame_id: int
    image: npt.NDArray[np.uint8]  # (h, w, 3) RGB
    T_world_camera: Tensor  # (4, 4), refined
    K: Tensor  # (3, 3)
    rotation_sigma_deg: float | None  # None: not estimated
    centre_sigma_rel: float | None
    pointmap: Pointmap | None = None  # what stereo knows of it, with the camera as registered; None: nothing

    @property
    def width(self) -> int:
        return self.image.shape[1]

    @property
    def height(self) -> int:
        return self.image.shape[0]


@dataclass(frozen=True, eq=False)
class Scene:
    """K views and N Gaussians in one world frame; the median depth of the views' points is about 1."""

    views: tuple[View, ...]
    gaussians: Gaussians
    iterations: int = 0
    losses: tuple[float, ...] = ()  # photometric, of each iteration of a refinement that has ended
    called_for: int = 0  # Gaussians that it would have begun with but for a limit
    served_by: Mapping[str, str] = field(default_factory=dict)  # network or measure, by regularisation that was used

    def cameras(self) -> tuple[CameraEstimate, ...]:
        return tuple(
            CameraEstimate(
                name=view.name,
                frame_id=view.frame_id,
                T_world_camera=view.T_world_camera.double().numpy().copy(),
                K=view.K.double().numpy().copy(),
                width=view.width,
                height=view.height,
                rotation_sigma_deg=view.rotation_sigma_deg,
                centre_sigma_rel=view.centre_sigma_rel,
            )
            for view in self.views
        )

    def arrays(self) -> GaussianArrays:
        gaussians = self.gaussians
        quats = gaussians.quats / gaussians.quats.norm(dim=1, keepdim=True).clamp_min(1e-12)
        return GaussianArrays(
            means=gaussians.means.numpy().copy(),
            quats=quats.numpy(),
            scales=gaussians.scales.numpy(),
            opacities=gaussians.opacities.numpy(),
            sh=gaussians.sh.numpy().copy(),
            source_frame=gaussians.source_frame.numpy().copy(),
        )


def begin(
    pointmaps: tuple[Pointmap, ...],
    images: dict[str, npt.NDArray[np.uint8]],
    cameras: tuple[RegisteredCamera, ...],
    completing: completion.Config,
    sampling: seeding.Config,
    shell: background.Config,
    max_gaussians: int | None = None,
    by_pixel: pixelwise.Config | None = None,
) -> Scene:
    """The scene that has not been optimised: cameras as registered, Gaussians from the point maps.

    With `by_pixel` it has a Gaussian for each pixel that stereo knows, and neither completion nor a far shell.
    """
    pictures = [images[pointmap.name] for pointmap in pointmaps]
    shown = border.shown(pictures)
    pointmaps = tuple(map(completion.only, pointmaps, shown))
    views = tuple(
        View(
            name=pointmap.name,
            frame_id=pointmap.frame_id,
            image=images[pointmap.name],
            T_world_camera=torch.tensor(pointmap.T_world_camera, dtype=torch.float32),
            K=torch.tensor(pointmap.K, dtype=torch.float32),
            rotation_sigma_deg=camera.rotation_sigma_deg,
            centre_sigma_rel=camera.centre_sigma_rel,
            pointmap=pointmap,
        )
        for pointmap, camera in zip(pointmaps, cameras, strict=True)
    )
    if by_pixel is not None:
        return Scene(views, pixelwise.pixelwise_gaussians(pointmaps, pictures, by_pixel, max_gaussians))
    telling = [completion.only(each, each.confidence >= completing.least_confidence) for each in pointmaps]
    completed = list(map(completion.only, completion.complete(telling, pictures, completing), shown))
    behind = background.background(telling, pictures, shell, None if max_gaussians is None else max_gaussians // 10)
    left = None if max_gaussians is None else max_gaussians - len(behind)
    surfaces = seeding.initial_gaussians(completed, pictures, sampling)
    called_for = len(surfaces) + len(behind)
    if left is not None and len(surfaces) > left:
        surfaces = seeding.initial_gaussians(completed, pictures, sampling, left)
    return Scene(views, concatenate([surfaces, behind]), called_for=called_for)
