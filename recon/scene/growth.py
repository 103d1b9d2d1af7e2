"""Growth: a scene takes further views in, or lets views go, where it stands; what it has learnt stays."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import msgspec
import torch

from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.registration.register import Registration
from splatnode.recon.result.sources import decode_frame_id
from splatnode.recon.scene import initialisation, light
from splatnode.recon.scene.gaussians import concatenate
from splatnode.recon.scene.scene import Scene, TrainingView
from splatnode.recon.scene.told_light import compute_exposure_priors

NUM_NEIGHBOURS = 3  # views beside a further one that tell what of it is known, hidden or empty: each costs time


def grow(
    scene: Scene,
    pointmaps: Mapping[str, Pointmap],
    graph: ViewGraph,
    registration: Registration,
    config: initialisation.SceneInitializationConfig,
    lighting: light.ExposureConfig,
) -> Scene:
    """The scene with a view, and Gaussians seeded from it, for each registered camera that it does not have.

    `registration` and `pointmaps`, of which each of its cameras has one by name, are in the scene's world. A further
    view seeds Gaussians where none of its neighbours sees a surface better, as when a scene begins, and is brought to
    the scene's light first. The far shell stays. `config.max_gaussians` does not count here; see `limit_gaussians`.
    """
    known = {view.name for view in scene.views}
    registered = {camera.index: graph.keyframes[camera.index].name for camera in registration.cameras}
    further = {name: index for index, name in registered.items() if name not in known}
    if not further:
        return scene
    shown = set(further.values()).union(*(_neighbours(graph, index, registered) for index in further.values()))
    cameras = tuple(camera for camera in registration.cameras if camera.index in shown)
    seen = [pointmaps[graph.keyframes[camera.index].name] for camera in cameras]
    images = {view.name: view.image for view in scene.views} | {
        name: graph.keyframes[index].image for name, index in further.items()
    }
    lit = {view.name: view.exposure for view in scene.views if view.exposure is not None}
    falloffs = {name: _falloff(scene, pointmaps[name]) for name in further}
    told = compute_exposure_priors(graph.keyframes[index] for index in sorted(shown))
    exposures = light.estimate_further_exposures(seen, images, falloffs, lit, lighting, told)
    begun = initialisation.initialize_scene(
        seen,
        light.compensate_images(images, exposures),
        initialisation.SceneInitializationConfig(
            completion=config.completion,
            seeding=config.seeding,
            background=msgspec.structs.replace(config.background, spacing_deg=0.0),
        ),
        {graph.keyframes[index].name: graph.keyframes[index].mask for index in shown},
        exposures,
        lenses={graph.keyframes[index].name: graph.keyframes[index].lens for index in shown},
    )
    views = tuple(view for view in begun.views if view.name in further)
    before = tuple(_update_consistent_depth(view, begun.views) for view in scene.views)
    ids = torch.tensor([view.frame_id for view in views], dtype=torch.int32)
    fresh = begun.gaussians.subset(torch.isin(decode_frame_id(begun.gaussians.source_frame), ids))
    return replace(scene, views=before + views, gaussians=concatenate([scene.gaussians, fresh]))


def remove_views(scene: Scene, names: Collection[str]) -> Scene:
    """The scene without these views and the Gaussians that were seeded from them, in its first camera's world."""
    gone = torch.tensor([view.frame_id for view in scene.views if view.name in names], dtype=torch.int32)
    # What the views that go away confirmed is not known of the others any more.
    views = tuple(replace(view, consistent_depth=None) for view in scene.views if view.name not in names)
    kept = scene.gaussians.subset(~torch.isin(decode_frame_id(scene.gaussians.source_frame), gone))
    if not views:
        return replace(scene, views=(), gaussians=kept)
    T_camera_world = torch.linalg.inv(views[0].T_world_camera.double())
    return replace(
        scene,
        views=tuple(
            replace(view, T_world_camera=(T_camera_world @ view.T_world_camera.double()).float()) for view in views
        ),
        gaussians=kept.transform(1.0, T_camera_world[:3, :3], T_camera_world[:3, 3]),
    )


def _update_consistent_depth(view: TrainingView, beside: Sequence[TrainingView]) -> TrainingView:
    """The view with the share that those `beside` it confirm, where that is more: some of what it shares is theirs."""
    found = next((each.consistent_depth for each in beside if each.name == view.name), None)
    if found is None or (view.consistent_depth is not None and view.consistent_depth >= found):
        return view
    return replace(view, consistent_depth=found)


def _falloff(scene: Scene, pointmap: Pointmap) -> float:
    """Returns the falloff of a further image's lens: that of the view whose lens is most like it."""
    focal_lengths = [view.K[0, 0].item() / max(view.width, view.height) for view in scene.views]
    own = pointmap.K[0, 0] / max(pointmap.depth.shape)
    nearest = min(zip(focal_lengths, scene.views, strict=True), key=lambda lens: abs(lens[0] - own))[1]
    return nearest.exposure.falloff if nearest.exposure else 0.0


def _neighbours(graph: ViewGraph, index: int, registered: Collection[int]) -> list[int]:
    """The registered keyframes that have most matches with keyframe `index`, at most NUM_NEIGHBOURS."""
    matches = {
        i if j == index else j: len(pair.matches)
        for (i, j), pair in graph.pairs.items()
        if index in (i, j) and i in registered and j in registered
    }
    return sorted(matches, key=lambda other: -matches[other])[:NUM_NEIGHBOURS]


def limit_gaussians(scene: Scene, max_gaussians: int | None) -> Scene:
    """The scene with at most `max_gaussians`: those of the largest opacity times area; None is no limit."""
    gaussians = scene.gaussians
    if max_gaussians is None or len(gaussians) <= max_gaussians:
        return scene
    area = gaussians.scales.topk(2, dim=1).values.prod(1)
    kept = (gaussians.opacities * area).topk(max_gaussians).indices.sort().values
    return replace(scene, gaussians=gaussians.subset(kept))
