"""What stayed of the submaps, fitted so that every camera sees what its own submap showed it.

At a seam two scenes meet that were fitted apart: their surfaces are a little beside each other, and what one camera
never saw may hang before another one. What each submap shows to its own cameras is known, so the Gaussians are refined
to show that, all together, and the cameras find their places among them. On the way those go that no camera would
miss, and where there is a limit, those that the cameras would miss least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.geometry import transform_to_camera
from splatnode.recon.merging.submap import Submap
from splatnode.recon.optimize import training
from splatnode.recon.optimize.control import prune
from splatnode.recon.optimize.control.control import ControlChoice
from splatnode.recon.rasterize.dispatch import Camera
from splatnode.recon.result.export.prepare import select_gaussians
from splatnode.recon.result.rendering import NEAR, render_arrays
from splatnode.recon.result.report import render_camera
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.scene.background import SHELL
from splatnode.recon.scene.scene import Gaussians, Scene, TrainingView

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
    config = training.RefinementConfig(
        iterations=passes * len(views),
        checkpoints=(),
        first_opacity=None,
        control=ControlChoice("prune", prune.Config()),
        lr=_rates(),
    )
    *_, scene = training.refine(Scene(tuple(views), begun), config, seed=seed, max_gaussians=most)
    found = iter(scene.views)
    cameras = tuple(
        tuple(replace(camera, T_world_camera=_rigid(next(found).T_world_camera)) for camera in each.cameras)
        for each in submaps
    )
    return FitResult(scene.arrays(), cameras)


def _rates() -> training.LearningRates:
    whole = training.CAUTIOUS
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


# What a submap's cameras know of a point: whether they see a surface there, through it, or something before it.

Array = npt.NDArray[np.float64]

ALIKE = 0.05  # part of the depth within which a point lies on the surface: the depth that is rendered is a mean
BEFORE = 0.1  # part of the depth from which on a point lies before the surface
SOLID = 0.5  # opacity from which on a pixel has a surface
_AROUND = np.ones((3, 3), np.uint8)  # pixels among which a point's own is looked for: edges are blurred


@dataclass(frozen=True, eq=False)
class DepthView:
    """A camera, and between which depths the surface lies around each of its pixels."""

    camera: CameraEstimate
    nearest: npt.NDArray[np.float32]  # (H, W) infinite where there is no surface
    farthest: npt.NDArray[np.float32]  # (H, W) 0 where there is none


@dataclass(frozen=True, eq=False)
class PointVisibility:
    """The visibility of M points in the cameras of one submap. Pixels are those of the cameras at modelled size."""

    resolution: Array  # (M,) pixels a unit of length of the best camera that has the point on its surface, or 0
    on: npt.NDArray[np.int32]  # (M,) cameras that have the point on their surface
    before: npt.NDArray[np.int32]  # (M,) cameras that have it before their surface: they look through it
    veiled: Array  # (M,) pixels a unit of length at the surface behind the point, of the best such camera, or 0

    @property
    def quality(self) -> Array:
        """(M,) how well the point's surface is seen: the resolution, less for few views or disagreeing ones."""
        return self.resolution * self.on / (self.on + 1.0) * self.on / np.maximum(self.on + self.before, 1)


def depth_views(gaussians: GaussianArrays, cameras: Sequence[CameraEstimate]) -> tuple[DepthView, ...]:
    """Renders the surface of the Gaussians in each camera."""
    return tuple(_depth_view(gaussians, camera) for camera in cameras)


def surface_views(
    gaussians: GaussianArrays, shell: npt.NDArray[np.bool_], cameras: Sequence[CameraEstimate]
) -> tuple[DepthView, ...]:
    """The same without the far shell, which is no surface."""
    return depth_views(select_gaussians(gaussians, ~shell), cameras)


def measure_visibility(views: Sequence[DepthView], points: npt.NDArray[np.floating]) -> PointVisibility:
    """Measures the visibility of the world points (M, 3) in all `views` together."""
    count = len(points)
    resolution, veiled = np.zeros(count), np.zeros(count)
    on, before = np.zeros(count, np.int32), np.zeros(count, np.int32)
    for view in views:
        index, depth, nearest, farthest = _look_up_depths(view, points)
        focal = float(view.camera.K[0, 0])
        here = (depth >= (1 - ALIKE) * nearest) & (depth <= (1 + ALIKE) * farthest)
        through = depth < (1 - BEFORE) * nearest
        through &= np.isfinite(nearest)
        on[index[here]] += 1
        before[index[through]] += 1
        resolution[index[here]] = np.maximum(resolution[index[here]], focal / depth[here])
        veiled[index[through]] = np.maximum(veiled[index[through]], focal / nearest[through])
    return PointVisibility(resolution, on, before, veiled)


def _depth_view(gaussians: GaussianArrays, camera: CameraEstimate) -> DepthView:
    height, width = camera.height, camera.width
    if not len(gaussians):
        return DepthView(camera, np.full((height, width), np.inf, np.float32), np.zeros((height, width), np.float32))
    rendered = render_arrays(gaussians, camera.T_world_camera, camera.K, width, height, channels=("depth",))
    solid = (rendered.alpha >= SOLID) & (rendered.depth > 0)
    nearest = np.where(solid, rendered.depth, np.float32(np.inf)).astype(np.float32)
    farthest = np.where(solid, rendered.depth, np.float32(0)).astype(np.float32)
    eroded, dilated = cv2.erode(nearest, _AROUND), cv2.dilate(farthest, _AROUND)
    return DepthView(camera, np.asarray(eroded, np.float32), np.asarray(dilated, np.float32))


def _look_up_depths(
    view: DepthView, points: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.intp], Array, Array, Array]:
    """Looks up the points (M, 3) inside the image: returns indices, depths, and the nearest and farthest surface."""
    camera = view.camera
    local = transform_to_camera(points.astype(np.float64), camera.T_world_camera)
    ahead = np.flatnonzero(local[:, 2] > NEAR)
    x, y, z = local[ahead].T
    columns = np.floor(camera.K[0, 0] * x / z + camera.K[0, 2])
    rows = np.floor(camera.K[1, 1] * y / z + camera.K[1, 2])
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    at = rows[inside].astype(np.intp), columns[inside].astype(np.intp)
    nearest, farthest = view.nearest[at].astype(np.float64), view.farthest[at].astype(np.float64)
    return ahead[inside], z[inside], nearest, farthest
