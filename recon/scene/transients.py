"""What verified views deny: patches of a photograph behind which others see the scene, so that they moved away.

Where the surfaces of two other views, each confirmed by a further one, meet in a pixel of a photograph, and agree in
colour, the photograph should show that colour. If it does not, something stood before them. Something near that only
this photograph shows would do the same, and stays: a patch counts only where the others see through all of the line of
sight to it, from close to the camera on. What joins such a patch and is contradicted, too, goes with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon import priors
from splatnode.recon.keyframes import resize_mask
from splatnode.recon.priors import AGREEING, LEAST_CONFIDENCE, Pointmap, find_consistent_pixels
from splatnode.recon.threads import map_parallel

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

REDUCTION = 2  # photographs are compared at half their size
MOST_PARTNERS = 6  # other views that each is compared with: those that share most with it
ALIKE = 0.08  # difference of colour, in [0, 1], within which two views agree on a surface
DIFFERENT = 0.06  # from all that lies within a pixel of it, beyond which a photograph shows something else
NEAREST = 0.1  # of the surface's depth: from here on the line of sight must be seen through
FARTHEST = 1e6  # median depths: beyond, a depth is none
LINE_SAMPLES = 10
SEEN_THROUGH = 1.03  # depth of what a view sees behind a point, over the point's
WINDOW_PX = 11  # of the reduced photographs, in which pixels are counted
LEAST_SHARE = 0.15  # of a window that is contradicted
LEAST_RATIO = 0.5  # of what is contradicted and what is confirmed there
OPENING_PX = 5  # width of the narrowest patch
LEAST_PATCH = 0.005  # share of the photograph that is seen through, in one patch
LEAST_THROUGH = 0.1  # share of the patch that is seen through
MARGIN_PX = 3  # around it, of the reduced photograph


class TransientMaskConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Transient objects by free-space violation: patches behind which others see the scene, so that they moved away."""

    # Leave out what verified views see through: something that passed through one image. It also takes some shiny
    # surfaces, and some that stereo does not know
    enabled: bool = False


@dataclass(frozen=True, eq=False)
class _ReducedView:
    """A photograph and what is known of its depth, reduced."""

    known: Pointmap
    sure: Pointmap  # what another view confirms
    colour: Float32  # (h, w, 3) in [0, 1]
    used: Mask  # (h, w)


@dataclass(frozen=True, eq=False)
class _ViewEvidence:
    """The evidence of the other views on an image."""

    surface: Float32  # (h, w) depth on which two others agree; infinite where none do
    contradicted: Mask  # (h, w) where it shows another colour than that surface, and than all others' points
    confirmed: Mask  # (h, w) where one of the others' points has its colour


def find_transient_masks(
    pointmaps: Sequence[Pointmap], pictures: Sequence[Image], used: Sequence[Mask]
) -> list[Mask | None]:
    """For each photograph (h, w), True where it shows something that the others see through; None: nowhere.

    `pictures` (h, w, 3), in one light, are those of the point maps. `used` (h, w) are the pixels that show the scene:
    of the others, nothing is asked. It takes about .1 s a photograph.
    """
    if len(pointmaps) < 3:
        return [None] * len(pointmaps)
    reduced = [_downscale_pointmap(*view) for view in zip(pointmaps, pictures, strict=True)]
    sure = find_consistent_pixels(reduced)
    views = [
        _ReducedView(
            known, known.apply_mask(mask), _downscale_colours(picture, known), resize_mask(own, *known.depth.shape)
        )
        for known, mask, picture, own in zip(reduced, sure, pictures, used, strict=True)
    ]
    partners = priors.find_overlapping(reduced, MOST_PARTNERS)

    def find_mask(index: int) -> Mask | None:
        others = [views[other] for other in partners[index]]
        found = _find_moved_patches(views[index], _collect_evidence(views[index], others), others)
        if not found.any():
            return None
        height, width = pointmaps[index].depth.shape
        return cv2.resize(found.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0

    return map_parallel(find_mask, range(len(views)))


def _downscale_pointmap(pointmap: Pointmap, picture: Image) -> Pointmap:
    height, width = picture.shape[:2]
    size = max(1, width // REDUCTION), max(1, height // REDUCTION)
    usable = (pointmap.confidence >= LEAST_CONFIDENCE) & (pointmap.depth < FARTHEST)
    known = np.where(usable, pointmap.depth, np.float32(0))
    depth = np.asarray(cv2.resize(known, size, interpolation=cv2.INTER_NEAREST), np.float32)
    K = np.diag([size[0] / width, size[1] / height, 1.0]) @ pointmap.K
    ones, none = (depth > 0).astype(np.float32), np.zeros((*depth.shape, 3), np.float32)
    return replace(pointmap, depth=depth, confidence=ones, normal=none, K=K, unchecked=None)


def _downscale_colours(picture: Image, reduced: Pointmap) -> Float32:
    small = cv2.resize(picture, reduced.depth.shape[::-1], interpolation=cv2.INTER_AREA)
    return (np.asarray(cv2.GaussianBlur(small, (3, 3), 0), np.float32) / np.float32(255)).astype(np.float32)


def _collect_evidence(view: _ReducedView, others: Sequence[_ReducedView]) -> _ViewEvidence:
    shown = [_project_surface(other, view.known) for other in others]
    surface = np.full(view.known.depth.shape, np.inf, np.float32)
    least = np.full(view.known.depth.shape, np.inf, np.float32)
    for depth, colour in shown:
        least = np.minimum(least, np.where(np.isfinite(depth), _difference(view.colour, colour), np.float32(np.inf)))
    for number, (depth1, colour1) in enumerate(shown):
        for depth2, colour2 in shown[:number]:
            nearer, farther = np.minimum(depth1, depth2), np.maximum(depth1, depth2)
            agree = np.isfinite(farther) & ((1 - AGREEING) * farther < nearer)
            agree &= np.abs(colour1 - colour2).max(2) < ALIKE
            surface = np.where(agree, np.minimum(surface, nearer), surface)
    # What it knows itself, and another view confirms, in front of that surface stands there.
    before = (view.sure.depth > 0) & (view.sure.depth < (1 - AGREEING) * surface)
    contradicted = view.used & np.isfinite(surface) & (least > DIFFERENT) & ~before
    return _ViewEvidence(surface, contradicted, least <= DIFFERENT)


def _project_surface(other: _ReducedView, target: Pointmap) -> tuple[Float32, Float32]:
    """(h, w) depth in the target of what the other is sure of, infinite where that is nothing; (h, w, 3) its colour."""
    depth, _ = priors.project_nearest(other.sure, target)
    depth = np.where(np.isinf(depth), cv2.erode(depth, np.ones((3, 3), np.uint8)), depth)  # gaps of a pixel
    there = depth < FARTHEST
    depth = np.where(there, depth, np.float32(np.inf))
    rows, columns = np.indices(depth.shape, np.float32) + np.float32(0.5)
    x, y, _ = _project_pixels(other.known, target, columns, rows, np.where(there, depth, np.float32(1)))
    border = cv2.BORDER_REPLICATE
    colour = cv2.remap(other.colour, x - np.float32(0.5), y - np.float32(0.5), cv2.INTER_LINEAR, borderMode=border)
    return depth, np.asarray(colour, np.float32)


def _project_pixels(
    other: Pointmap, target: Pointmap, columns: Float32, rows: Float32, depth: Float32
) -> tuple[Float32, Float32, Float32]:
    """The pixels and the depth in `other` of the target's pixels at `depth`; far outside where it is behind it."""
    T = np.linalg.inv(other.T_world_camera) @ target.T_world_camera
    A = (other.K @ T[:3, :3] @ np.linalg.inv(target.K)).astype(np.float32)
    t = (other.K @ T[:3, 3]).astype(np.float32)
    x, y, z = ((row[0] * columns + row[1] * rows + row[2]) * depth + shift for row, shift in zip(A, t, strict=True))
    front = z > 1e-6
    z = np.where(front, z, np.float32(1))
    return np.where(front, x / z, np.float32(-9)), np.where(front, y / z, np.float32(-9)), np.where(front, z, 0)


def _difference(one: Float32, other: Float32) -> Float32:
    """(h, w) by how much two pictures (h, w, 3) differ where half a pixel's offset explains nothing of it."""
    square = np.ones((3, 3), np.uint8)

    def outside(picture: Float32, around: Float32) -> Float32:
        low, high = cv2.erode(around, square), cv2.dilate(around, square)
        return np.maximum(np.maximum(low - picture, picture - high), 0).max(2)

    return np.minimum(outside(one, other), outside(other, one))


def _find_moved_patches(view: _ReducedView, case: _ViewEvidence, others: Sequence[_ReducedView]) -> Mask:
    """(h, w) patches that are contradicted, and of which enough is seen through."""
    weak = _patches(case.contradicted, case.confirmed)
    if not weak.any():
        return weak
    through = _find_free_space_violations(view.known, np.where(case.contradicted, case.surface, np.float32(0)), others)
    strong = _patches(through, case.confirmed)
    count, labels = cv2.connectedComponents((weak | strong).astype(np.uint8))
    area = np.bincount(labels[strong], minlength=count)
    whole = np.bincount(labels.ravel(), minlength=count)
    kept = np.flatnonzero((area >= LEAST_PATCH * labels.size) & (area >= LEAST_THROUGH * whole))
    moved = np.isin(labels, kept[kept > 0])
    side = 2 * MARGIN_PX + 1
    return cv2.dilate(moved.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def _patches(against: Mask, in_favour: Mask) -> Mask:
    """(h, w) where more pixels of a window are against than in favour, in patches that are wide enough."""
    window = (WINDOW_PX, WINDOW_PX)
    one, other = (cv2.boxFilter(mask.astype(np.float32), -1, window) for mask in (against, in_favour))
    found = (one > LEAST_SHARE) & (one > LEAST_RATIO * (one + other))
    return cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, np.ones((OPENING_PX, OPENING_PX), np.uint8)) > 0


def _find_free_space_violations(target: Pointmap, surface: Float32, others: Sequence[_ReducedView]) -> Mask:
    """(h, w) pixels with a `surface`, above 0, before which other views see through every point of the sight line."""
    rows, columns = np.nonzero(surface)
    across, down = (places.astype(np.float32) + np.float32(0.5) for places in (columns, rows))
    far, open_ = surface[rows, columns], np.ones(len(rows), bool)
    for share in np.geomspace(1 - 2 * AGREEING, NEAREST, LINE_SAMPLES):
        through = np.zeros(len(rows), bool)
        for other in others:
            x, y, z = _project_pixels(other.known, target, across, down, far * np.float32(share))
            height, width = other.known.depth.shape
            inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
            behind = other.known.depth[y[inside].astype(int), x[inside].astype(int)]
            through[inside] |= behind > SEEN_THROUGH * z[inside]
        open_ &= through
    result = np.zeros(surface.shape, bool)
    result[rows, columns] = open_
    return result
