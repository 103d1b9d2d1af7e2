"""PatchMatch multi-view stereo: a depth, a normal and a confidence for every pixel of views with known cameras.

`estimate_depth_maps` does it for a set of views, `estimate_further_depth_map` for one more beside those that have a
map: there `rank_partners` tells which views to compare it with, and `estimate_planes` matches it alone. The compiled
PatchMatch (recon/core/patchmatch.h) takes planes and gives better ones. What other views confirm of depth maps is kept,
what nothing supports is left out.
"""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.system import raise_shortage
from splatnode.recon.core import library, pointer
from splatnode.recon.keyframes import LIBRARY_ERRORS
from splatnode.recon.threads import BACKGROUND, OutOfTime, RunContext, map_parallel

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
MAX_SOURCES = 16  # kMaxSources of recon/core/patchmatch.h


@dataclass(frozen=True)
class Matching:
    """How planes are compared. Pixels are those of the level at hand."""

    best_weight_ratio: float = 0.5  # weight of the next-best source relative to the better one
    sigma_grey: float = 16.0  # bilateral weight of the window, grey levels
    sigma_space: float = 5.0  # bilateral weight of the window, pixels
    noise_variance: float = 2.0  # grey levels squared: patches flatter than this give no evidence
    smoothness: float = 0.01  # cost per neighbour and pixel of parallax between a plane and the neighbour's point
    smoothness_limit: float = 2.0  # most that counts of that parallax, pixels
    geometric: float = 0.1  # cost per pixel of forward-backward reprojection error
    geometric_limit: float = 2.0  # most that counts of that error, pixels


@dataclass(frozen=True)
class Search:
    """Which planes are tried."""

    iterations: int  # each visits every pixel once
    perturbation: float  # size of random changes in the first iteration, pixels of parallax; halved in each
    active_sources: int = 3  # per pixel: those that explain its plane best; new planes are compared in these alone
    random_starts: int = 0  # planes tried per pixel over the whole depth range before the first iteration


@dataclass(frozen=True, eq=False)
class PyramidLevel:
    """A view at one resolution. The centre of the top-left pixel is (0.5, 0.5)."""

    grey: npt.NDArray[np.uint8]  # (h, w)
    packed: npt.NDArray[np.int32]  # (h, w) each pixel with its right, lower and lower right neighbours
    K: Float64  # (3, 3)
    T_world_camera: Float64  # (4, 4)
    depth_range: tuple[float, float]

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w)."""
        return self.grey.shape[0], self.grey.shape[1]


@dataclass(frozen=True, eq=False)
class Planes:
    """A plane for every pixel: inverse depth at the pixel's centre and its change per pixel to the right and down."""

    values: Float32  # (h, w, 3); (0, 0, 0) is "unknown"
    costs: Float32  # (h, w) matching and geometric cost, 0 is perfect

    @property
    def inverse_depth(self) -> Float32:
        """(h, w) at the pixels' centres, 0 where unknown."""
        return self.values[..., 0]


class Transfer(ctypes.Structure):
    """Pixel (u, v) at inverse depth w lies at A (u, v, 1) + t w of the other camera, in homogeneous pixels."""

    _fields_ = (("A", ctypes.c_float * 9), ("t", ctypes.c_float * 3))


class _Source(ctypes.Structure):
    _fields_ = (
        ("packed", ctypes.c_void_p),
        ("inverse_depth", ctypes.c_void_p),
        ("width", ctypes.c_int32),
        ("height", ctypes.c_int32),
        ("from_reference", Transfer),
        ("to_reference", Transfer),
    )


class _Problem(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("grey", "planes", "costs")),
        *((name, ctypes.c_int32) for name in ("width", "height")),
        *((name, ctypes.c_float) for name in ("fx", "fy", "cx", "cy", "min_inverse_depth", "max_inverse_depth")),
        ("sources", ctypes.c_void_p),
        *((name, ctypes.c_int32) for name in ("num_sources", "active_sources", "random_starts", "iterations")),
        *((name, ctypes.c_uint32) for name in ("stream", "seed")),
        *((name, ctypes.c_float) for name in ("perturbation", *Matching.__dataclass_fields__)),
    )


def make_level(
    image: npt.NDArray[np.uint8],  # (H, W, 3) RGB
    K: Float64,  # (3, 3)
    T_world_camera: Float64,  # (4, 4)
    depth_range: tuple[float, float],
    level: int,
) -> PyramidLevel:
    """The view at 1 / 2**level of its resolution."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    size = max(1, round(width / 2**level)), max(1, round(height / 2**level))
    if level:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    grey = np.ascontiguousarray(grey, np.uint8)
    packed = np.empty(grey.shape, np.int32)
    library().patchmatch_pack(pointer(grey), *size, pointer(packed))
    scale = np.diag([size[0] / width, size[1] / height, 1.0])
    return PyramidLevel(grey, packed, scale @ K, T_world_camera, depth_range)


def improve_planes(
    view: PyramidLevel,
    sources: Sequence[PyramidLevel],
    planes: Planes,
    search: Search,
    matching: Matching,
    *,
    known: Mapping[int, Float32],
    seed: int,
    stream: int,
) -> Planes:
    """Planes of `view` that explain `sources` better than `planes`, which is left as it was.

    `known` gives inverse depths (h, w), 0 where unknown, of the sources with these positions in `sources`.
    `seed` and `stream` choose the random numbers. Raises ValueError for no or too many sources, or a wrong shape.
    """
    if not 1 <= len(sources) <= MAX_SOURCES:
        raise ValueError(f"between 1 and {MAX_SOURCES} sources are needed, got {len(sources)}")
    if planes.values.shape != (*view.shape, 3):
        raise ValueError(f"planes must be {(*view.shape, 3)}, got {planes.values.shape}")
    values, costs = planes.values.copy(), planes.costs.copy()
    depths = [
        np.ascontiguousarray(known[i], np.float32) if i in known else np.zeros(source.shape, np.float32)
        for i, source in enumerate(sources)
    ]
    if any(depth.shape != source.shape for depth, source in zip(depths, sources, strict=True)):
        raise ValueError(f"known must be as large as the sources, got {[depth.shape for depth in depths]}")
    matching = matching if known else replace(matching, geometric=0.0)
    array = (_Source * len(sources))(
        *(
            _Source(
                pointer(source.packed), pointer(depth), source.shape[1], source.shape[0],
                compute_transfer(view, source), compute_transfer(source, view),
            )
            for source, depth in zip(sources, depths, strict=True)
        )
    )  # fmt: skip
    near, far = view.depth_range
    problem = _Problem(
        pointer(view.grey), pointer(values), pointer(costs), view.shape[1], view.shape[0],
        view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2], 1 / far, 1 / near,
        ctypes.cast(array, ctypes.c_void_p), len(sources),
        search.active_sources, search.random_starts, search.iterations,
        stream, seed & 0xFFFFFFFF, search.perturbation,
        *(getattr(matching, name) for name in Matching.__dataclass_fields__),
    )  # fmt: skip
    library().patchmatch_run(ctypes.byref(problem))
    return Planes(values, costs)


def compute_transfer(reference: PyramidLevel, other: PyramidLevel) -> Transfer:
    """The map from pixels and inverse depths of `reference` to pixels of `other`."""
    T_other_reference = np.linalg.inv(other.T_world_camera) @ reference.T_world_camera
    A = other.K @ T_other_reference[:3, :3] @ np.linalg.inv(reference.K)
    t = other.K @ T_other_reference[:3, 3]
    return Transfer((ctypes.c_float * 9)(*A.ravel()), (ctypes.c_float * 3)(*t))


def resize_planes(planes: Planes, view: PyramidLevel) -> Planes:
    """The planes for the pixels of another resolution: each pixel takes the plane that its centre falls into."""
    height, width = planes.inverse_depth.shape
    if (height, width) == view.shape:
        return planes
    rows, down, per_row = _find_nearest(height, view.shape[0])
    columns, right, per_column = _find_nearest(width, view.shape[1])
    values = planes.values[rows[:, None], columns[None, :]]
    inverse_depth = values[..., 0] + values[..., 1] * right[None, :] + values[..., 2] * down[:, None]
    resized_values = np.stack([inverse_depth, values[..., 1] * per_column, values[..., 2] * per_row], -1)
    return Planes(resized_values.astype(np.float32), planes.costs[rows[:, None], columns[None, :]])


def _find_nearest(size: int, new_size: int) -> tuple[npt.NDArray[np.intp], Float32, float]:
    """For each new pixel: the old pixel, the distance from its centre in old pixels; and old pixels per new pixel."""
    step = size / new_size
    centres = (np.arange(new_size) + 0.5) * step
    index = np.minimum(centres.astype(np.intp), size - 1)
    return index, (centres - index - 0.5).astype(np.float32), step


MAX_CONSISTENT = 3  # views that agree, beyond which a further one adds nothing to the confidence
MIN_CONTRAST = 0.5  # grey levels, added before the logarithm: the standard deviation that rounding leaves


@dataclass(frozen=True)
class Confidence:
    """Log-odds that a depth is within 1 %, linear in what is known of it.

    Fitted by logistic regression on 13 sets of 3 and 6 views of seven scenes, to points triangulated from features and
    to depth on which many further views agree. On scenes left out of the fit the mean calibration error is 0.07
    and the area under the ROC curve 0.86.
    """

    constant: float = -4.3  # log-odds where all the others are 0
    per_support: float = 4.95  # for neighbours on the same plane, as a part of all
    per_consistent: float = 0.17  # for each view that agrees, up to MAX_CONSISTENT
    per_conflicting: float = -0.67  # for views that look through the point, as a part of all
    per_log_contrast: float = 0.7  # for the logarithm of the standard deviation of the window's grey levels
    per_cosine: float = 0.9  # for the cosine of the angle between line of sight and surface normal


@dataclass(frozen=True)
class ConsistencyConfig:
    """Geometric consistency of depth maps: what other views confirm is kept, what nothing supports is left out."""

    max_error: float = 2.0  # forward-backward reprojection error of agreeing views, pixels
    max_relative_difference: float = 0.01  # largest difference of the depths of agreeing views, relative to the depth
    min_support: float = 0.12  # share of neighbours on the same plane that keeps a pixel which no other view confirms
    min_borrowed_support: float = 0.2  # the same for a neighbour's plane that fills such a pixel
    min_confidence: float = 0.03  # least confidence of a depth; below, it is unknown
    confidence: Confidence = field(default_factory=Confidence)


@dataclass(frozen=True, eq=False)
class DepthMap:
    """The depth map of a view, with normals and confidence."""

    depth: Float32  # (h, w) z in the camera frame, 0 where unknown
    normal: Float32  # (h, w, 3) camera frame, unit length, facing the camera, 0 where unknown
    confidence: Float32  # (h, w) about the probability that the depth is within 1 %, 0 where unknown
    num_consistent: npt.NDArray[np.uint8]  # (h, w) how many other views agree
    unchecked: npt.NDArray[np.float16]  # (h, w) z before the check, 0 where unknown: what further views are checked by


class _OtherView(ctypes.Structure):
    _fields_ = (
        ("planes", ctypes.c_void_p),
        ("width", ctypes.c_int32),
        ("height", ctypes.c_int32),
        ("from_reference", Transfer),
        ("to_reference", Transfer),
    )


@dataclass(frozen=True, eq=False)
class Agreement:
    """The agreement of the other views with each pixel of a view."""

    inverse_depth: Float32  # (h, w) mean over the pixel and the views that agree with it
    num_consistent: npt.NDArray[np.uint8]  # (h, w) views that agree
    num_inside: npt.NDArray[np.uint8]  # (h, w) views whose image the point falls into
    num_conflicting: npt.NDArray[np.uint8]  # (h, w) views that see something behind the point


class _Surface(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("grey", "planes", "num_consistent")),
        *((name, ctypes.c_int32) for name in ("width", "height")),
        *((name, ctypes.c_float) for name in ("sigma_grey", "sigma_space")),
    )


class _Agreement(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_void_p) for name in Agreement.__dataclass_fields__)


def cross_check(
    views: Sequence[PyramidLevel],
    planes: Sequence[Planes],
    partners: Sequence[Sequence[int]],
    matching: Matching,
    config: ConsistencyConfig,
) -> list[DepthMap]:
    """The depth maps of all views, each compared with those of its `partners`."""

    def check_view(view: PyramidLevel, own: Planes, others: Sequence[int]) -> DepthMap:
        agreeing = compute_agreement(view, own, [views[i] for i in others], [planes[i] for i in others], config)
        return make_depth_map(view, own, agreeing, matching, config)

    return map_parallel(check_view, views, planes, partners)


def compute_agreement(
    view: PyramidLevel,
    planes: Planes,
    others: Sequence[PyramidLevel],
    other_planes: Sequence[Planes],
    config: ConsistencyConfig,
) -> Agreement:
    """Computes how `others` agree with the planes of `view`."""
    values = [np.ascontiguousarray(p.values, np.float32) for p in (planes, *other_planes)]
    array = (_OtherView * len(others))(
        *(
            _OtherView(
                pointer(value),
                other.shape[1],
                other.shape[0],
                compute_transfer(view, other),
                compute_transfer(other, view),
            )
            for other, value in zip(others, values[1:], strict=True)
        )
    )
    result = Agreement(np.empty(view.shape, np.float32), *(np.empty(view.shape, np.uint8) for _ in range(3)))
    library().patchmatch_check(
        pointer(values[0]), view.shape[1], view.shape[0], array, len(others),
        (ctypes.c_float * 2)(config.max_error, config.max_relative_difference),
        ctypes.byref(_Agreement(*(pointer(getattr(result, name)) for name in Agreement.__dataclass_fields__))),
    )  # fmt: skip
    return result


def make_depth_map(
    view: PyramidLevel, planes: Planes, agreement: Agreement, matching: Matching, config: ConsistencyConfig
) -> DepthMap:
    """Makes the depth map that other views and neighbours support, with normals and confidence."""
    surface, support, contrast = measure_support(view, planes, agreement, matching, config)
    confirmed = agreement.num_consistent > 0
    inverse_depth = np.where(confirmed, agreement.inverse_depth, surface.inverse_depth)
    normal, cosine = compute_normals(view, surface)
    probability = compute_confidence(support, contrast, cosine, agreement, config.confidence)
    known = (confirmed | (support >= config.min_support)) & (probability >= config.min_confidence) & (inverse_depth > 0)
    depth = np.divide(1.0, inverse_depth, out=np.zeros(view.shape, np.float32), where=known)
    return DepthMap(
        depth,
        normal * known[..., None],
        np.where(known, probability, np.float32(0)),
        np.where(known, agreement.num_consistent, 0).astype(np.uint8),
        _compute_unchecked_depth(planes),
    )


def _compute_unchecked_depth(planes: Planes) -> npt.NDArray[np.float16]:
    inverse_depth = planes.values[..., 0]
    depth = np.divide(1.0, inverse_depth, out=np.zeros(inverse_depth.shape, np.float32), where=inverse_depth > 0)
    return np.where(depth < np.finfo(np.float16).max, depth, 0).astype(np.float16)


def measure_support(
    view: PyramidLevel, planes: Planes, agreement: Agreement, matching: Matching, config: ConsistencyConfig
) -> tuple[Planes, Float32, Float32]:
    """The planes with small holes filled from neighbours, and what tells right ones from wrong ones.

    The latter are (h, w) the share of neighbours that lie on each plane, and (h, w) the standard deviation of the grey
    levels that it was matched by.
    """
    values = np.ascontiguousarray(planes.values, np.float32)
    surface = _Surface(
        pointer(view.grey), pointer(values), pointer(agreement.num_consistent), view.shape[1], view.shape[0],
        matching.sigma_grey, matching.sigma_space,
    )  # fmt: skip
    filled = np.empty_like(values)
    support, contrast = np.empty(view.shape, np.float32), np.empty(view.shape, np.float32)
    library().patchmatch_support(
        ctypes.byref(surface), ctypes.c_float(config.min_support), ctypes.c_float(config.min_borrowed_support),
        pointer(filled), pointer(support), pointer(contrast),
    )  # fmt: skip
    return Planes(filled, planes.costs), support, contrast


def compute_confidence(
    support: Float32, contrast: Float32, cosine: Float32, agreement: Agreement, model: Confidence
) -> Float32:
    """(h, w) about the probability that the depth is within 1 %."""
    log_odds = (
        model.constant
        + model.per_support * support
        + model.per_consistent * np.minimum(agreement.num_consistent, MAX_CONSISTENT)
        + model.per_conflicting * agreement.num_conflicting / np.maximum(agreement.num_inside, 1)
        + model.per_log_contrast * np.log(contrast + MIN_CONTRAST)
        + model.per_cosine * cosine
    )
    return (1 / (1 + np.exp(-log_odds))).astype(np.float32)


def compute_normals(view: PyramidLevel, planes: Planes) -> tuple[Float32, Float32]:
    """(h, w, 3) unit normals in the camera frame, facing the camera; (h, w) cosines of their angles to the rays.

    Points with n . X = d have inverse depth n . ray / d, so n / d follows from the gradient of the inverse depth.
    """
    height, width = view.shape
    w, du, dv = np.moveaxis(planes.values, -1, 0)
    fx, fy, cx, cy = (np.float32(view.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    u = np.arange(width, dtype=np.float32) + np.float32(0.5) - cx
    v = np.arange(height, dtype=np.float32)[:, None] + np.float32(0.5) - cy
    away = np.stack([fx * du, fy * dv, w - du * u - dv * v], -1)
    length = np.maximum(np.sqrt((away * away).sum(-1)), np.float32(1e-20))
    ray_length = np.sqrt(1 + (u / fx) ** 2 + (v / fy) ** 2)
    return -away / length[..., None], w / (length * ray_length)


log = logging.getLogger(__name__)


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
    consistency: ConsistencyConfig = field(default_factory=ConsistencyConfig)


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
    run: RunContext = BACKGROUND,
) -> list[DepthMap]:
    """A depth map for every view, in order. A view that overlaps with no other comes back without any depth.

    The result depends on the arguments only, not on the number of threads. It pauses several times a second,
    which may raise to abandon the work, and OutOfTime to end it: depth is as fine then as it is after NEEDED_STAGES.
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
                _pause_or_go_on(run, may_end=stream >= NEEDED_STAGES)
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
    return cross_check(levels[finest], planes, checked, config.matching, config.consistency)


def _pause_or_go_on(run: RunContext, may_end: bool) -> None:
    """Pauses; work that is needed goes on when time is over."""
    try:
        run.pause()
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
    agreeing = compute_agreement(levels[index], planes, [levels[j] for j in checked], others, config.consistency)
    return make_depth_map(levels[index], planes, agreeing, config.matching, config.consistency)


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
