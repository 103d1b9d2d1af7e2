"""Warping: a scene follows a new registration of its cameras, and nothing that it has learnt is made anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.geometry import Similarity, align_cameras, multiply_quats, quat_from_matrix, transform_to_camera
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.priors.registered_camera import compute_modelled_K, select_sparse_points
from splatnode.recon.registration.register import RegisteredCamera, Registration
from splatnode.recon.registration.straightened import apply_known_lenses, corner_shift, undistort_keyframes
from splatnode.recon.result.sources import decode_frame_id
from splatnode.recon.scene import light
from splatnode.recon.scene.gaussians import Gaussians
from splatnode.recon.scene.scene import Scene, TrainingView

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
        if keyframe is None or abs(corner_shift(keyframe.lens) - corner_shift(view.lens)) > MAX_LENS_SHIFT:
            return None
        if keyframe.lens is not None:
            lit = view.exposure
            image, exposure = light.compensate_image(keyframe.image, lit and lit.gains, lit.falloff if lit else 0.0)
            view = replace(view, image=image, exposure=exposure, mask=keyframe.mask, lens=keyframe.lens)
        views.append(view)
    return replace(scene, views=tuple(views))


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
