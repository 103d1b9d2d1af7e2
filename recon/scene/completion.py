"""What no two views confirm: filled from its surroundings where nothing speaks against it, else left empty.

A plain wall or the sky gives stereo nothing to match. Left empty it would be black in every new view. So a pixel on
which no other view's point of like colour falls gets the first of these depths that does not hide a known surface from
any other view: stereo's own doubtful one; the smoothest that agrees with the image's edges (the stated prior); a far
background. Where points of other colour fall, something nearer stands before them: it is put close to the camera.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from splatnode.recon.priors import reprojection
from splatnode.recon.priors.pointmap import Pointmap

Float32 = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    min_confidence: float = 0.12  # depths below are doubtful
    least_confidence: float = 0.1  # and those below this tell less than their surroundings do
    like: float = 0.12  # difference of colour, in [0, 1], up to which a point explains a pixel
    object_px: int = 15  # least width of a region of other colour that is taken for a foreground object
    foreground: float = 0.4  # depth of an unknown foreground in units of the nearest known depth of its view
    background: float = 1.5  # depth of the background in units of the farthest known depth of a view
    confidence: float = 0.1  # of what is filled in
    reduction: int = 4  # the smooth depth is found at this part of the resolution
    edge: float = 0.06  # difference of colour, in [0, 1], that counts as an edge between surfaces
    in_front: float = 0.03  # relative depth by which a filled point may lie before a known one


def complete(pointmaps: Sequence[Pointmap], images: Sequence[Image], config: Config) -> list[Pointmap]:
    """The point maps with their unknown pixels filled or, where that would contradict another view, empty."""
    known = [only(pointmap, pointmap.confidence >= config.min_confidence) for pointmap in pointmaps]
    # Blurred, so that a pixel's noise and a point's being half a pixel beside it make no difference.
    calm = [np.asarray(cv2.GaussianBlur(image, (5, 5), 0), np.uint8) for image in images]
    completed = list(known)
    for j in sorted(range(len(known)), key=lambda i: -float(known[i].confidence.mean())):
        rest = [i for i in range(len(known)) if i != j]
        falls, explained = _seen_by_others(known[j], calm[j], [(completed[i], calm[i]) for i in rest], config.like)
        unknown = known[j].depth <= 0
        # Single pixels of another colour are noise and edges; an object that only this view sees is larger.
        object_size = np.ones((config.object_px, config.object_px), np.uint8)
        occluded = cv2.morphologyEx((unknown & falls & ~explained).astype(np.uint8), cv2.MORPH_OPEN, object_size) > 0
        hole = unknown & (~falls | occluded)
        if not hole.any() or not (known[j].depth > 0).any():
            continue
        for guess in _guesses(pointmaps[j], known[j], images[j], falls, occluded, config):
            guess = only(guess, hole)
            guess = only(guess, ~_hides_known(guess, [known[i] for i in rest], config.in_front))
            completed[j] = replace(
                completed[j],
                depth=completed[j].depth + guess.depth,
                normal=completed[j].normal + guess.normal,
                confidence=completed[j].confidence + np.float32(config.confidence) * (guess.depth > 0),
            )
            hole &= guess.depth <= 0
    return completed


def _guesses(
    doubtful: Pointmap, known: Pointmap, image: Image, falls: Mask, occluded: Mask, config: Config
) -> Iterator[Pointmap]:
    """What a hole may be filled with, the best first."""
    near, far = np.percentile(known.depth[known.depth > 0], [2.0, 100.0])
    yield doubtful
    yield only(_facing(known, smooth_depth(known, image, config)), ~falls)
    yield only(_facing(known, config.background * far), ~falls)
    yield only(_facing(known, config.foreground * near), occluded)


def smooth_depth(pointmap: Pointmap, image: Image, config: Config) -> Float32:
    """(h, w) the smoothest inverse depth through the known ones that may jump at the image's edges, as a depth."""
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
    link = np.exp(-np.abs(flat[first] - flat[second]).max(1) / config.edge) + 1e-3
    count = index.size
    laplacian = coo_matrix((link, (first, second)), (count, count))
    laplacian = laplacian + laplacian.T
    laplacian = diags(np.asarray(laplacian.sum(1)).ravel()) - laplacian
    data = 10.0 * weight.ravel().astype(np.float64)
    solution = np.asarray(spsolve((laplacian + diags(data + 1e-9)).tocsc(), data * inverse.ravel()), np.float64)
    smooth = cv2.resize(solution.reshape(size[1], size[0]), (width, height), interpolation=cv2.INTER_LINEAR)
    known = pointmap.depth[pointmap.depth > 0]
    return (1.0 / np.clip(smooth, 0.5 / known.max(), 2.0 / known.min())).astype(np.float32)


def only(pointmap: Pointmap, keep: Mask) -> Pointmap:
    """The point map with nothing known where `keep` (h, w) does not say so."""
    return replace(
        pointmap,
        depth=pointmap.depth * keep,
        confidence=pointmap.confidence * keep,
        normal=pointmap.normal * keep[..., None],
    )


def _seen_by_others(
    target: Pointmap, image: Image, others: Sequence[tuple[Pointmap, Image]], like: float
) -> tuple[Mask, Mask]:
    """Pixels of the target on which other views' points fall, and those of which one has the pixel's colour.

    Small gaps between the points are closed.
    """
    falls, explained = (np.zeros(target.depth.shape, bool) for _ in range(2))
    for other, other_image in others:
        falls_here, explained_here = reprojection.explained(other, other_image, target, image, like)
        falls |= falls_here
        explained |= explained_here
    return _closed(falls), _closed(explained)


def _closed(mask: Mask) -> Mask:
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0


def _hides_known(filled: Pointmap, others: Sequence[Pointmap], in_front: float) -> Mask:
    """Filled pixels whose point lies clearly before a known surface of another view."""
    wrong = np.zeros(filled.depth.shape, bool)
    for other in others:
        wrong |= reprojection.hiding(filled, other, in_front)
    return wrong


def _facing(pointmap: Pointmap, depth: Float32 | float) -> Pointmap:
    """The point map at another depth, with normals that look straight at the camera."""
    height, width = pointmap.depth.shape
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    K = pointmap.K
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    normal = (-rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    return replace(pointmap, depth=np.full_like(pointmap.depth, depth), normal=normal)
