"""Scene: the cameras and the Gaussians while they are being optimised."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recon import background, completion, density
from recon.gaussians import Gaussians, concatenate
from recon.geometry import align_cameras
from recon.priors.pointmap import Pointmap
from recon.registration.register import RegisteredCamera
from recon.snapshot import CameraEstimate, GaussianArrays


@dataclass(frozen=True, eq=False)
class View:
    """A keyframe that the Gaussians are fitted to."""

    name: str
    frame_id: int
    image: npt.NDArray[np.uint8]  # (h, w, 3) RGB
    T_world_camera: Tensor  # (4, 4), refined
    K: Tensor  # (3, 3)
    rotation_sigma_deg: float
    centre_sigma_rel: float

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
    sampling: density.Config,
    shell: background.Config,
    max_gaussians: int | None = None,
) -> Scene:
    """The scene that has not been optimised: cameras as registered, Gaussians from the point maps."""
    pictures = [images[pointmap.name] for pointmap in pointmaps]
    completed = completion.complete(pointmaps, pictures, completing)
    views = tuple(
        View(
            name=pointmap.name,
            frame_id=pointmap.frame_id,
            image=images[pointmap.name],
            T_world_camera=torch.from_numpy(pointmap.T_world_camera).float(),
            K=torch.from_numpy(pointmap.K).float(),
            rotation_sigma_deg=camera.rotation_sigma_deg,
            centre_sigma_rel=camera.centre_sigma_rel,
        )
        for pointmap, camera in zip(completed, cameras, strict=True)
    )
    behind = background.background(pointmaps, pictures, shell, None if max_gaussians is None else max_gaussians // 10)
    left = None if max_gaussians is None else max_gaussians - len(behind)
    surfaces = density.initial_gaussians(completed, pictures, sampling, left)
    return Scene(views, concatenate([surfaces, behind]))


def extend(old: Scene, new: Scene, tolerance: float = 0.02) -> Scene:
    """`new`, which has further views, with what was already learnt in `old`.

    The old scene is carried into the new world by the similarity of the cameras that both have. Its Gaussians replace
    those that start from the same views; the far shell is the new one, which reaches as far as the new views. Where the
    new estimate moved a camera by more than `tolerance` of the scene's depth, or changed a focal length by more than
    that part of it, what was learnt no longer fits and the new scene starts afresh.
    """
    before = {view.name: view for view in old.views}
    both = [view for view in new.views if view.name in before]
    if len(both) < 2:
        return new
    Ts_new = np.stack([view.T_world_camera.double().numpy() for view in both])
    Ts_old = np.stack([before[view.name].T_world_camera.double().numpy() for view in both])
    similarity = align_cameras(Ts_old, Ts_new)
    carried = np.stack([similarity.camera(T) for T in Ts_old])
    zoomed = max(abs(float(view.K[0, 0] / before[view.name].K[0, 0]) - 1.0) for view in both)
    if np.abs(carried[:, :3] - Ts_new[:, :3]).max() > tolerance or zoomed > tolerance:
        return new
    learnt = old.gaussians.subset(old.gaussians.source_frame != background.SOURCE_FRAME).transformed(
        similarity.scale, torch.from_numpy(similarity.rotation), torch.from_numpy(similarity.translation)
    )
    known_frames = torch.tensor([view.frame_id for view in old.views], dtype=torch.int32)
    fresh = new.gaussians.subset(~torch.isin(new.gaussians.source_frame, known_frames))
    poses = {view.name: torch.from_numpy(T).float() for view, T in zip(both, carried, strict=True)}
    views = tuple(replace(view, T_world_camera=poses.get(view.name, view.T_world_camera)) for view in new.views)
    return _in_first_camera(Scene(views, concatenate([learnt, fresh]), old.iterations))


def _in_first_camera(scene: Scene) -> Scene:
    """The same scene with its first camera's frame as the world, as snapshots promise."""
    T_camera_world = torch.linalg.inv(scene.views[0].T_world_camera.double())
    views = tuple(
        replace(view, T_world_camera=(T_camera_world @ view.T_world_camera.double()).float()) for view in scene.views
    )
    return replace(
        scene,
        views=views,
        gaussians=scene.gaussians.transformed(1.0, T_camera_world[:3, :3], T_camera_world[:3, 3]),
    )
