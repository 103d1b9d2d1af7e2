"""Things that moved between photographs, by their matches: a second motion beside that of the scene.

What stands still agrees on one geometry for each two photographs. What moves by itself, a person or a vehicle, gives
matches that agree with each other and not with it. Of two such motions the one on the smaller patch of both
photographs is the thing's. Walls repeat, too: a point counts as moving where two pairs of photographs say so of it, and
no two say that it stands still: a pattern that repeats stands still where photographs show the same part of the wall.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame
from splatnode.capture.masks import apply_mask
from splatnode.capture.process.system import raise_shortage
from splatnode.recon.keyframes import (
    LIBRARY_ERRORS,
    REFERENCE_SIDE,
    Keyframe,
    longer_side,
    principal_point,
    resize_image,
)
from splatnode.recon.matching import features, pair_matching
from splatnode.recon.matching.view_graph import Matcher, Pair, ViewGraph, match_pending
from splatnode.recon.threads import map_parallel

log = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Index = npt.NDArray[np.int64]

MIN_MATCHES = 40  # of one thing in two photographs: a plane among fewer may be chance
MOST_COMMON = 0.3  # share of a thing's matches that may fit the scene's motion, too
SMALLER = 0.6  # the thing's patch over the scene's, in both photographs: beyond, nobody can tell which one moves
VOTES = 2  # pairs of photographs that find a point on a thing
RESTS = 2  # pairs of photographs in which a point stands still with the scene, so that it is of a wall that repeats
FEW = 0.3  # share of the points that fit a motion, beside which all others make it the scene's
MOST_AT_REST = 0.2  # share of a photograph's moving points: where more stand still, all of them do
MIN_SHOWN = 3  # photographs that a thing must be found in, if there are so many
ROUNDS = 3  # things of different motion that are looked for, one after the other
KNOWN_SHARE = 0.5  # of a patch's points that are known to move, for the others of it to move, too
SAME_LINE_PX = 3.0  # distance from an epipolar line within which a match fits, pixels at REFERENCE_SIDE

_MAP_SIDE = 256  # pixels: the longer side of the small picture in which points become patches
_REACH = 0.05  # between points of one patch, over the longer side
_MARGIN = 0.025  # around a patch: its outline has no points of its own
_MIN_POINTS = 8  # of a patch: fewer are wrong matches
MOST_HIDDEN = 0.6  # share of a photograph: what covers more is the scene


@dataclass(frozen=True, eq=False)
class _Group:
    """Matches of two photographs that agree on a motion other than the scene's, or may."""

    pair: Pair
    matches: Index  # (M, 2) point numbers
    moves: bool  # whether it is the smaller patch beyond doubt


def mask_moving_objects(
    graph: ViewGraph, matcher: Matcher | None, until: float = math.inf, pause: Callable[[], None] = lambda: None
) -> ViewGraph:
    """The complete view graph without what moved between the photographs: matched again where there is such a thing.

    Such a keyframe has a mask over it, and its share in `moving`. `until` as for `match.completed`; `pause` is called
    between parts of the work and may raise.
    """
    pause()
    masks = moving_masks(graph)
    shown = [keyframe for keyframe in graph.keyframes if keyframe.name in masks]
    hidden = [_apply_moving_mask(keyframe, masks[keyframe.name]) for keyframe in shown]
    changed = [after for before, after in zip(shown, hidden, strict=True) if after is not before]
    pause()
    for further in match_pending(graph.replace_keyframes(changed), matcher, until) if changed else ():
        graph = further
        pause()
    return graph


def _apply_moving_mask(keyframe: Keyframe, mask: Mask) -> Keyframe:
    """The keyframe without what the mask (H, W) hides; itself where hardly anything would remain."""
    frame = apply_mask(keyframe.frame, mask)
    if isinstance(frame, DroppedFrame) or frame is keyframe.frame or frame.mask is None:
        return keyframe
    before = 1.0 if keyframe.frame.mask is None else float(keyframe.frame.mask.mean())
    return replace(
        keyframe,
        frame=frame,
        image=resize_image(frame.image, max(keyframe.image.shape[:2])),
        features=features.apply_mask(keyframe.features, frame.mask),
        moving=before - float(frame.mask.mean()),
    )


def moving_masks(graph: ViewGraph) -> dict[str, Mask]:
    """For each keyframe that shows a thing which moved: the mask (H, W) at full size, False on the thing."""
    if not graph.config.dynamic_objects.enabled:
        return {}
    moving = moving_points(graph)
    found = {}
    for keyframe, points in zip(graph.keyframes, moving, strict=True):
        hidden = _patches(keyframe, points)
        if 0 < hidden.sum() <= MOST_HIDDEN * hidden.size:
            found[keyframe.name] = ~hidden
    return found


def moving_points(graph: ViewGraph) -> list[Mask]:
    """(M,) for each keyframe which of its points lie on a thing that moved."""
    moving = [np.zeros(len(keyframe.features.points), bool) for keyframe in graph.keyframes]
    matches = {pair: graph.tilted.get(pair, plain).matches for pair, plain in sorted(graph.plain.items())}
    needed = min(VOTES, len(matches))
    for _ in range(ROUNDS):
        asked = [(graph, pair, found) for pair, found in matches.items()]
        groups = [group for found in map_parallel(lambda one: _find_groups(*one), asked) for group in found]
        votes = [np.zeros(len(points), int) for points in moving]
        for group in groups:
            if group.moves:
                for side, index in enumerate(group.pair):
                    votes[index][group.matches[:, side]] += 1
        new = _not_at_rest(_propagate_moving([own >= needed for own in votes], groups), graph)
        if sum(own.sum() >= _MIN_POINTS for own in new) < min(MIN_SHOWN, len(new)):
            break
        moving = [before | own for before, own in zip(moving, new, strict=True)]
        matches = {
            (i, j): found[~(moving[i][found[:, 0]] | moving[j][found[:, 1]])] for (i, j), found in matches.items()
        }
    return moving


def _find_groups(graph: ViewGraph, pair: Pair, matches: Index) -> list[_Group]:
    """Those of `_groups`; none, which the log tells, where a library fails on this pair."""
    try:
        return list(_groups(graph, pair, matches))
    except LIBRARY_ERRORS as error:
        raise_shortage(error)
        first, second = (graph.keyframes[index].name for index in pair)
        log.warning("%s and %s are not searched for what moves: %s", first, second, error)
        return []


def _groups(graph: ViewGraph, pair: Pair, matches: Index) -> Iterator[_Group]:
    """The plane that most matches agree on, or what else agrees, if one of the two may move beside the other."""
    first, second = (graph.keyframes[index] for index in pair)
    if len(matches) < 2 * MIN_MATCHES:
        return
    points1, points2 = first.features.points[matches[:, 0]], second.features.points[matches[:, 1]]
    config, scale = graph.config.pair_matching.two_view, longer_side(second.frame) / REFERENCE_SIDE
    plane_px = config.homography_px * scale
    plane = _plane(points1, points2, plane_px)
    if plane.sum() < MIN_MATCHES:
        return
    (others,) = np.nonzero(~plane)
    size = second.frame.width, second.frame.height
    own1, own2 = points1 - principal_point(first.frame), points2 - principal_point(second.frame)
    geometry, _ = pair_matching.estimate(own1[others], own2[others], matches[others], size, config)
    if geometry is None:
        yield _Group(pair, matches[plane], moves=False)
        return
    if _share_on_lines(geometry, own1[plane], own2[plane], SAME_LINE_PX * scale) > MOST_COMMON:
        return
    rest = np.isin(matches[:, 0], geometry.matches[:, 0]) & ~plane
    patches = np.array([[_patch(points1[own], first), _patch(points2[own], second)] for own in (plane, rest)])
    if (patches[0] < SMALLER * patches[1]).all():
        yield _Group(pair, matches[plane], moves=True)
    elif (patches[1] < SMALLER * patches[0]).all():
        thing = np.flatnonzero(rest)[_plane(points1[rest], points2[rest], plane_px)]
        if len(thing) >= MIN_MATCHES:
            yield _Group(pair, matches[thing], moves=True)
    else:
        yield _Group(pair, matches[plane], moves=False)


def _plane(points1: Array, points2: Array, threshold: float) -> Mask:
    """(M,) which matches the homography that explains most of them explains; none where they are too few for one."""
    if len(points1) < MIN_MATCHES:
        return np.zeros(len(points1), bool)
    _, inliers = cv2.findHomography(points1, points2, cv2.USAC_MAGSAC, threshold)
    return np.zeros(len(points1), bool) if inliers is None else inliers.ravel() > 0


def _share_on_lines(geometry: pair_matching.TwoView, points1: Array, points2: Array, threshold: float) -> float:
    """The share of matches, pixels (M, 2) from the principal points, within `threshold` of the geometry's lines."""
    fundamental, _ = cv2.findFundamentalMat(geometry.points1, geometry.points2, cv2.FM_LMEDS)
    if fundamental is None or fundamental.shape != (3, 3):
        return 1.0  # nothing is known of what the geometry explains
    ones = np.ones((len(points1), 1))
    first, second = np.hstack([points1, ones]), np.hstack([points2, ones])
    lines2, lines1 = first @ fundamental.T, second @ fundamental
    norms = np.linalg.norm(np.hstack([lines1[:, :2], lines2[:, :2]]), axis=1)
    return float((np.abs((second * lines2).sum(1)) < threshold * norms).mean())


def _patch(points: Array, keyframe: Keyframe) -> float:
    """The share of the photograph in the convex hull of `points` (M, 2)."""
    hull = cv2.convexHull(points.astype(np.float32))
    return cv2.contourArea(hull) / (keyframe.frame.width * keyframe.frame.height)


def _propagate_moving(moving: Sequence[Mask], groups: Sequence[_Group]) -> list[Mask]:
    """Adds the points of every group that one image knows to move, until nothing is added."""
    moving = [own.copy() for own in moving]
    waiting = list(groups)
    while True:
        known = [
            group
            for group in waiting
            if any(moving[i][group.matches[:, side]].mean() >= KNOWN_SHARE for side, i in enumerate(group.pair))
        ]
        if not known:
            return moving
        for group in known:
            for side, index in enumerate(group.pair):
                moving[index][group.matches[:, side]] = True
        waiting = [group for group in waiting if group not in known]


def _not_at_rest(moving: Sequence[Mask], graph: ViewGraph) -> list[Mask]:
    """Without those of photographs in which they fit, in RESTS pairs each, the motion of many more points."""
    rests = [np.zeros(len(own), int) for own in moving]
    for pair, geometry in graph.pairs.items():
        for side, index in enumerate(pair):
            still = np.zeros(len(moving[index]), bool)
            still[geometry.matches[:, side]] = True
            own = still & moving[index]
            if 0 < own.sum() < FEW * still.sum():
                rests[index] += own
    at_rest = [(known[own] >= RESTS).mean() if own.any() else 1.0 for own, known in zip(moving, rests, strict=True)]
    return [own if share < MOST_AT_REST else np.zeros_like(own) for own, share in zip(moving, at_rest, strict=True)]


def _patches(keyframe: Keyframe, moving: Mask) -> Mask:
    """(H, W) at full size: the hull of each cluster of the moving points, and a margin around it."""
    height, width = keyframe.frame.image.shape[:2]
    scale = min(1.0, _MAP_SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    points = keyframe.features.points[moving] * np.array(size) / (width, height)
    columns, rows = np.clip(points.astype(int), 0, np.array(size) - 1).T
    dots = np.zeros(size[::-1], np.uint8)
    dots[rows, columns] = 1
    _, labels = cv2.connectedComponents(cv2.dilate(dots, _disc(_REACH / 2 * max(size))))
    cluster = labels[rows, columns]
    result = np.zeros(size[::-1], np.uint8)
    for label in np.unique(cluster):
        if (own := cluster == label).sum() >= _MIN_POINTS:
            hull = cv2.convexHull(np.column_stack([columns[own], rows[own]]).astype(np.int32))
            cv2.fillConvexPoly(result, hull, (1,))
    result = cv2.dilate(result, _disc(_MARGIN * max(size)))
    return cv2.resize(result, (width, height), interpolation=cv2.INTER_NEAREST) > 0


def _disc(radius: float) -> npt.NDArray[np.uint8]:
    side = 2 * max(1, round(radius)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)
