"""Growth: a scene takes further views in, or lets views go, where it stands; what it has learnt stays."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt
import torch

from splatnode.capture.frame import Intrinsics
from splatnode.recon.geometry import Similarity, align_cameras, multiply_quats, quat_from_matrix, transform_to_camera
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.priors import Pointmap, compute_modelled_K, select_sparse_points
from splatnode.recon.registration.registration import (
    RegisteredCamera,
    Registration,
    apply_known_lenses,
    corner_shift,
    undistort_keyframes,
)
from splatnode.recon.result.snapshot import decode_frame_id, encode_unconfirmed
from splatnode.recon.scene import Gaussians, Scene, TrainingView, background, concatenate, initialization
from splatnode.recon.scene import exposure as scene_exposure
from splatnode.recon.scene.exposure import compute_exposure_priors

NUM_NEIGHBOURS = 3  # views beside a further one that tell what of it is known, hidden or empty: each costs time


def grow(
    scene: Scene,
    pointmaps: Mapping[str, Pointmap],
    graph: ViewGraph,
    registration: Registration,
    config: initialization.SceneInitializationConfig,
    lighting: scene_exposure.ExposureConfig,
) -> Scene:
    """The scene with a view, and Gaussians seeded from it, for each registered camera that it does not have.

    `registration` and `pointmaps`, of which each of its cameras has one by name, are in the scene's world. A further
    view seeds Gaussians where none of its neighbours sees a surface better, as when a scene begins, and is brought to
    the scene's light first. Guesses on the path of its camera go. The far shell stays. `config.max_gaussians` does not
    count here; see `limit_gaussians`.
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
    metadata_exposures = compute_exposure_priors(graph.keyframes[index] for index in sorted(shown))
    exposures = scene_exposure.estimate_further_exposures(seen, images, falloffs, lit, lighting, metadata_exposures)
    begun = initialization.initialize_scene(
        seen,
        scene_exposure.compensate_images(images, exposures),
        initialization.SceneInitializationConfig(
            completion=config.completion,
            initialization=config.initialization,
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
    certain = [background.mask_doubtful(pointmap, config.completion) for pointmap in seen]
    path = background.find_free_path(certain, config.completion.clearance)
    stay = ~_find_guesses(scene, path)
    return replace(scene, views=before + views, gaussians=concatenate([scene.gaussians.subset(stay), fresh]))


def _find_guesses(scene: Scene, path: background.FreePath) -> torch.Tensor:
    """(N,) which Gaussians on that path no two views confirm."""
    source, points = scene.gaussians.source_frame.numpy(), scene.gaussians.means.detach().double().numpy()
    found = np.zeros(len(source), bool)
    for view in scene.views:
        own = np.flatnonzero(source == encode_unconfirmed(view.frame_id))
        found[own] = path.contains(points[own], view.T_world_camera[:3, 3].double().numpy())
    return torch.from_numpy(found)


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


# Warping: a scene follows a new registration of its cameras, and nothing that it has learnt is made anew.

MIN_POINTS = 8  # with a known depth at their pixels, that tell how much farther a camera's point map lies now
MAX_LENS_SHIFT = 0.002  # of the longer side, a pixel of 512, by which a new lens may move the corner of a photograph
MAX_STRETCH = 2.0  # largest ratio of depths that a scene is warped by; beyond it, the scene is rebuilt


@dataclass(frozen=True, eq=False)
class AlignedRegistration:
    """A scene, and what is known by now in its world; its photographs are those of the graph, straight as they are."""

    scene: Scene
    graph: ViewGraph
    registration: Registration


def align_registration(
    scene: Scene, registration: Registration, graph: ViewGraph, provisional: bool
) -> AlignedRegistration | None:
    """Aligns a new registration with the scene's world; None where that is impossible.

    Photographs are straightened. The lenses of a provisional registration are those of the scene, where it has some.
    """
    if provisional:
        registration = apply_known_lenses(registration, graph, {view.name: view.lens for view in scene.views})
    graph, registration = undistort_keyframes(graph, registration)
    straight = replace_images(scene, graph)
    placed = None if straight is None else registration_in_scene_world(straight, registration, graph)
    return None if straight is None or placed is None else AlignedRegistration(straight, graph, placed)


def registration_in_scene_world(scene: Scene, registration: Registration, graph: ViewGraph) -> Registration | None:
    """The registration after the similarity that brings the scene's first camera to where the scene has it.

    None where the scene has fewer than two views, or the registration lacks one of them.
    """
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
            replace(
                camera,
                T_world_camera=similarity.camera(camera.T_world_camera),
                centre_covariance=similarity.covariance(camera.centre_covariance),
            )
            for camera in registration.cameras
        ),
        points=similarity(registration.points),
    )


def replace_images(scene: Scene, graph: ViewGraph) -> Scene | None:
    """The scene with its photographs as `graph` has them, without the distortion that is estimated by now.

    None where that moves the corner of one by more than MAX_LENS_SHIFT, or `graph` lacks one.
    """
    keyframes, views = {keyframe.name: keyframe for keyframe in graph.keyframes}, []
    for view in scene.views:
        keyframe = keyframes.get(view.name)
        if keyframe is None or _compute_corner_distance(keyframe.lens, view.lens) > MAX_LENS_SHIFT:
            return None
        if keyframe.lens is not None:
            lit = view.exposure
            image, exposure = scene_exposure.compensate_image(
                keyframe.image, lit and lit.gains, lit.falloff if lit else 0.0, lit and lit.sigmas
            )
            view = replace(view, image=image, exposure=exposure, mask=keyframe.mask, lens=keyframe.lens)
        views.append(view)
    return replace(scene, views=tuple(views))


def _compute_corner_distance(one: Intrinsics | None, other: Intrinsics | None) -> float:
    """How far apart two lenses show a corner by their distortion and skew, over the longer side, at most."""
    skews = [0.0 if lens is None else lens.skew for lens in (one, other)]
    return abs(corner_shift(one) - corner_shift(other)) + 0.5 * abs(skews[0] - skews[1])


def update_pointmaps(
    pointmaps: Mapping[str, Pointmap], registration: Registration, graph: ViewGraph
) -> dict[str, Pointmap]:
    """The point maps of registered cameras, by name, with these cameras; depths are scaled to the registered points."""
    updated = {}
    for camera in registration.cameras:
        keyframe = graph.keyframes[camera.index]
        if keyframe.name not in pointmaps:
            continue
        before = pointmaps[keyframe.name]
        ratio = np.float32(_depth_ratio(before, registration, camera, keyframe))
        updated[keyframe.name] = replace(
            before,
            depth=before.depth * ratio,
            unchecked=None if before.unchecked is None else (before.unchecked * ratio).astype(np.float16),
            T_world_camera=camera.T_world_camera,
            K=compute_modelled_K(graph, camera),
        )
    return updated


def _depth_ratio(pointmap: Pointmap, registration: Registration, camera: RegisteredCamera, keyframe: Keyframe) -> float:
    """Median of the registered points' depths over the point map's at their pixels; 1 below MIN_POINTS points."""
    observed = select_sparse_points(registration, camera, keyframe.scale)
    height, width = pointmap.depth.shape
    column, row = np.clip(observed.points, 0, [width - 1, height - 1]).astype(int).T
    known = (pointmap.depth[row, column] > 0) & (observed.depths > 0)
    if known.sum() < MIN_POINTS:
        return 1.0
    return float(np.median(observed.depths[known] / pointmap.depth[row, column][known]))


def warp_scene(
    scene: Scene, before: Mapping[str, Pointmap], after: Mapping[str, Pointmap], max_shift: float
) -> Scene | None:
    """The scene with each view, and the Gaussians that were seeded from it, where its point map is `after`.

    `before` and `after` are by the views' names. The far shell goes with the first view. None where a map is missing or
    the scene would not hold together: a camera moves by more than `max_shift`, in the scene's unit, or lengths change
    by more than a factor of MAX_STRETCH.
    """
    if any(view.name not in before or view.name not in after for view in scene.views):
        return None
    warps = [_warp_of(view, before[view.name], after[view.name]) for view in scene.views]
    if any(warp.camera_shift > max_shift or warp.largest_stretch > MAX_STRETCH for warp in warps):
        return None
    gaussians = scene.gaussians.map(torch.clone)
    source, views = decode_frame_id(scene.gaussians.source_frame), []
    view_ids = torch.tensor([view.frame_id for view in scene.views], dtype=source.dtype)
    for index, (view, warp) in enumerate(zip(scene.views, warps, strict=True)):
        own = source == view.frame_id
        _apply(warp, gaussians, own | ~torch.isin(source, view_ids) if index == 0 else own)
        T, K = (torch.from_numpy(matrix).float() for matrix in (after[view.name].T_world_camera, after[view.name].K))
        views.append(replace(view, T_world_camera=T, K=K))
    return replace(scene, views=tuple(views), gaussians=gaussians)


@dataclass(frozen=True, eq=False)
class _Warp:
    """How what a view shows moves: it is stretched in the frame of the view's camera, then goes with the camera."""

    T_world_camera: npt.NDArray[np.float64]  # (4, 4) before
    stretch: npt.NDArray[np.float64]  # (3,) factors along the camera's axes
    rigid: npt.NDArray[np.float64]  # (4, 4) motion of the world that brings the camera to where it is after

    @property
    def camera_shift(self) -> float:
        """The largest change of the camera's centre along an axis of the world, or of an entry of its rotation."""
        return float(np.abs((self.rigid @ self.T_world_camera - self.T_world_camera)[:3]).max())

    @property
    def largest_stretch(self) -> float:
        """The largest change of a length as a factor, at least 1."""
        return float(np.exp(np.abs(np.log(self.stretch)).max()))


def _warp_of(view: TrainingView, before: Pointmap, after: Pointmap) -> _Warp:
    """Depths by their median ratio, directions by the focal lengths, the camera by the point maps' cameras."""
    known = (before.depth > 0) & (after.depth > 0)
    farther = float(np.median(after.depth[known] / before.depth[known])) if known.any() else 1.0
    wider = np.diag(before.K)[:2] / np.diag(after.K)[:2]
    stretch = farther * np.array([*wider, 1.0])
    T_world_camera = view.T_world_camera.double().numpy()
    return _Warp(T_world_camera, stretch, after.T_world_camera @ np.linalg.inv(T_world_camera))


def _apply(warp: _Warp, gaussians: Gaussians, chosen: torch.Tensor) -> None:
    """Warps the `chosen` (N,) Gaussians in place; a stretch makes them larger by its mean and does not bend them."""
    T_before = torch.from_numpy(warp.T_world_camera).float()
    stretch, rigid = torch.from_numpy(warp.stretch).float(), torch.from_numpy(warp.rigid).float()
    in_camera = transform_to_camera(gaussians.means[chosen], T_before)
    stretched = (in_camera * stretch) @ T_before[:3, :3].T + T_before[:3, 3]
    gaussians.means[chosen] = stretched @ rigid[:3, :3].T + rigid[:3, 3]
    gaussians.quats[chosen] = multiply_quats(quat_from_matrix(rigid[:3, :3]), gaussians.quats[chosen])
    gaussians.log_scales[chosen] += stretch.log().mean()
