"""The default prior, without learned weights: PatchMatch stereo between registered cameras, and no matches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.config import Internal
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching.view_graph import Matcher, ViewGraph
from splatnode.recon.priors import (
    Pointmap,
    Prior,
    compute_depth_range,
    compute_modelled_K,
    select_sparse_points,
    stereo,
)
from splatnode.recon.priors.stereo import DepthMap
from splatnode.recon.registration.registration import Registration
from splatnode.recon.threads import BACKGROUND, RunContext


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    stereo: Internal[stereo.StereoConfig] = stereo.StereoConfig()
    seed: Internal[int] = 0  # of the random planes that stereo begins with
    # Few sparse points lie on what is far, so stereo searches this many times farther than they reach; in inverse
    # depth, in which it samples, that is a small part of the range.
    far_margin: Internal[float] = 8.0


class DepthEstimator(Protocol):
    """`stereo.depth_maps`, or another function with the same arguments and result."""

    def __call__(
        self,
        views: Sequence[stereo.StereoView],
        config: stereo.StereoConfig,
        *,
        seed: int = ...,
        sparse: Sequence[stereo.SparsePoints | None] | None = ...,
        run: RunContext = ...,
    ) -> list[DepthMap]: ...


class ClassicalPrior(Prior):
    """Depth by `recon.priors.stereo`, or by `depth_maps` in its place; matches by `matcher`, if there is
    one.
    """

    def __init__(
        self, config: Config, depth_maps: DepthEstimator = stereo.estimate_depth_maps, matcher: Matcher | None = None
    ) -> None:
        self._config, self._depth_maps, self.matcher = config, depth_maps, matcher
        self.ends_early = depth_maps is stereo.estimate_depth_maps

    def pointmaps(
        self, graph: ViewGraph, registration: Registration, run: RunContext = BACKGROUND
    ) -> tuple[Pointmap, ...]:
        views, sparse = self._make_views(graph, registration)
        maps = self._depth_maps(views, self._config.stereo, seed=self._config.seed, sparse=sparse, run=run)
        return tuple(map(_make_pointmap, _select_keyframes(graph, registration), views, maps))

    def further_pointmaps(
        self, graph: ViewGraph, registration: Registration, known: Mapping[str, Pointmap]
    ) -> tuple[Pointmap, ...]:
        views, sparse = self._make_views(graph, registration)
        keyframes = _select_keyframes(graph, registration)
        depths = {i: _select_depth(known[each.name]) for i, each in enumerate(keyframes) if each.name in known}
        found = []
        for i in (i for i, keyframe in enumerate(keyframes) if keyframe.name not in known):
            depth_map = stereo.estimate_further_depth_map(
                views, i, depths, self._config.stereo, seed=self._config.seed, sparse=sparse[i]
            )
            depths[i] = depth_map.unchecked.astype(np.float32)
            found.append(_make_pointmap(keyframes[i], views[i], depth_map))
        return tuple(found)

    def _make_views(
        self, graph: ViewGraph, registration: Registration
    ) -> tuple[list[stereo.StereoView], list[stereo.SparsePoints]]:
        """The registered cameras as stereo takes them, and the registered points that each observes."""
        views, sparse = [], []
        for camera in registration.cameras:
            keyframe = graph.keyframes[camera.index]
            points = select_sparse_points(registration, camera, keyframe.scale)
            near, far = compute_depth_range(registration, camera, points)
            near_far = (near, self._config.far_margin * far)
            K, T_world_camera = compute_modelled_K(graph, camera), camera.T_world_camera
            views.append(stereo.StereoView(keyframe.image, K, T_world_camera, near_far, keyframe.name))
            sparse.append(points)
        return views, sparse


def _select_keyframes(graph: ViewGraph, registration: Registration) -> list[Keyframe]:
    return [graph.keyframes[camera.index] for camera in registration.cameras]


def _make_pointmap(keyframe: Keyframe, view: stereo.StereoView, depth_map: DepthMap) -> Pointmap:
    return Pointmap(
        name=keyframe.name,
        frame_id=keyframe.frame.frame_id,
        depth=depth_map.depth,
        confidence=depth_map.confidence,
        normal=depth_map.normal,
        T_world_camera=view.T_world_camera,
        K=view.K,
        unchecked=depth_map.unchecked,
    )


def _select_depth(pointmap: Pointmap) -> npt.NDArray[np.float32]:
    """(h, w) the depth that further views are compared with."""
    return pointmap.depth if pointmap.unchecked is None else pointmap.unchecked.astype(np.float32)


def load(config: Config) -> ClassicalPrior:
    """Needs no weights."""
    return ClassicalPrior(config)
