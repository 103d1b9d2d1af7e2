"""What stayed of the submaps, fitted so that every camera sees what its own submap showed it.

At a seam two scenes meet that were fitted apart: their surfaces are a little beside each other, and what one camera
never saw may hang before another one. What each submap shows to its own cameras is known, so the Gaussians are refined
to show that, all together, and the cameras find their places among them. On the way those go that no camera would
miss, and where there is a limit, those that the cameras would miss least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.merging.submap import Submap
from splatnode.recon.optimize import refinement
from splatnode.recon.optimize.control import prune
from splatnode.recon.optimize.control.control import ControlChoice
from splatnode.recon.rasterize.gaussian_render import Camera
from splatnode.recon.result.preview import render_camera
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.scene.background import SHELL
from splatnode.recon.scene.gaussians import Gaussians
from splatnode.recon.scene.scene import Scene, TrainingView

PASSES = 16  # iterations for each camera
RATE = 0.5  # of the step sizes of a refinement: the submaps are fitted already
SHELL_SHARE = 0.1  # of a limit on the Gaussians, at most, for the far shells


@dataclass(frozen=True, eq=False)
class FitResult:
    """The Gaussians of a map, each with the number of its submap as source frame, or SHELL; and all its cameras."""

    gaussians: GaussianArrays
    cameras: tuple[tuple[CameraEstimate, ...], ...]  # of each submap, where they see what that submap showed


def fit_gaussians(
    submaps: Sequence[Submap],
    gaussians: GaussianArrays,
    *,
    most: int | None = None,
    passes: int = PASSES,
    seed: int = 0,
) -> FitResult:
    """The `gaussians` of the `submaps`, whose median depth must be about 1, at most `most` of them.

    Their source frames are as `FitResult` has them.
    """
    views = [_view(each.gaussians, camera) for each in submaps for camera in each.cameras]
    begun = _tensors(gaussians)
    if most is not None:
        begun = _limit_shells(begun, [_camera(view) for view in views], most, seed)
    config = refinement.RefinementConfig(
        iterations=passes * len(views),
        checkpoints=(),
        first_opacity=None,
        control=ControlChoice("prune", prune.Config()),
        rates=_rates(),
    )
    *_, scene = refinement.refine(Scene(tuple(views), begun), config, seed=seed, max_gaussians=most)
    found = iter(scene.views)
    cameras = tuple(
        tuple(replace(camera, T_world_camera=_rigid(next(found).T_world_camera)) for camera in each.cameras)
        for each in submaps
    )
    return FitResult(scene.arrays(), cameras)


def _rates() -> refinement.LearningRates:
    whole = refinement.CAUTIOUS
    slower = {name: RATE * getattr(whole, name) for name in ("means", "quats", "log_scales", "sh")}
    return msgspec.structs.replace(whole, **slower)


def _view(gaussians: GaussianArrays, camera: CameraEstimate) -> TrainingView:
    """Renders the submap in its own camera, as the image to fit."""
    return TrainingView(
        camera.name,
        camera.frame_id,
        render_camera(gaussians, camera),
        torch.from_numpy(camera.T_world_camera).float(),
        torch.from_numpy(camera.K).float(),
    )


def _camera(view: TrainingView) -> Camera:
    return Camera(view.T_world_camera, view.K, view.width, view.height)


def _limit_shells(gaussians: Gaussians, cameras: Sequence[Camera], most: int, seed: int) -> Gaussians:
    """Without the shells' Gaussians that are missed least, where a limit left too little beside all of them."""
    shell = (gaussians.source_frame == SHELL).nonzero()[:, 0]
    room = int(SHELL_SHARE * most)
    if len(shell) <= room:
        return gaussians
    worth = prune.estimate_removal_changes(gaussians, cameras, 1, torch.Generator().manual_seed(seed))
    keep = gaussians.source_frame != SHELL
    keep[shell[worth[shell].topk(room).indices]] = True
    return gaussians.subset(keep)


def _tensors(gaussians: GaussianArrays) -> Gaussians:
    opacities = np.clip(gaussians.opacities.astype(np.float64), 1e-6, 1 - 1e-6)

    def tensor(values: npt.NDArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))

    return Gaussians(
        means=tensor(gaussians.means),
        quats=tensor(gaussians.quats),
        log_scales=tensor(np.log(gaussians.scales)),
        logit_opacities=tensor(np.log(opacities) - np.log1p(-opacities)),
        sh=tensor(gaussians.sh),
        source_frame=torch.from_numpy(gaussians.source_frame),
    )


def _rigid(T: Tensor) -> npt.NDArray[np.float64]:
    """(4, 4) in float64, with a rotation that is one: that of float32 is rounded in every step."""
    exact = T.double().numpy().copy()
    u, _, vt = np.linalg.svd(exact[:3, :3])
    exact[:3, :3] = u @ vt
    return exact
