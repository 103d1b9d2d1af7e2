"""Point maps with the depth that depth images measured, where the images themselves cannot tell it.

Stereo needs something to see: a plain wall has no depth by it. A depth image has noise, and holes at outlines. Several
depth images show the same surfaces: what they and stereo tell of a pixel is weighed by its variance, and by who sees
through it. At outlines depth steps where colours do.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import DepthImage
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.metric.depth_fit import (
    LEAST_WINDOW,
    PIXELS_AS_ONE,
    PLANE_SIGMAS,
    RADII,
    DepthFit,
    DepthView,
    MeasuredDepth,
    compute_nearness,
    fit_depth_images,
    fit_planes,
    has_too_few_points,
    make_depth_views,
    name_depth_images,
    warp_depth,
)
from splatnode.recon.priors import (
    LEAST_CONFIDENCE,
    MOST_PARTNERS,
    Pointmap,
    compute_depth_normals,
    compute_modelled_K,
    find_overlapping,
    project_nearest,
)
from splatnode.recon.registration.registration import RegisteredCamera, Registration
from splatnode.recon.threads import map_parallel

log = logging.getLogger(__name__)

Map = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Index = npt.NDArray[np.int64]

# Depth images without their noise, but with their outlines.

_SHARP_RADII = (24, 16, 8, 4, 2)  # as RADII, where windows need not be around their pixel
_SHARP_SIGMAS = 1.05  # rms distance from a plane, over that of _FLATTEST
_FLATTEST = 15.0  # percentile of windows by their rms distance from a plane: those show the noise alone
_LEAST_NOISE = 0.5  # of the noise that is told, which noise that neighbours share falls below
_LEAST_FULL = 0.7  # share of such a window that has a depth
_REMEMBERED = 12  # depth images without their noise: more than one is compared with at a time
_OWN_SIGMAS = 2.0  # of a pixel from a plane that is taken for it


def smooth_within_outlines(depth: DepthImage) -> tuple[Map, Map]:
    """Smooths as `smooth_depth`, to (H, W) z and its sigma, metres, but what is less than its noise high stays.

    Windows may lie beside their pixel, as at an outline, and are planes where they are about as flat as the flattest
    ones of the image, whose noise may be less than what is told. Where there is none, planes count as there.
    """
    z, sigma = _smooth_within_outlines(depth)
    return z.astype(np.float64), sigma.astype(np.float64)


@lru_cache(maxsize=_REMEMBERED)
def _smooth_within_outlines(depth: DepthImage) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Smooths a depth image once: while a scene grows, each further image is compared with the same ones."""
    z = depth.metres.astype(np.float64)
    nearness, noise, known = compute_nearness(depth, z)
    best, sigma, open_yet = nearness.copy(), noise.copy(), known.copy()
    for radius in _SHARP_RADII:
        _take_planes(nearness, noise, known, open_yet, (best, sigma), radius, None)
    for radius in RADII:
        _take_planes(nearness, noise, known, open_yet, (best, sigma), radius, PLANE_SIGMAS)
    smooth = np.where(best > 0, 1.0 / np.maximum(best, 1e-9), 0.0)
    return smooth.astype(np.float32), (sigma * smooth**2).astype(np.float32)


def _take_planes(
    nearness: Map, noise: Map, known: Mask, open_yet: Mask, into: tuple[Map, Map], radius: int, limit: float | None
) -> None:
    """Writes value and sigma of the plane of a window of each open pixel `into` two maps, and closes the pixel.

    `limit` is the rms distance from it over the noise; None: what the flattest windows of the image have.
    """
    pixels = max(1, round(radius * max(nearness.shape) / 640))
    side = 2 * pixels + 1
    planes = fit_planes(nearness, known, side)
    share = np.where(known, planes.rms / np.maximum(noise, 1e-12), np.inf)
    if limit is None:
        full = np.isfinite(share) & (planes.count >= _LEAST_FULL * side**2)
        flat = float(np.percentile(share[full], _FLATTEST)) if full.any() else PLANE_SIGMAS
        limit = min(PLANE_SIGMAS, _SHARP_SIGMAS * max(flat, _LEAST_NOISE))
    value = np.where((planes.count >= LEAST_WINDOW * side**2) & np.isfinite(planes.rms), planes.value, 0.0)
    found, least = np.zeros(nearness.shape, bool), np.full(nearness.shape, np.inf)
    taken, weight = np.zeros_like(nearness), np.ones_like(nearness)
    steps = (0, -pixels, pixels)
    for down, across in itertools.product(steps, steps):  # around the pixel first
        there, rms, count, slope_x, slope_y = (
            _look_aside(each, down, across)
            for each in (value, planes.rms, planes.count, planes.slope_x, planes.slope_y)
        )
        here = there - down * slope_y - across * slope_x
        good = open_yet & (there > 0) & (here > 0) & (rms < limit * noise)
        good &= (np.abs(nearness - here) < _OWN_SIGMAS * noise) & (rms < least)
        taken[good], least[good] = here[good], (-1.0 if down == across == 0 else rms[good])
        weight[good] = count[good] / (1.0 + 3.0 * ((down != 0) + (across != 0)))  # a plane is less sure at its border
        found |= good
    into[0][found] = taken[found]
    into[1][found] = noise[found] / np.sqrt(np.maximum(weight[found] / PIXELS_AS_ONE, 1.0))
    open_yet &= ~found


def _look_aside(values: Map, down: int, across: int) -> Map:
    """Returns (H, W) the values so many pixels down and across from each pixel; 0 outside."""
    height, width = values.shape
    found = np.zeros_like(values)
    rows, columns = height - abs(down), width - abs(across)
    if rows > 0 and columns > 0:
        to, start = (
            (slice(max(0, -down), max(0, -down) + rows), slice(max(0, -across), max(0, -across) + columns)),
            (
                slice(max(0, down), max(0, down) + rows),
                slice(max(0, across), max(0, across) + columns),
            ),
        )
        found[to] = values[start]
    return found


# What stereo, the depth image of a pixel and those of other images tell.

STEREO_SIGMA = 0.004  # of a depth by stereo whose confidence is 1, as a share of it; of others, over the confidence
MOST_SIGMA = 0.04  # of a measured depth that is taken, as a share of it
_CONFIDENT_SIGMA = 0.005  # at which a measured depth has the confidence 1
_MOST_CONFIDENCE = 0.9
_LEAST_SURE = 0.05  # confidence of stereo below which its sigma grows no more
_APART_SHARE = 0.01  # by which a depth may move and have the normal that it had
_COARSE = 8  # pixels of an image for one of the map by which it is found what shows the same


@dataclass(frozen=True, eq=False)
class MeasuredView:
    """The surface that a depth camera measured for one image, in the scene's unit."""

    surface: Pointmap  # its depth, and the camera
    sigma: Map  # (h, w) standard deviation of it

    @property
    def pixels(self) -> MeasuredDepth:
        return MeasuredDepth(self.surface.depth.astype(np.float64), self.sigma)


def fill_measured_depth(
    pointmaps: Sequence[Pointmap], graph: ViewGraph, registration: Registration
) -> tuple[Pointmap, ...]:
    """Returns the point maps with measured depth weighed in; the same ones where none was measured.

    Depth images that the points of the images contradict, or cannot judge, add nothing, which the log tells: without
    numbers, for those of the result are of all points that matches and cameras agree on in the end. `graph`
    and `registration` are those that the point maps were made of.
    """
    views = make_depth_views(graph, registration)
    if not views:
        return tuple(pointmaps)
    fits = fit_depth_images(views)
    units = {view.name: _find_unit(view.name, fits, registration) for view in views}
    for fit in fits:
        is_used = all(units[name] is not None for name in fit.names)
        log.log(logging.INFO if is_used else logging.WARNING, "%s", _describe_use(fit, is_used))
    used = [view for view in views if units[view.name] is not None]
    if not used:
        return tuple(pointmaps)
    wanted = {pointmap.name for pointmap in pointmaps}
    partners = _find_partners(used, wanted, units, graph, registration)
    needed = [view for view in used if view.name in wanted.union(*partners.values())]
    made = map_parallel(lambda view: _make_measured_view(view, units[view.name] or 1.0, graph, registration), needed)
    measured = {view.name: each for view, each in zip(needed, made, strict=True)}
    images = {keyframe.name: keyframe.image for keyframe in graph.keyframes}

    def fuse(pointmap: Pointmap) -> Pointmap:
        others = [measured[name] for name in partners.get(pointmap.name, ())]
        own = measured.get(pointmap.name)
        if own is None and not others:
            return pointmap
        shown = own.pixels if own is not None else _measure_nothing(pointmap)
        return snap_to_outlines(fuse_depth(pointmap, shown, others), images[pointmap.name])

    return tuple(map_parallel(fuse, pointmaps))


def _find_unit(name: str, fits: Sequence[DepthFit], registration: Registration) -> float | None:
    """Metres of the scene's unit by which a depth image is taken; None where it is not."""
    fit = next((each for each in fits if name in each.names), None)
    if fit is None or fit.is_usable:
        return None if fit is None else fit.metres_per_unit
    given = registration.given  # the cameras stand where depth images placed them, in their unit
    by_depth = given is not None and given.from_depth and has_too_few_points(fit.check)
    return given.scale if given is not None and by_depth else None


def _describe_use(fit: DepthFit, is_used: bool) -> str:
    who = name_depth_images(len(fit.names), fit.camera_id)
    if is_used and not fit.is_usable:
        return f"{who} place the cameras and fill what the images cannot tell"
    if is_used:
        return f"{who} fit the images and fill what these cannot tell"
    return f"{who} fill nothing: {fit.check.code.value}; the result tells why (depth_checks, report.json's depth)"


def _find_partners(
    views: Sequence[DepthView],
    wanted: Set[str],
    units: Mapping[str, float | None],
    graph: ViewGraph,
    registration: Registration,
) -> dict[str, tuple[str, ...]]:
    """Finds for each wanted image the others whose measured depth shares most with it."""
    cameras = {graph.keyframes[camera.index].name: camera for camera in registration.cameras}
    by_name = {view.name: view for view in views}
    names = sorted(wanted | by_name.keys(), key=lambda name: cameras[name].index)
    if len(names) <= MOST_PARTNERS + 1:
        return {name: tuple(each for each in names if each != name and each in by_name) for name in names}
    coarse = []
    for name in names:
        K, (height, width) = _find_image(graph, cameras[name])
        shape = max(1, height // _COARSE), max(1, width // _COARSE)
        K = np.diag([shape[1] / width, shape[0] / height, 1.0]) @ K
        shown = warp_depth(by_name[name], K, shape).z / (units[name] or 1.0) if name in by_name else np.zeros(shape)
        coarse.append(_make_surface(name, shown, cameras[name].T_world_camera, K))
    ranked = find_overlapping(coarse, MOST_PARTNERS)
    return {
        name: tuple(names[i] for i in found if names[i] in by_name)
        for name, found in zip(names, ranked, strict=True)
        if name in wanted
    }


def _find_image(graph: ViewGraph, camera: RegisteredCamera) -> tuple[Map, tuple[int, int]]:
    """Finds K (3, 3) and (h, w) of a camera's image at modelled size."""
    height, width = graph.keyframes[camera.index].image.shape[:2]
    return compute_modelled_K(graph, camera), (height, width)


def _make_surface(name: str, z: Map, T_world_camera: Map, K: Map) -> Pointmap:
    depth = z.astype(np.float32)
    return Pointmap(name, 0, depth, (depth > 0).astype(np.float32), np.zeros((0, 0, 3), np.float32), T_world_camera, K)


def _make_measured_view(view: DepthView, unit: float, graph: ViewGraph, registration: Registration) -> MeasuredView:
    camera = next(each for each in registration.cameras if graph.keyframes[each.index].name == view.name)
    K, shape = _find_image(graph, camera)
    measured = warp_depth(view, K, shape, smooth_within_outlines(view.depth))
    sure = measured.sigma < MOST_SIGMA * measured.z
    z = np.where(sure, measured.z / unit, 0.0)
    return MeasuredView(
        _make_surface(view.name, z, camera.T_world_camera, K), np.where(sure, measured.sigma / unit, 0.0)
    )


def _measure_nothing(pointmap: Pointmap) -> MeasuredDepth:
    return MeasuredDepth(np.zeros(pointmap.depth.shape), np.zeros(pointmap.depth.shape))


# Every pixel has a few candidates: what stereo tells, what its own depth camera measured, and what the depth cameras of
# other images measured there. Stereo is a measurement as well, as sure as its confidence.

_ALIKE_SIGMAS = 2.5  # of candidates that are of one surface
_CANDIDATE_SHARE = 0.01  # of a candidate's own depth: what it may be off by, to be of the same surface
_OWN_VOTE = 1.5  # of the image's own depth image, as log odds
_STEREO_BIAS, _MOST_STEREO, _LEAST_STEREO = 0.5, 3.5, 0.1  # log odds of stereo: those of its confidence, and limits
_LEAST_USED = 0.03  # confidence of stereo from which on it is a candidate
_MOST_AGREEING = 2.0  # votes of other images that agree: they tell that a surface is there, not that it is seen
_THROUGH_SIGMAS = 3.0  # by which another image sees behind a candidate
_HIDDEN_SHARE = 1.04  # of a nearer surface's depth, beyond which a candidate is hidden by it


def fuse_depth(pointmap: Pointmap, measured: MeasuredDepth, others: Sequence[MeasuredView] = ()) -> Pointmap:
    """The point map with the depth for which most speaks: of stereo, its own measured one (the scene's unit), others'.

    What is of one surface is averaged by its variances. Another image that measured the same speaks for a depth, one
    that sees behind it against it, and what is hidden by a nearer surface that another one measured is not seen. Where
    nothing else speaks, what stereo is sure of stays.
    """
    there = (measured.z > 0) & (measured.sigma < MOST_SIGMA * measured.z)
    confidence = np.clip(pointmap.confidence.astype(np.float64), 0.0, 0.98)
    by_stereo = (pointmap.depth > 0) & (confidence >= _LEAST_USED)
    seen = [_project(each, pointmap) for each in others]
    z = np.stack(
        [np.where(by_stereo, pointmap.depth, 0.0), np.where(there, measured.z, 0.0), *(each.z for each in seen)]
    )
    sigma = np.stack(
        [
            STEREO_SIGMA * z[0] / np.maximum(confidence, _LEAST_SURE),
            np.where(there, measured.sigma, 0.0),
            *(each.sigma for each in seen),
        ]
    )
    odds = np.log(np.maximum(confidence, 1e-3) / (1.0 - confidence)) + _STEREO_BIAS
    votes = np.where(by_stereo, np.clip(odds, _LEAST_STEREO, _MOST_STEREO), 0.0)
    candidates = [_support(each, z, sigma, votes, pointmap, others) for each in _list_candidates(z, sigma)]
    nearest = np.min([np.where(each.is_confirmed, each.z, np.inf) for each in candidates], axis=0)
    best = candidates[0]
    score = best.votes - (best.z > _HIDDEN_SHARE * nearest)
    for each in candidates[1:]:
        its_score = each.votes - (each.z > _HIDDEN_SHARE * nearest)
        better = its_score > score
        score = np.where(better, its_score, score)
        best = _Candidate(*(np.where(better, new, old) for new, old in zip(each, best, strict=True)))
    return _replace_depth(pointmap, best.z, best.sigma, np.ones_like(best.z))


class _Candidate(NamedTuple):
    """A depth (h, w) that a pixel may have, 0 where there is none."""

    z: Map
    sigma: Map
    votes: Map  # log odds of what speaks for it
    is_confirmed: Mask  # another image measured it, and none sees behind it


def _list_candidates(z: Map, sigma: Map) -> list[Map]:
    """Lists (h, w) stereo's, the own measured one, and of the others' (beyond two) the one of most, and the nearest."""
    others, noise = z[2:], sigma[2:]
    if not len(others):
        return [z[0], z[1]]
    best, most = np.zeros_like(z[0]), np.zeros_like(z[0])
    for depth, its_noise in zip(others, noise, strict=True):
        alike = (others > 0) & (np.abs(others - depth) < _ALIKE_SIGMAS * np.hypot(noise, its_noise))
        count = np.where(depth > 0, alike.sum(0), 0)
        best, most = np.where(count > most, depth, best), np.maximum(count, most)
    nearest = np.where(others > 0, others, np.inf).min(0)
    return [z[0], z[1], best, np.where(np.isfinite(nearest), nearest, 0.0)]


def _support(
    candidate: Map, z: Map, sigma: Map, stereo_votes: Map, pointmap: Pointmap, others: Sequence[MeasuredView]
) -> _Candidate:
    """Averages all that is of the candidate's surface, and counts what speaks for it."""
    own = _CANDIDATE_SHARE * candidate
    alike = (z > 0) & (candidate > 0) & (np.abs(z - candidate) < _ALIKE_SIGMAS * np.hypot(sigma, own))
    weight = np.where(alike, np.maximum(sigma, 1e-9) ** -2.0, 0.0)
    total = weight.sum(0)
    mean = np.where(total > 0, (weight * z).sum(0) / np.maximum(total, 1e-12), candidate)
    agreeing, through = np.zeros_like(candidate), np.zeros_like(candidate)
    for other in others:
        here, there, noise = _look_up(mean, pointmap, other)
        off, spread = there - here, np.hypot(noise, _CANDIDATE_SHARE * here)
        agreeing += (there > 0) & (np.abs(off) < _ALIKE_SIGMAS * spread)
        through += (there > 0) & (off > _THROUGH_SIGMAS * spread)
    votes = np.where(alike[0], stereo_votes, 0.0) + np.where(z[1] > 0, np.where(alike[1], _OWN_VOTE, -_OWN_VOTE), 0.0)
    votes += np.minimum(agreeing, _MOST_AGREEING) - through
    known = candidate > 0
    return _Candidate(
        np.where(known, mean, 0.0),
        np.where(known & (total > 0), np.maximum(total, 1e-12) ** -0.5, 0.0),
        np.where(known, votes, -np.inf),
        known & (agreeing > 0) & (through == 0),
    )


def _project(view: MeasuredView, pointmap: Pointmap) -> MeasuredDepth:
    """Projects what the view measured into the point map's camera."""
    depth, _ = project_nearest(view.surface, pointmap)
    z, known = np.where(np.isfinite(depth), depth, 0.0).astype(np.float64), view.surface.depth > 0
    share = float(np.median(view.sigma[known] / view.surface.depth[known] ** 2.0)) if known.any() else 0.0
    return MeasuredDepth(z, share * z**2)


def _look_up(depth: Map, pointmap: Pointmap, other: MeasuredView) -> tuple[Map, Map, Map]:
    """Looks up (h, w) z of the points in the other's camera, what it measured there, and its noise; 0: nothing."""
    T = np.linalg.inv(other.surface.T_world_camera) @ pointmap.T_world_camera
    A, t = other.surface.K @ T[:3, :3] @ np.linalg.inv(pointmap.K), other.surface.K @ T[:3, 3]
    height, width = depth.shape
    u, v = np.arange(width) + 0.5, (np.arange(height) + 0.5)[:, None]
    x, y, z = ((A[k, 0] * u + A[k, 1] * v + A[k, 2]) * depth + t[k] for k in range(3))
    ahead = np.maximum(z, 1e-9)
    rows, columns = other.sigma.shape
    inside = (depth > 0) & (z > 0) & (x >= 0) & (y >= 0) & (x < columns * ahead) & (y < rows * ahead)
    column, row = (np.where(inside, each / ahead, 0.0).astype(np.int64) for each in (x, y))
    found = np.where(inside, other.surface.depth[row, column], 0.0)
    return np.where(inside, z, 0.0), found, np.where(inside, other.sigma[row, column], 0.0)


def _replace_depth(pointmap: Pointmap, z: Map, sigma: Map, sureness: Map) -> Pointmap:
    """The point map with depth z, as sure as its sigma tells, times `sureness`; as it is where z is 0 or the same."""
    depth = np.where(z > 0, z, pointmap.depth).astype(np.float32)
    share = np.where(z > 0, sigma / np.maximum(z, 1e-12), np.inf)
    believed = sureness * np.clip(_CONFIDENT_SIGMA / np.maximum(share, 1e-6), 0.0, _MOST_CONFIDENCE)
    kept = np.abs(depth - pointmap.depth) < _APART_SHARE * depth
    confidence = np.where(kept, np.maximum(pointmap.confidence, believed), np.maximum(believed, LEAST_CONFIDENCE))
    changed = (z > 0) & ~kept
    normal = np.where(changed[..., None], compute_depth_normals(depth, pointmap.K), pointmap.normal)
    unchecked = pointmap.unchecked
    if unchecked is not None:
        unchecked = np.where(changed, depth, unchecked).astype(np.float16)
    confidence = np.where(depth > 0, confidence, 0.0).astype(np.float32)
    return replace(pointmap, depth=depth, confidence=confidence, normal=normal.astype(np.float32), unchecked=unchecked)


# Outlines: depth cameras and stereo tell little there, but depth steps where colours do.

_REACH, _BAND = 4, 2  # of a pixel's neighbours, and of outlines, pixels of _OUTLINE_SIDE
_OUTLINE_SIDE = 512.0
_STEP_SHARE = 0.04  # of depth between neighbours, which is an outline
_UNSURE = 0.6  # confidence below which a pixel away from outlines is taken from its neighbours, too
_COLOUR_SIGMA, _PLACE_SIGMA = 15.0, 2.5  # of neighbours' weights: grey levels, pixels of _OUTLINE_SIDE
_ONE_SURFACE = 0.015  # half the width of the depths that are of one surface, as a share
_LEAST_WEIGHT = 1e-5  # of neighbours that tell a depth
_AT_A_TIME = 20_000  # pixels, for the sake of memory


def snap_to_outlines(pointmap: Pointmap, image: npt.NDArray[np.uint8]) -> Pointmap:
    """The point map with depth at outlines, and where it is unsure or unknown, by the neighbours of the same colour.

    Each pixel takes the mean of the depths of which most neighbours are, weighted by colour, distance and confidence
    (a weighted mode). `image` (h, w, 3) is the view's.
    """
    log_z = np.log(np.maximum(pointmap.depth.astype(np.float64), 1e-9))
    known = pointmap.depth > 0
    high, low = (
        method(np.where(known, log_z, far).astype(np.float32), np.ones((3, 3)))
        for method, far in ((cv2.dilate, -99.0), (cv2.erode, 99.0))
    )
    step = max(1, round(max(known.shape) / _OUTLINE_SIDE))
    band = 2 * _BAND * step + 1
    outline = ~known | (high - low > _STEP_SHARE)
    wanted = (cv2.dilate(outline.astype(np.uint8), np.ones((band, band))) > 0) | (pointmap.confidence < _UNSURE)
    rows, columns = np.nonzero(wanted)
    z, sureness = np.zeros(known.shape), np.zeros(known.shape)
    colours, weights = image.astype(np.float32), np.where(known, pointmap.confidence, 0.0).astype(np.float64)
    for start in range(0, len(rows), _AT_A_TIME):
        at = rows[start : start + _AT_A_TIME], columns[start : start + _AT_A_TIME]
        z[at], sureness[at] = _find_modes(at, log_z, weights, colours, step)
    return _replace_depth(pointmap, z, _ONE_SURFACE / 2.0 * z, sureness)


def _find_modes(
    at: tuple[Index, Index], log_z: Map, weights: Map, colours: npt.NDArray[np.float32], step: int
) -> tuple[Map, Map]:
    """Finds (M,) the depth of which most neighbours of each pixel are, and their share; 0 where there is none."""
    height, width = log_z.shape
    reach = np.arange(-_REACH, _REACH + 1)
    down, across = (each.ravel() for each in np.meshgrid(reach, reach, indexing="ij"))
    even = (down + across) % 2 == 0
    down, across = down[even], across[even]
    near = np.exp(-0.5 * (down**2 + across**2) / _PLACE_SIGMA**2)
    row, column = at[0][:, None] + step * down, at[1][:, None] + step * across
    inside = (row >= 0) & (column >= 0) & (row < height) & (column < width)
    row, column = np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
    off = np.abs(colours[row, column] - colours[at][:, None]).max(-1)
    weight = np.where(inside, near * np.exp(-0.5 * (off / _COLOUR_SIGMA) ** 2) * weights[row, column], 0.0)
    # Sorted row by row, and rows one after the other: a search finds all that is of one surface with each
    values = log_z[row, column]
    order = np.argsort(values, 1)
    values, weight = np.take_along_axis(values, order, 1), np.take_along_axis(weight, order, 1)
    apart = 4.0 * float(np.abs(values).max(initial=1.0))
    flat = (values + apart * np.arange(len(values))[:, None]).ravel()
    sums, means = (np.concatenate([[0.0], np.cumsum(each)]) for each in (weight.ravel(), (weight * values).ravel()))
    first, last = np.searchsorted(flat, flat - _ONE_SURFACE), np.searchsorted(flat, flat + _ONE_SURFACE, side="right")
    count = values.shape[1]
    best = (sums[last] - sums[first]).reshape(-1, count).argmax(1) + count * np.arange(len(values))
    total = sums[last[best]] - sums[first[best]]
    found = total > _LEAST_WEIGHT
    z = np.exp((means[last[best]] - means[first[best]])[found] / total[found])
    both = np.zeros((2, len(values)))
    both[0, found], both[1, found] = z, (total / np.maximum(weight.sum(1), 1e-12))[found]
    return both[0], both[1]
