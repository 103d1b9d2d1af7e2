"""PatchMatch multi-view stereo: a depth, a normal and a confidence for every pixel of views with known cameras.

`estimate_depth_maps` does it for a set of views, `estimate_further_depth_map` for one more beside those that have a
map: there
`rank_partners` tells which views to compare it with, and `estimate_planes` matches it alone.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.system import raise_shortage
from splatnode.recon.clock import OutOfTime
from splatnode.recon.frames.keyframe import LIBRARY_ERRORS
from splatnode.recon.priors import multi_view_consistency
from splatnode.recon.priors.multi_view_consistency import DepthMap
from splatnode.recon.priors.patchmatch import (
    Matching,
    Planes,
    PyramidLevel,
    Search,
    improve_planes,
    make_level,
    resize_planes,
)
from splatnode.recon.threads import map_parallel

log = logging.getLogger(__name__)

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

MIN_SOURCE_SCORE = 0.01  # of a view to compare with, in [0, 1]: below, the two overlap in next to nothing
DEPTH_PERCENTILES = 1.0, 99.0  # of sparse depths, that count as the nearest and the farthest: few points are wrong
MIN_SPARSE_POINTS = 3  # to know a depth range
NEEDED_STAGES = 2  # those at a quarter of the resolution: without the second, no view's depth agrees with another's
PROBES = 8, 6, 5  # columns, rows and depths of the grid that stands in for sparse points


@dataclass(frozen=True)
class StereoStage:
    """One call of PatchMatch for every view."""

    level: int  # works at 1 / 2**level of the resolution
    search: Search
    geometric: bool = True  # whether the depth of the other views, from the stage before, is part of the cost


DEFAULT_STAGES = (
    StereoStage(2, Search(iterations=4, perturbation=4.0, random_starts=16), geometric=False),
    StereoStage(2, Search(iterations=2, perturbation=1.0)),
    StereoStage(1, Search(iterations=2, perturbation=1.0)),
    StereoStage(0, Search(iterations=1, perturbation=0.5)),
)


@dataclass(frozen=True)
class StereoConfig:
    num_sources: int = 4  # views that each view is compared with, at most
    num_checked: int = 8  # views that each view's depth is checked against, at most
    best_angle_deg: float = 12.0  # triangulation angle that matches best
    stages: tuple[StereoStage, ...] = DEFAULT_STAGES
    matching: Matching = field(default_factory=Matching)
    consistency: multi_view_consistency.ConsistencyConfig = field(
        default_factory=multi_view_consistency.ConsistencyConfig
    )


@dataclass(frozen=True, eq=False)
class StereoView:
    """An image with its camera, as stereo takes it. The centre of the top-left pixel is (0.5, 0.5)."""

    image: npt.NDArray[np.uint8]  # (h, w, 3) RGB
    K: Float64  # (3, 3)
    T_world_camera: Float64  # (4, 4)
    depth_range: tuple[float, float]  # nearest and farthest z that is searched
    name: str = "a view"  # of its keyframe, for the log

    def __post_init__(self) -> None:
        if self.image.ndim != 3 or self.image.shape[2] != 3 or self.image.dtype != np.uint8:
            raise ValueError(f"image must be (h, w, 3) uint8, got {self.image.shape} {self.image.dtype}")
        if self.K.shape != (3, 3) or self.T_world_camera.shape != (4, 4):
            raise ValueError(
                f"K must be (3, 3) and T_world_camera (4, 4), got {self.K.shape} and {self.T_world_camera.shape}"
            )
        near, far = self.depth_range
        if not 0 < near < far < np.inf:
            raise ValueError(f"depth_range must be 0 < near < far, got {self.depth_range}; see stereo.depth_range")


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Known points of a view, as structure from motion gives them, to start the search from."""

    points: Float64  # (M, 2) pixels of the view's image
    depths: Float64  # (M,) z in the camera frame


def estimate_depth_maps(
    views: Sequence[StereoView],
    config: StereoConfig,
    *,
    seed: int = 0,
    sparse: Sequence[SparsePoints | None] | None = None,
    pause: Callable[[], None] = lambda: None,
) -> list[DepthMap]:
    """A depth map for every view, in order. A view that overlaps with no other comes back without any depth.

    The result depends on the arguments only, not on the number of threads. `pause` is called several times a second;
    it may raise to abandon the work, and OutOfTime to end it: after NEEDED_STAGES, depth is as fine as it is by then.
    """
    known_points = list(sparse) if sparse is not None else [None] * len(views)
    if len(known_points) != len(views):
        raise ValueError(f"sparse must have one entry a view, got {len(known_points)} for {len(views)} views")
    partners = [rank_partners(views, index, config, known_points[index]) for index in range(len(views))]
    sources = [select_sources(ranked, config) for ranked in partners]
    finest = config.stages[-1].level
    levels: dict[int, list[PyramidLevel]] = {}
    planes: list[Planes] = []
    for stream, stage in enumerate(config.stages):
        if stage.level not in levels:
            levels[stage.level] = map_parallel(_make_level, views, [stage.level] * len(views))
        at_level = levels[stage.level]
        if not planes:
            planes = map_parallel(_initialize_or_unknown, views, at_level, known_points)
        planes = map_parallel(resize_planes, planes, at_level)
        improved = list(planes)
        try:
            for i in (index for index, chosen in enumerate(sources) if chosen):
                _call_pause(pause, may_end=stream >= NEEDED_STAGES)
                improved[i] = improve_planes(
                    at_level[i], [at_level[j] for j in sources[i]], planes[i], stage.search, config.matching,
                    known={n: planes[j].inverse_depth for n, j in enumerate(sources[i])} if stage.geometric else {},
                    seed=seed, stream=stream,
                )  # fmt: skip
        except OutOfTime:
            planes = improved
            break
        planes = improved
    if finest not in levels:
        levels[finest] = map_parallel(_make_level, views, [finest] * len(views))
    planes = map_parallel(resize_planes, planes, levels[finest])
    checked = [select_check_views(ranked, config) for ranked in partners]
    return multi_view_consistency.cross_check(levels[finest], planes, checked, config.matching, config.consistency)


def _call_pause(pause: Callable[[], None], may_end: bool) -> None:
    """Pauses; work that is needed goes on when time is over."""
    try:
        pause()
    except OutOfTime:
        if may_end:
            raise


def estimate_further_depth_map(
    views: Sequence[StereoView],
    index: int,
    depths: Mapping[int, Float32],
    config: StereoConfig,
    *,
    seed: int = 0,
    sparse: SparsePoints | None = None,
) -> DepthMap:
    """The depth map of view `index` alone, beside those that have one already.

    `depths` holds the depth maps (h, w), 0 where unknown, of other views by their index. They stay as they are, and
    the new map is checked against them. They should be `DepthMap.unchecked`: where a depth is unknown for want of
    views, no further view would ever find one.
    """
    partners = rank_partners(views, index, config, sparse)
    sources = select_sources(partners, config)
    known = {n: depths[j] for n, j in enumerate(sources) if j in depths}
    planes = estimate_planes(views[index], [views[j] for j in sources], config, seed=seed, sparse=sparse, known=known)
    finest = config.stages[-1].level
    checked = [j for j, _ in partners if j in depths][: config.num_checked]
    levels = {j: _make_level(views[j], finest) for j in (index, *checked)}
    others = [resize_planes(_make_flat_planes(depths[j]), levels[j]) for j in checked]
    agreeing = multi_view_consistency.compute_agreement(
        levels[index], planes, [levels[j] for j in checked], others, config.consistency
    )
    return multi_view_consistency.make_depth_map(levels[index], planes, agreeing, config.matching, config.consistency)


def estimate_planes(
    view: StereoView,
    sources: Sequence[StereoView],
    config: StereoConfig,
    *,
    seed: int = 0,
    sparse: SparsePoints | None = None,
    known: Mapping[int, Float32] | None = None,
) -> Planes:
    """The planes of `view` alone, matched against `sources`, not yet checked against other maps.

    `known` gives the depth maps (h, w), 0 where unknown, of the sources with these positions that have one already.
    """
    known_planes = {n: _make_flat_planes(depth) for n, depth in (known or {}).items()}
    planes: Planes | None = None
    for stream, stage in enumerate(config.stages):
        level, source_levels = _make_level(view, stage.level), [_make_level(source, stage.level) for source in sources]
        planes = resize_planes(planes, level) if planes else _initialize_planes(view, level, sparse)
        planes = improve_planes(
            level, source_levels, planes, stage.search, config.matching,
            known={n: resize_planes(p, source_levels[n]).inverse_depth for n, p in known_planes.items()},
            seed=seed, stream=stream,
        )  # fmt: skip
    if planes is None:
        raise ValueError("config.stages is empty: at least one stage is needed")
    return planes


def select_sources(partners: Sequence[tuple[int, float]], config: StereoConfig) -> list[int]:
    """Selects the views to match against from a view's ranked partners, best first; maybe none."""
    return [other for other, score in partners[: config.num_sources] if score > MIN_SOURCE_SCORE]


def select_check_views(partners: Sequence[tuple[int, float]], config: StereoConfig) -> list[int]:
    """Selects the views that check the depth from a view's ranked partners."""
    return [other for other, _ in partners[: config.num_checked]]


def rank_partners(
    views: Sequence[StereoView], index: int, config: StereoConfig, sparse: SparsePoints | None = None
) -> list[tuple[int, float]]:
    """All other views with how well view `index` can be compared with them, in [0, 1], best first.

    A candidate scores for every probe point of the view that falls into its image, by the triangulation angle: too
    small tells nothing, too large does not match. The probes are the sparse points, or a grid over the depth range.
    """
    view = views[index]
    pixels, depths = (sparse.points, sparse.depths) if sparse is not None and len(sparse.points) else _make_probes(view)
    rays = np.c_[pixels, np.ones(len(pixels))] @ np.linalg.inv(view.K).T
    world = (rays * depths[:, None]) @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3]
    scores = {
        other: float(
            (_is_inside(candidate, world) * _score_angles(view, candidate, world, config.best_angle_deg)).mean()
        )
        for other, candidate in enumerate(views)
        if other != index
    }
    return sorted(scores.items(), key=lambda scored: -scored[1])


def estimate_depth_range(depths: Float64, margin: float = 1.5) -> tuple[float, float]:
    """(near, far) to search, from the depths (M,) of sparse points of a view: robust extremes, widened by `margin`.

    Raises ValueError below MIN_SPARSE_POINTS positive depths.
    """
    depths = depths[np.isfinite(depths) & (depths > 0)]
    if len(depths) < MIN_SPARSE_POINTS:
        raise ValueError(
            f"at least {MIN_SPARSE_POINTS} sparse points are needed to know a depth range, got {len(depths)}"
        )
    near, far = np.percentile(depths, DEPTH_PERCENTILES)
    return float(near / margin), float(far * margin)


def _make_level(view: StereoView, level: int) -> PyramidLevel:
    return make_level(view.image, view.K, view.T_world_camera, view.depth_range, level)


def _initialize_or_unknown(view: StereoView, level: PyramidLevel, sparse: SparsePoints | None) -> Planes:
    """As `_initialize_planes`; all unknown, which the log tells, where a library fails on this view's points."""
    try:
        return _initialize_planes(view, level, sparse)
    except LIBRARY_ERRORS as error:
        raise_shortage(error)
        log.warning("%s: stereo begins without its sparse points: %s", view.name, error)
        return _initialize_planes(view, level, None)


def _initialize_planes(view: StereoView, level: PyramidLevel, sparse: SparsePoints | None) -> Planes:
    """The depth of the nearest sparse point, facing the camera; all unknown where there are no sparse points."""
    values = np.zeros((*level.shape, 3), np.float32)
    if sparse is not None and len(sparse.points):
        height, width = level.shape
        scale = np.array([width / view.image.shape[1], height / view.image.shape[0]])
        pixels: npt.NDArray[np.int64] = np.clip((sparse.points * scale).astype(int), 0, [width - 1, height - 1])
        x, y = pixels.T
        elsewhere = np.ones(level.shape, np.uint8)
        elsewhere[y, x] = 0
        nearest = cv2.distanceTransformWithLabels(elsewhere, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1]
        labels = nearest.astype(np.int64)
        inverse_depths = np.zeros(labels.max() + 1, np.float32)
        inverse_depths[labels[y, x]] = 1 / sparse.depths
        values[..., 0] = inverse_depths[labels]
    return Planes(values, np.zeros(level.shape, np.float32))


def _make_probes(view: StereoView) -> tuple[Float64, Float64]:
    """(M, 2) pixels and (M,) depths of a grid in the view's frustum, even in the logarithm of depth."""
    height, width = view.image.shape[:2]
    near, far = view.depth_range
    columns, rows, count = PROBES
    depths = np.geomspace(near, far, count + 2)[1:-1]
    u, v, z = np.meshgrid((np.arange(columns) + 0.5) * width / columns, (np.arange(rows) + 0.5) * height / rows, depths)
    return np.stack([u.ravel(), v.ravel()], 1), z.ravel()


def _is_inside(view: StereoView, world: Float64) -> npt.NDArray[np.bool_]:
    """Which of the points (M, 3) fall into the view's image."""
    T_camera_world = np.linalg.inv(view.T_world_camera)
    x, y, z = view.K @ (T_camera_world[:3, :3] @ world.T + T_camera_world[:3, 3:])
    height, width = view.image.shape[:2]
    return (z > 0) & (x >= 0) & (y >= 0) & (x < width * z) & (y < height * z)


def _score_angles(view: StereoView, other: StereoView, world: Float64, best_angle_deg: float) -> Float64:
    """(M,) in [0, 1]: how well the angle at each point between the rays of two views suits matching.

    A Gaussian around the best angle, narrow below it, where depth is uncertain, and wide above it, where views differ.
    """
    here, there = (camera.T_world_camera[:3, 3] - world for camera in (view, other))
    lengths = np.linalg.norm(here, axis=1) * np.linalg.norm(there, axis=1)
    angle = np.degrees(np.arccos(np.clip((here * there).sum(1) / np.maximum(lengths, 1e-12), -1, 1)))
    spread = np.where(angle < best_angle_deg, best_angle_deg / 2, 2 * best_angle_deg)
    return np.exp(-0.5 * ((angle - best_angle_deg) / spread) ** 2)


def _make_flat_planes(depth: Float32) -> Planes:
    """Planes of these depths (h, w), 0 where unknown, that face the camera."""
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    return Planes(np.stack([inverse, np.zeros_like(depth), np.zeros_like(depth)], -1), np.zeros_like(depth))
