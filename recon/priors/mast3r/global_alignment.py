"""Brings the point maps of many pairs into one frame: cameras, focal lengths and one depth map for each view.

Each ordered pair (i, j) gives the points of both images in camera i's frame, at a scale of its own, and some pairs are
wrong. For each view the pairs that it is first in are joined into one depth map; what a pair says about its second
image, held against that image's own depth map, is a similarity between the two views; the similarities that most
others agree with start a robust fit of all views together. This is the global alignment of DUSt3R (Wang et al. 2024,
section 3.4) with one similarity a view instead of one free depth a pixel: few unknowns, so seconds become fractions.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.recon.geometry import Similarity

Array = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]

_SAMPLES = 400  # points of a pair that take part: similarities have seven unknowns
_NUM_TREES = 60  # random spanning trees that are tried as a start
_TREE_SPREAD = 0.7  # standard deviation of the logarithm of the factors that shuffle the pairs between trees
_AGREEMENT = 0.1  # of the depth: a pair and a start agree where the pair's median point is that near
_ROBUST = 0.02  # of the depth: scale of the robust weights
_MIN_DEPTH = 1e-6  # of a point before its camera, in the pair's unit
_MIN_WEIGHT = 1e-3  # of a point of the least confidence, whose logarithm is 0
_FOCAL_ITERATIONS, _MIN_OFFSET_PX = 10, 1e-3  # of Weiszfeld's algorithm; pixels: nearer points weigh no more
_FIT_ITERATIONS = 8  # of a similarity's reweighting
_CONVERGED = 1e-7  # largest step of the joint fit, radians and world units, at which it ends
_MAX_LOG_SCALE_STEP = 0.5  # of one step of the joint fit


@dataclass(frozen=True, eq=False)
class PairPoints:
    """The network's points of an ordered pair, in the frame and at the scale of its own first camera."""

    first: Map  # (H, W, 3) points of the first image
    first_confidence: Map  # (H, W), from 1
    second: Map  # (H', W', 3) points of the second image
    second_confidence: Map


@dataclass(frozen=True, eq=False)
class AlignedView:
    """A view after global alignment."""

    T_world_camera: Array  # (4, 4)
    focal: float  # pixels; the principal point is the image's centre
    depth: Map  # (H, W) z in the camera frame, in units of the world
    confidence: Map  # (H, W), mean over the pairs, from 1
    residual: float  # median distance between what the pairs say and the world, relative to the depth


@dataclass(frozen=True, eq=False)
class _Edge:
    """Samples of the second view as the pair sees them (in the first's frame and unit), and in their own frame."""

    first: int
    second: int
    seen: Array  # (S, 3)
    own: Array  # (S, 3)
    weights: Array  # (S,)


def align_views(pairs: Mapping[tuple[int, int], PairPoints], *, shared_focal: bool = True) -> list[AlignedView]:
    """All views 0 .. N-1 that occur in `pairs`, in the frame of view 0, whose median depth becomes 1.

    Raises ValueError where the pairs do not connect all views, or a view is never first.
    """
    count = 1 + max(itertools.chain.from_iterable(pairs), default=-1)
    for view in range(count):
        if not any(i == view for i, _ in pairs):
            raise ValueError(f"view {view} must be the first of at least one pair: its own points come from there")
    focals = [_focal([pairs[i, j] for i, j in pairs if i == view]) for view in range(count)]
    if shared_focal:
        focals = [float(np.median(focals))] * count
    depths, confidences, units = [], [], {}
    for view in range(count):
        named = {pair: points for pair, points in pairs.items() if pair[0] == view}
        depth, confidence, scales = _merge_own_depth(list(named.values()))
        depths.append(depth)
        confidences.append(confidence)
        units |= dict(zip(named, scales, strict=True))
    edges = [_edge(pair, pairs[pair], units[pair], depths[pair[1]], focals[pair[1]]) for pair in pairs]
    similarities = _refine_similarities(_initialize_similarities(edges, count), edges)
    return _convert_to_first_frame(similarities, edges, focals, depths, confidences)


def _focal(pairs: Sequence[PairPoints]) -> float:
    """The focal length in pixels that best projects a view's own points onto their pixels: a geometric median."""
    ratios, offsets, weights = [], [], []
    for pair in pairs:
        height, width, _ = pair.first.shape
        u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
        good = pair.first[..., 2] > _MIN_DEPTH
        ratios.append(pair.first[good][:, :2] / pair.first[good][:, 2:])
        offsets.append(np.stack([u[good], v[good]], -1))
        weights.append(np.log(pair.first_confidence[good]) + _MIN_WEIGHT)
    ray, pixel, weight = (np.concatenate(parts).astype(np.float64) for parts in (ratios, offsets, weights))
    if not len(ray):
        raise ValueError("a view has no point in front of its camera: its prediction cannot be used")
    focal = float((weight * (ray * pixel).sum(1)).sum() / max((weight * (ray * ray).sum(1)).sum(), 1e-12))
    for _ in range(_FOCAL_ITERATIONS):
        robust = weight / np.maximum(np.linalg.norm(pixel - focal * ray, axis=1), _MIN_OFFSET_PX)
        focal = float((robust * (ray * pixel).sum(1)).sum() / max((robust * (ray * ray).sum(1)).sum(), 1e-12))
    return focal


def _merge_own_depth(pairs: Sequence[PairPoints]) -> tuple[Map, Map, list[float]]:
    """A view's depth map from all pairs that it is first in, its confidence, and each pair's unit in that map's."""
    depths = np.stack([pair.first[..., 2] for pair in pairs])
    confidence = np.stack([pair.first_confidence for pair in pairs])
    best = int(confidence.mean((1, 2)).argmax())
    units = [_unit(depth, depths[best], confidence.mean(0)) for depth in depths]
    scaled = depths / np.array(units, np.float32)[:, None, None]
    return np.median(scaled, axis=0).astype(np.float32), confidence.mean(0).astype(np.float32), units


def _unit(depth: Map, reference: Map, confidence: Map) -> float:
    """Median ratio of two depth maps over the surer half of the pixels in front of both cameras."""
    both = (depth > _MIN_DEPTH) & (reference > _MIN_DEPTH)
    sure = both & (confidence >= np.median(confidence))
    chosen = sure if sure.any() else both
    return float(np.median(depth[chosen] / reference[chosen])) if chosen.any() else 1.0


def _edge(pair: tuple[int, int], points: PairPoints, unit: float, depth: Map, focal: float) -> _Edge:
    """Samples of the surer half of the second image's points, and of its own `depth` map at the same pixels."""
    height, width = depth.shape
    surest = np.argsort(-points.second_confidence, axis=None, kind="stable")[: height * width // 2]
    surest = surest[depth.ravel()[surest] > _MIN_DEPTH]
    chosen = surest[:: max(1, len(surest) // _SAMPLES)]
    row, column = np.divmod(chosen, width)
    z = depth.ravel()[chosen].astype(np.float64)
    own = np.stack([(column + 0.5 - width / 2) * z / focal, (row + 0.5 - height / 2) * z / focal, z], -1)
    seen = points.second.reshape(-1, 3)[chosen].astype(np.float64) / unit
    return _Edge(*pair, seen, own, np.log(points.second_confidence.ravel()[chosen]).astype(np.float64) + _MIN_WEIGHT)


_IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


def _procrustes(source: Array, target: Array, weights: Array) -> Similarity:
    """The similarity that carries `source` (S, 3) onto `target`: weighted, and robust by reweighting."""
    fit, robust = _IDENTITY, weights
    for _ in range(_FIT_ITERATIONS):
        share = robust / robust.sum()
        mean_source, mean_target = share @ source, share @ target
        centred_source, centred_target = source - mean_source, target - mean_target
        u, singular, vt = np.linalg.svd((share[:, None] * centred_target).T @ centred_source)
        signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        rotation = u @ np.diag(signs) @ vt
        spread = float(share @ (centred_source**2).sum(1))
        scale = float((singular * signs).sum()) / max(spread, 1e-12)
        fit = Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)
        relative = np.linalg.norm(fit(source) - target, axis=1) / np.maximum(np.linalg.norm(target, axis=1), 1e-9)
        robust = weights / (1.0 + (relative / _ROBUST) ** 2)
    return fit


def _initialize_similarities(edges: Sequence[_Edge], count: int) -> list[Similarity]:
    """View-to-world similarities by the spanning tree of pairs that most other pairs agree with."""
    relative = [_procrustes(edge.own, edge.seen, edge.weights) for edge in edges]  # second's frame to first's
    errors = np.array([_error(edge, _IDENTITY, fit) for edge, fit in zip(edges, relative, strict=True)])
    rng = np.random.default_rng(0)
    best: tuple[float, list[Similarity]] | None = None
    for _ in range(_NUM_TREES):
        order = np.argsort(errors * rng.lognormal(0.0, _TREE_SPREAD, len(edges)), kind="stable")
        placed = _place_along_tree(order.tolist(), edges, relative, count)
        agreeing = sum(_error(edge, placed[edge.first], placed[edge.second]) < _AGREEMENT for edge in edges)
        spread = sum(min(_error(edge, placed[edge.first], placed[edge.second]), _AGREEMENT) for edge in edges)
        score = agreeing - spread / _AGREEMENT
        if best is None or score > best[0]:
            best = score, placed
    assert best is not None
    return best[1]


def _place_along_tree(
    order: Sequence[int], edges: Sequence[_Edge], relative: Sequence[Similarity], count: int
) -> list[Similarity]:
    """Every view placed from view 0 along the first edges in `order` that reach a new view."""
    placed: dict[int, Similarity] = {0: _IDENTITY}
    while len(placed) < count:
        for index in order:
            first, second = edges[index].first, edges[index].second
            if first in placed and second not in placed:
                placed[second] = placed[first].after(relative[index])
                break
            if second in placed and first not in placed:
                placed[first] = placed[second].after(relative[index].inverse())
                break
        else:
            raise ValueError(f"the pairs must connect all {count} views; views {sorted(placed)} stand alone")
    return [placed[view] for view in range(count)]


def _error(edge: _Edge, first: Similarity, second: Similarity) -> float:
    """Median distance of the pair's points from the second view's own, relative to their depth."""
    gap = np.linalg.norm(first(edge.seen) - second(edge.own), axis=1)
    return float(np.median(gap / np.maximum(second.scale * np.linalg.norm(edge.own, axis=1), 1e-12)))


def _refine_similarities(
    similarities: list[Similarity], edges: Sequence[_Edge], iterations: int = 15
) -> list[Similarity]:
    """All views together, by Gauss-Newton on the reweighted gaps of all pairs; view 0 stays.

    Geman-McClure weights: a wrong pair has hundreds of gaps far out, and Cauchy's would add up their pull to most of
    the error.
    """
    count = len(similarities)
    for _ in range(iterations):
        normal, gradient = np.zeros((7 * count, 7 * count)), np.zeros(7 * count)
        for edge in edges:
            first, second = similarities[edge.first], similarities[edge.second]
            there, here = first(edge.seen), second(edge.own)
            length = np.maximum(second.scale * np.linalg.norm(edge.own, axis=1), 1e-12)
            gap = (there - here) / length[:, None]
            weights = edge.weights / (1.0 + (gap**2).sum(1) / _ROBUST**2) ** 2 / edge.weights.sum()
            jacobian = (
                np.concatenate([_compute_jacobian(there, first), -_compute_jacobian(here, second)], axis=2)
                / length[:, None, None]
            )
            index = np.concatenate([7 * edge.first + np.arange(7), 7 * edge.second + np.arange(7)])
            weighted = weights[:, None, None] * jacobian
            normal[np.ix_(index, index)] += np.einsum("sri,srj->ij", weighted, jacobian)
            gradient[index] += np.einsum("sri,sr->i", weighted, gap)
        free = np.arange(7, 7 * count)
        damped = normal[np.ix_(free, free)] + 1e-9 * np.diag(np.diag(normal)[free]) + 1e-12 * np.eye(len(free))
        step = -np.linalg.solve(damped, gradient[free]).reshape(-1, 7)
        similarities = [similarities[0], *(_apply_step(s, d) for s, d in zip(similarities[1:], step, strict=True))]
        if np.abs(step).max() < _CONVERGED:
            break
    return similarities


def _compute_jacobian(points: Array, similarity: Similarity) -> Array:
    """(S, 3, 7) change of world points (S, 3) with rotation about, translation and log scale from their camera."""
    arm = points - similarity.translation
    change = np.zeros((len(points), 3, 7))
    change[:, 0, 1], change[:, 0, 2] = arm[:, 2], -arm[:, 1]
    change[:, 1, 0], change[:, 1, 2] = -arm[:, 2], arm[:, 0]
    change[:, 2, 0], change[:, 2, 1] = arm[:, 1], -arm[:, 0]
    change[:, :, 3:6] = np.eye(3)
    change[:, :, 6] = arm
    return change


def _apply_step(similarity: Similarity, step: npt.NDArray[np.floating]) -> Similarity:
    """The similarity after a `step` (7,) of the joint fit, in the order of `_compute_jacobian`."""
    rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ similarity.rotation
    growth = float(np.exp(np.clip(step[6], -_MAX_LOG_SCALE_STEP, _MAX_LOG_SCALE_STEP)))
    return Similarity(similarity.scale * growth, rotation, similarity.translation + step[3:6])


def _convert_to_first_frame(
    similarities: Sequence[Similarity],
    edges: Sequence[_Edge],
    focals: Sequence[float],
    depths: Sequence[Map],
    confidences: Sequence[Map],
) -> list[AlignedView]:
    """The views in the frame of view 0, whose median depth becomes 1."""
    ahead = depths[0][depths[0] > _MIN_DEPTH]
    unit = float(np.median(ahead)) if len(ahead) else 1.0
    views = []
    for view, similarity in enumerate(similarities):
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = similarity.rotation
        T_world_camera[:3, 3] = similarity.translation / unit
        gaps = [_error(e, similarities[e.first], similarities[e.second]) for e in edges if view in (e.first, e.second)]
        depth = np.maximum(depths[view] * np.float32(similarity.scale / unit), 0)
        views.append(AlignedView(T_world_camera, focals[view], depth, confidences[view], float(np.median(gaps))))
    return views
