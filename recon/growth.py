"""A scene takes further views in, or lets views go, where it stands: nothing that it has learnt is made anew."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import msgspec
import numpy as np
import torch

from recon.config import Config
from recon.gaussians import concatenate
from recon.geometry import align_cameras
from recon.priors.classical import modelled_K
from recon.priors.pointmap import Pointmap
from recon.registration.register import Registration
from recon.scene import Scene, begin
from recon.view_graph import ViewGraph

NEIGHBOURS = 4  # views beside a further one that tell what of it is known, hidden or empty


def in_world_of(scene: Scene, registration: Registration, graph: ViewGraph, tolerance: float) -> Registration | None:
    """The registration carried into the scene's world by the cameras that both have; None where it does not fit.

    It fits when it has all cameras of the scene, none of which it moved by more than `tolerance` of the scene's depth,
    and no focal length changed by more than that part of it.
    """
    cameras = {graph.keyframes[camera.index].name: camera for camera in registration.cameras}
    if len(scene.views) < 2 or any(view.name not in cameras for view in scene.views):
        return None
    Ts_registered = np.stack([cameras[view.name].T_world_camera for view in scene.views])
    Ts_scene = np.stack([view.T_world_camera.double().numpy() for view in scene.views])
    similarity = align_cameras(Ts_registered, Ts_scene)
    carried = np.stack([similarity.camera(T) for T in Ts_registered])
    zoomed = max(abs(modelled_K(graph, cameras[view.name])[0, 0] / float(view.K[0, 0]) - 1) for view in scene.views)
    if np.abs(carried[:, :3] - Ts_scene[:, :3]).max() > tolerance or zoomed > tolerance:
        return None
    return replace(
        registration,
        cameras=tuple(
            replace(camera, T_world_camera=similarity.camera(camera.T_world_camera)) for camera in registration.cameras
        ),
        points=similarity.scale * registration.points @ similarity.rotation.T + similarity.translation,
    )


def carried(pointmaps: Mapping[str, Pointmap], registration: Registration, graph: ViewGraph) -> dict[str, Pointmap]:
    """The point maps of registered cameras, at the scale and with the cameras of `registration`."""
    cameras = {graph.keyframes[camera.index].name: camera for camera in registration.cameras}
    names = [name for name in pointmaps if name in cameras]
    if len(names) < 2:
        return {}
    scale = align_cameras(
        np.stack([pointmaps[name].T_world_camera for name in names]),
        np.stack([cameras[name].T_world_camera for name in names]),
    ).scale
    return {
        name: replace(
            pointmaps[name],
            depth=pointmaps[name].depth * np.float32(scale),
            T_world_camera=cameras[name].T_world_camera,
            K=modelled_K(graph, cameras[name]),
        )
        for name in names
    }


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
        config.density,
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
