"""Depth completion: pixels that no two views confirm are filled where no view contradicts it, else left empty.

A plain wall or the sky gives stereo nothing to match. Left empty it would be black in every new view. So a pixel that
no other view's point of like colour explains gets the first of these depths that hides no known surface from another
view: stereo's own doubtful depth; the smoothest depth that may jump at the image's edges (the stated prior); a far
background. Where points of another colour fall on it, something nearer stands before them: it gets a depth close to
the camera.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from splatnode.recon.priors import reprojection
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.workers import map_parallel

Float32 = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

BLUR_PX = 5  # side of the blur before colours are compared: a pixel's noise and half a pixel's offset should not count
GAP_PX = 5  # gaps of this size between the points of another view count as covered
NEAREST_PERCENTILE = 2.0  # of a view's known depths: its nearest depth, of which this part may be wrong
DATA_WEIGHT = 10.0  # of a known inverse depth of confidence 1, against smoothness of weight 1 between neighbours
MIN_LINK = 1e-3  # weight of smoothness across the strongest edge: nothing is cut off from all known depths
MAX_EXTRAPOLATION = 2.0  # factor by which a filled depth may lie nearer or farther than all known ones of its view


class DepthCompletionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    min_confidence: float = 0.12  # least confidence of stereo for a known depth; those below are doubtful
    min_usable_confidence: float = 0.1  # doubtful depths below tell less than their surroundings do: they are dropped
    colour_tolerance: float = 0.12  # difference of colour, in [0, 1], up to which a point explains a pixel
    min_object_px: int = 15  # width of a region of other colour from which on it is taken for a foreground object
    foreground_depth: float = 0.4  # depth of an unknown foreground, over the nearest known depth of its view
    background_depth: float = 1.5  # depth of an unknown background, over the farthest known depth of its view
    confidence: float = 0.1  # that filled depths get
    most_partners: int = 16  # other views that a view is compared with, at most: those that share most with it
    reduction: int = 4  # the smooth depth is found at 1 / `reduction` of the resolution
    edge_contrast: float = 0.06  # difference of colour, in [0, 1], by which smoothness weakens to 1 / e
    occlusion_tolerance: float = 0.03  # relative depth by which a filled point may lie before a known surface


def complete(
    pointmaps: Sequence[Pointmap],
    images: Sequence[Image],
    config: DepthCompletionConfig,
    masks: Sequence[Mask | None] = (),
) -> list[Pointmap]:
    """The point maps with unknown pixels filled or, where that would contradict another view, empty.

    What one of `masks` (h, w) hides has no colour that tells: it is filled only where no other view's points fall.
    """
    known = [pointmap.apply_mask(pointmap.confidence >= config.min_confidence) for pointmap in pointmaps]
    blurred = [np.asarray(cv2.GaussianBlur(image, (BLUR_PX, BLUR_PX), 0), np.uint8) for image in images]
    partners = reprojection.find_overlapping(known, config.most_partners)
    smooth = map_parallel(partial(_smooth, config=config), known, images)
    completed = list(known)
    for j in sorted(range(len(known)), key=lambda i: -float(known[i].confidence.mean())):
        others = [(completed[i], blurred[i]) for i in partners[j]]
        covered, explained = _project_others(known[j], blurred[j], others, config.colour_tolerance)
        unknown = known[j].depth <= 0
        # Single pixels of another colour are noise and edges; an object that only this view sees is larger.
        object_size = np.ones((config.min_object_px, config.min_object_px), np.uint8)
        occluder = cv2.morphologyEx((unknown & covered & ~explained).astype(np.uint8), cv2.MORPH_OPEN, object_size) > 0
        if masks and (mask := masks[j]) is not None:
            occluder &= mask
        hole = unknown & (~covered | occluder)
        filling = smooth[j]
        if filling is None or not hole.any():
            continue
        for guess in _propose_fills(pointmaps[j], known[j], filling, covered, occluder, config):
            guess = guess.apply_mask(hole)
            guess = guess.apply_mask(~_hides_known(guess, [known[i] for i in partners[j]], config.occlusion_tolerance))
            filled = guess.depth > 0
            completed[j] = replace(
                completed[j],
                depth=completed[j].depth + guess.depth,
                normal=np.where(filled[..., None], guess.normal, completed[j].normal),
                confidence=completed[j].confidence + np.float32(config.confidence) * filled,
            )
            hole &= ~filled
    return completed


def _propose_fills(
    doubtful: Pointmap, known: Pointmap, smooth: Float32, covered: Mask, occluder: Mask, config: DepthCompletionConfig
) -> Iterator[Pointmap]:
    """The point maps that a hole may be filled from, the best first."""
    near, far = np.percentile(known.depth[known.depth > 0], [NEAREST_PERCENTILE, 100.0])
    yield doubtful
    facing = _facing_camera(known)
    yield replace(facing, depth=smooth).apply_mask(~covered)
    yield replace(facing, depth=np.full_like(smooth, config.background_depth * far)).apply_mask(~covered)
    yield replace(facing, depth=np.full_like(smooth, config.foreground_depth * near)).apply_mask(occluder)


def _smooth(pointmap: Pointmap, image: Image, config: DepthCompletionConfig) -> Float32 | None:
    """`smooth_depth`; None where no depth is known."""
    return smooth_depth(pointmap, image, config) if (pointmap.depth > 0).any() else None


def smooth_depth(pointmap: Pointmap, image: Image, config: DepthCompletionConfig) -> Float32:
    """(h, w) the depth whose inverse is the smoothest through the known ones that may jump at the image's edges.

    Minimises sum_i confidence_i (x_i - inverse_i)^2 + sum_ij link_ij (x_i - x_j)^2 over neighbouring pixels, a sparse
    linear system. At least one depth must be known. `image` is (h, w, 3).
    """
    height, width = pointmap.depth.shape
    size = (max(2, width // config.reduction), max(2, height // config.reduction))
    weight = cv2.resize(pointmap.confidence, size, interpolation=cv2.INTER_AREA)
    inverse = np.where(pointmap.depth > 0, 1.0 / np.maximum(pointmap.depth, 1e-9), 0.0) * pointmap.confidence
    inverse = cv2.resize(inverse.astype(np.float32), size, interpolation=cv2.INTER_AREA) / np.maximum(weight, 1e-6)
    colour = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float64) / 255.0
    index = np.arange(size[0] * size[1]).reshape(size[1], size[0])
    first = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    second = np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])
    flat = colour.reshape(-1, 3)
    link = np.exp(-np.abs(flat[first] - flat[second]).max(1) / config.edge_contrast) + MIN_LINK
    count = index.size
    laplacian = coo_matrix((link, (first, second)), (count, count))
    laplacian = laplacian + laplacian.T
    laplacian = diags(np.asarray(laplacian.sum(1)).ravel()) - laplacian
    data = DATA_WEIGHT * weight.ravel().astype(np.float64)
    solution = np.asarray(spsolve((laplacian + diags(data + 1e-9)).tocsc(), data * inverse.ravel()), np.float64)
    smooth = cv2.resize(solution.reshape(size[1], size[0]), (width, height), interpolation=cv2.INTER_LINEAR)
    known = pointmap.depth[pointmap.depth > 0]
    least, most = 1 / MAX_EXTRAPOLATION / known.max(), MAX_EXTRAPOLATION / known.min()
    return (1.0 / np.clip(smooth, least, most)).astype(np.float32)


def _project_others(
    target: Pointmap, image: Image, others: Sequence[tuple[Pointmap, Image]], colour_tolerance: float
) -> tuple[Mask, Mask]:
    """(h, w) pixels of the target on which other views' points fall; (h, w) those of which one has the pixel's colour.

    Small gaps between the points are closed.
    """
    covered, explained = (np.zeros(target.depth.shape, bool) for _ in range(2))
    for other, other_image in others:
        covered_here, explained_here = reprojection.find_explained(other, other_image, target, image, colour_tolerance)
        covered |= covered_here
        explained |= explained_here
    return _close_gaps(covered), _close_gaps(explained)


def _close_gaps(mask: Mask) -> Mask:
    """The mask (h, w) without gaps of up to GAP_PX."""
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((GAP_PX, GAP_PX), np.uint8)) > 0


def _hides_known(filled: Pointmap, others: Sequence[Pointmap], occlusion_tolerance: float) -> Mask:
    """(h, w) filled pixels whose point lies clearly before a known surface of another view."""
    wrong = np.zeros(filled.depth.shape, bool)
    for other in others:
        wrong |= reprojection.find_hiding(filled, other, occlusion_tolerance)
    return wrong


def _facing_camera(pointmap: Pointmap) -> Pointmap:
    """The point map with normals along the rays towards the camera."""
    height, width = pointmap.depth.shape
    K = pointmap.K
    u = ((np.arange(width) + 0.5 - K[0, 2]) / K[0, 0]).astype(np.float32)
    v = ((np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]).astype(np.float32)[:, None]
    inverse_length = -1 / np.sqrt(u * u + v * v + 1)
    return replace(pointmap, normal=np.stack([u * inverse_length, v * inverse_length, inverse_length], -1))
