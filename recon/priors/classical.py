"""The default prior, without any learned weights: structure from motion, then multi-view stereo."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching.view_graph import Matcher, ViewGraph
from splatnode.recon.priors import stereo
from splatnode.recon.priors.fusion import DepthMap
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.priors.prior import Prior
from splatnode.recon.registration.register import RegisteredCamera, Registration

Array = npt.NDArray[np.float64]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    stereo: stereo.Config = stereo.Config()
    seed: int = 0
    # Few sparse points lie on what is far, so stereo searches this many times further than they reach; in inverse
    # depth, in which it samples, that is a small part of the range.
    far_margin: float = 8.0


class DepthMaps(Protocol):
    """`stereo.depth_maps`, or another way to the same."""

    def __call__(
        self,
        views: Sequence[stereo.View],
        config: stereo.Config,
        *,
        seed: int = ...,
        sparse: Sequence[stereo.Sparse | None] | None = ...,
        pause: Callable[[], None] = ...,
    ) -> list[DepthMap]: ...


class ClassicalPrior(Prior):
    """Depth by `recon.priors.stereo`, or by another function in its place."""

    def __init__(
        self, config: Config, depth_maps: DepthMaps = stereo.depth_maps, matcher: Matcher | None = None
    ) -> None:
        self._config, self._depth_maps, self.matcher = config, depth_maps, matcher

    def pointmaps(
        self, graph: ViewGraph, registration: Registration, pause: Callable[[], None] = lambda: None
    ) -> tuple[Pointmap, ...]:
        views, sparse = self._views(graph, registration)
        maps = self._depth_maps(views, self._config.stereo, seed=self._config.seed, sparse=sparse, pause=pause)
        return tuple(map(_pointmap, _keyframes(graph, registration), views, maps))

    def further_pointmaps(
        self, graph: ViewGraph, registration: Registration, known: Mapping[str, Pointmap]
    ) -> tuple[Pointmap, ...]:
        views, sparse = self._views(graph, registration)
        keyframes = _keyframes(graph, registration)
        depths = {i: known[keyframe.name].depth for i, keyframe in enumerate(keyframes) if keyframe.name in known}
        found = []
        for i in (i for i, keyframe in enumerate(keyframes) if keyframe.name not in known):
            depth_map = stereo.further_depth_map(
                views, i, depths, self._config.stereo, seed=self._config.seed, sparse=sparse[i]
            )
            depths[i] = depth_map.depth
            found.append(_pointmap(keyframes[i], views[i], depth_map))
        return tuple(found)

    def _views(self, graph: ViewGraph, registration: Registration) -> tuple[list[stereo.View], list[stereo.Sparse]]:
        """The registered cameras as stereo wants them, with the points that they see."""
        views, sparse = [], []
        for camera in registration.cameras:
            keyframe = graph.keyframes[camera.index]
            points = sparse_points(registration, camera, keyframe.scale)
            near, far = stereo.depth_range(points.depths)
            near_far = (near, self._config.far_margin * far)
            views.append(stereo.View(keyframe.image, modelled_K(graph, camera), camera.T_world_camera, near_far))
            sparse.append(points)
        return views, sparse


def _keyframes(graph: ViewGraph, registration: Registration) -> list[Keyframe]:
    return [graph.keyframes[camera.index] for camera in registration.cameras]


def _pointmap(keyframe: Keyframe, view: stereo.View, depth_map: DepthMap) -> Pointmap:
    return Pointmap(
        name=keyframe.name,
        frame_id=keyframe.frame.frame_id,
        depth=depth_map.depth,
        confidence=depth_map.confidence,
        normal=depth_map.normal,
        T_world_camera=view.T_world_camera,
        K=view.K,
    )


def load(config: Config) -> ClassicalPrior:
    return ClassicalPrior(config)


def modelled_K(graph: ViewGraph, camera: RegisteredCamera) -> Array:
    """(3, 3) intrinsics of a registered camera for its image at modelled size."""
    keyframe = graph.keyframes[camera.index]
    (sx, sy), (cx, cy) = keyframe.scale, camera.principal
    return np.array([[camera.focal * sx, 0.0, cx * sx], [0.0, camera.focal * sy, cy * sy], [0.0, 0.0, 1.0]])


def sparse_points(registration: Registration, camera: RegisteredCamera, scale: tuple[float, float]) -> stereo.Sparse:
    """The registered points that a camera sees, at the modelled size that `scale` leads to."""
    mine = registration.observed_by == camera.index
    world = registration.points[registration.observed_point[mine]]
    to_camera = np.linalg.inv(camera.T_world_camera)
    depths = world @ to_camera[2, :3] + to_camera[2, 3]
    return stereo.Sparse(registration.observed_pixels[mine] * scale, depths)
