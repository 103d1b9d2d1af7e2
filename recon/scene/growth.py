"""A scene takes further views in, or lets views go, where it stands: nothing that it has learnt is made anew."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt
import torch

from splatnode.recon.config import Config
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.geometry import Similarity, align_cameras, multiply_quats, quat_from_matrix
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.priors.classical import modelled_K
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.registration.register import RegisteredCamera, Registration
from splatnode.recon.scene.gaussians import Gaussians, concatenate
from splatnode.recon.scene.scene import Scene, View, begin

LEAST_POINTS = 8  # that a camera observes where its point map knows the depth, to say how far away it is
STRETCHED = 2.0  # by more than this factor no scene is
NEIGHBOURS = 3  # views beside a further one that tell what of it is known, hidden or empty


def in_world_of(scene: Scene, registration: Registration, graph: ViewGraph) -> Registration | None:
    """The registration in the scene's world, which its first camera defines; None where it lacks one of the scene's."""
    cameras = {graph.keyframes[camera.index].name: camera for camera in registration.cameras}
    if len(scene.views) < 2 or any(view.name not in cameras for view in scene.views):
        return None
    Ts_registered = np.stack([cameras[view.name].T_world_camera for view in scene.views])
    Ts_scene = np.stack([view.T_world_camera.double().numpy() for view in scene.views])
    scale = align_cameras(Ts_registered, Ts_scene).scale
    rotation = Ts_scene[0, :3, :3] @ Ts_registered[0, :3, :3].T
    similarity = Similarity(scale, rotation, Ts_scene[0, :3, 3] - scale * rotation @ Ts_registered[0, :3, 3])
    return replace(
        registration,
        cameras=tuple(
            replace(camera, T_world_camera=similarity.camera(camera.T_world_camera)) for camera in registration.cameras
        ),
        points=similarity(registration.points),
    )


def carried(pointmaps: Mapping[str, Pointmap], registration: Registration, graph: ViewGraph) -> dict[str, Pointmap]:
    """The point maps of registered cameras, with the cameras of `registration` and as far away as its points are."""
    moved = {}
    for camera in registration.cameras:
        keyframe = graph.keyframes[camera.index]
        if keyframe.name not in pointmaps:
            continue
        before = pointmaps[keyframe.name]
        moved[keyframe.name] = replace(
            before,
            depth=before.depth * np.float32(_farther(before, registration, camera, keyframe)),
            T_world_camera=camera.T_world_camera,
            K=modelled_K(graph, camera),
        )
    return moved


def _farther(pointmap: Pointmap, registration: Registration, camera: RegisteredCamera, keyframe: Keyframe) -> float:
    """Median of the depths of the points that a camera observes, over those that its point map has there."""
    mine = registration.observed_by == camera.index
    T_camera_world = np.linalg.inv(camera.T_world_camera)
    depths = registration.points[registration.observed_point[mine]] @ T_camera_world[2, :3] + T_camera_world[2, 3]
    height, width = pointmap.depth.shape
    column, row = np.clip(registration.observed_pixels[mine] * keyframe.scale, 0, [width - 1, height - 1]).astype(int).T
    known = (pointmap.depth[row, column] > 0) & (depths > 0)
    if known.sum() < LEAST_POINTS:
        return 1.0
    return float(np.median(depths[known] / pointmap.depth[row, column][known]))


def moved(
    scene: Scene, before: Mapping[str, Pointmap], after: Mapping[str, Pointmap], tolerance: float
) -> Scene | None:
    """The scene with its views where their point maps moved to, and the Gaussians that each view started with it.

    The far shell goes with the first view. None where a map is missing or the scene would not hold together: a camera
    moved by more than `tolerance` of the scene's depth, or the depths changed by more than a factor of STRETCHED.
    """
    if any(view.name not in before or view.name not in after for view in scene.views):
        return None
    motions = [_motion(view, before[view.name], after[view.name]) for view in scene.views]
    if any(motion.displaced > tolerance or motion.stretched > STRETCHED for motion in motions):
        return None
    gaussians = scene.gaussians.map(torch.clone)
    source, views = scene.gaussians.source_frame, []
    of_views = torch.tensor([view.frame_id for view in scene.views], dtype=source.dtype)
    for place, (view, motion) in enumerate(zip(scene.views, motions, strict=True)):
        going = source == view.frame_id
        _move(gaussians, going | ~torch.isin(source, of_views) if place == 0 else going, motion)
        T, K = (torch.from_numpy(matrix).float() for matrix in (after[view.name].T_world_camera, after[view.name].K))
        views.append(replace(view, T_world_camera=T, K=K))
    return replace(scene, views=tuple(views), gaussians=gaussians)


@dataclass(frozen=True, eq=False)
class _Motion:
    """How a view moves: what it shows is stretched in its camera's frame, and goes with the camera."""

    T_world_camera: npt.NDArray[np.float64]  # (4, 4) before
    stretch: npt.NDArray[np.float64]  # (3,)
    rigid: npt.NDArray[np.float64]  # (4, 4) of the world

    @property
    def displaced(self) -> float:
        """The largest change of the camera's matrix."""
        return float(np.abs((self.rigid @ self.T_world_camera - self.T_world_camera)[:3]).max())

    @property
    def stretched(self) -> float:
        """The largest change of a length, as a factor."""
        return float(np.exp(np.abs(np.log(self.stretch)).max()))


def _motion(view: View, before: Pointmap, after: Pointmap) -> _Motion:
    known = (before.depth > 0) & (after.depth > 0)
    farther = float(np.median(after.depth[known] / before.depth[known])) if known.any() else 1.0
    wider = np.diag(before.K)[:2] / np.diag(after.K)[:2]
    stretch = farther * np.array([*wider, 1.0])
    T_world_camera = view.T_world_camera.double().numpy()
    return _Motion(T_world_camera, stretch, after.T_world_camera @ np.linalg.inv(T_world_camera))


def _move(gaussians: Gaussians, going: torch.Tensor, motion: _Motion) -> None:
    """Moves the Gaussians `going` (N,) in place; a stretch makes them larger and does not bend them."""
    T_before = torch.from_numpy(motion.T_world_camera).float()
    stretch, rigid = torch.from_numpy(motion.stretch).float(), torch.from_numpy(motion.rigid).float()
    in_camera = (gaussians.means[going] - T_before[:3, 3]) @ T_before[:3, :3]
    stretched = (in_camera * stretch) @ T_before[:3, :3].T + T_before[:3, 3]
    gaussians.means[going] = stretched @ rigid[:3, :3].T + rigid[:3, 3]
    gaussians.quats[going] = multiply_quats(quat_from_matrix(rigid[:3, :3]), gaussians.quats[going])
    gaussians.log_scales[going] += stretch.log().mean()


def grow(
    scene: Scene, pointmaps: Mapping[str, Pointmap], graph: ViewGraph, registration: Registration, config: Config
) -> Scene:
    """`scene` with a view, and its Gaussians, for each registered camera that it does not have.

    `registration` and `pointmaps`, which has one for each of its cameras, are in the scene's world. A further view gets
    Gaussians where none of its neighbours is the better view of a surface, as when a scene begins. The far shell stays.
    """
    known = {view.name for view in scene.views}
    registered = {camera.index: graph.keyframes[camera.index].name for camera in registration.cameras}
    further = {name: index for index, name in registered.items() if name not in known}
    if not further:
        return scene
    shown = set(further.values()).union(*(_neighbours(graph, index, registered) for index in further.values()))
    cameras = tuple(camera for camera in registration.cameras if camera.index in shown)
    names = [graph.keyframes[camera.index].name for camera in cameras]
    begun = begin(
        tuple(pointmaps[name] for name in names),
        {graph.keyframes[index].name: graph.keyframes[index].image for index in shown},
        cameras,
        config.completion,
        config.seeding,
        msgspec.structs.replace(config.background, spacing_deg=0.0),
    )
    views = tuple(view for view in begun.views if view.name in further)
    ids = torch.tensor([view.frame_id for view in views], dtype=torch.int32)
    fresh = begun.gaussians.subset(torch.isin(begun.gaussians.source_frame, ids))
    grown = concatenate([scene.gaussians, fresh])
    return within(replace(scene, views=scene.views + views, gaussians=grown), config.most_gaussians)


def without(scene: Scene, names: Collection[str]) -> Scene:
    """The scene without these views and the Gaussians that started from them, in its first camera's world."""
    gone = torch.tensor([view.frame_id for view in scene.views if view.name in names], dtype=torch.int32)
    views = tuple(view for view in scene.views if view.name not in names)
    kept = scene.gaussians.subset(~torch.isin(scene.gaussians.source_frame, gone))
    if not views:
        return replace(scene, views=(), gaussians=kept)
    T_camera_world = torch.linalg.inv(views[0].T_world_camera.double())
    return replace(
        scene,
        views=tuple(
            replace(view, T_world_camera=(T_camera_world @ view.T_world_camera.double()).float()) for view in views
        ),
        gaussians=kept.transformed(1.0, T_camera_world[:3, :3], T_camera_world[:3, 3]),
    )


def _neighbours(graph: ViewGraph, index: int, registered: Collection[int]) -> list[int]:
    """The registered keyframes that have most matches with keyframe `index`."""
    matches = {
        i if j == index else j: len(pair.matches)
        for (i, j), pair in graph.pairs.items()
        if index in (i, j) and i in registered and j in registered
    }
    return sorted(matches, key=lambda other: -matches[other])[:NEIGHBOURS]


def within(scene: Scene, limit: int | None) -> Scene:
    """The scene with at most `limit` Gaussians: those that cover most."""
    gaussians = scene.gaussians
    if limit is None or len(gaussians) <= limit:
        return scene
    across = gaussians.scales.topk(2, dim=1).values.prod(1)
    kept = (gaussians.opacities * across).topk(limit).indices.sort().values
    return replace(scene, gaussians=gaussians.subset(kept))
