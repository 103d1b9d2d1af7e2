"""The far shell: Gaussians on a sphere around the scene, so that what no view has seen has the colours around it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import torch
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from splatnode.capture.process.config import Internal
from splatnode.recon import priors
from splatnode.recon.geometry import project, quat_from_matrix, transform_to_camera
from splatnode.recon.priors import Pointmap
from splatnode.recon.result.snapshot import SHELL
from splatnode.recon.scene import SH_C0, Gaussians, logit
from splatnode.recon.threads import map_parallel

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]

EXTENT = 0.7  # standard deviation of a Gaussian along the shell, over the spacing: neighbours overlap without seams
THICKNESS = 0.1  # standard deviation of a Gaussian across the shell, over that along it
MIN_COSINE = 0.05  # of a point's angle to the optical axis: beyond, 87 degrees, a pinhole's pixels run to infinity
BLUR = 0.04  # standard deviation of the colours' blur, over an image's longer side: the shell shows no detail
BLURRED_PX = 4  # pixels of a blurred image in a standard deviation of its blur: finer ones show nothing more
FAR_POWER = 4  # of a pixel's depth over the farthest, by which its colour counts: half as far is a sixteenth
MIN_FAR_WEIGHT = 1e-3  # of the nearest pixel, where no far one is in reach of the blur
OUTSIDE_PENALTY = 10.0  # by which the logarithm of a view's weight falls for each image size that a point lies outside
ELEVATION_STRETCH = 4.0  # by which differences of elevation count: what lies beside the images is more like them
MIN_SQUARED_DISTANCE = 1e-4  # between directions of length 1, in the weights of the continuation
MIN_WIDENING = 1.1  # of the spacing in each attempt to have fewer Gaussians


class BackgroundConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The far shell: Gaussians on a sphere around the scene, so that what no view has seen has the colours around
    it."""

    spacing_deg: Internal[float] = 5.0  # between neighbouring Gaussians of the shell; 0: there is no shell
    margin: Internal[float] = 2.0  # how far beyond the images' borders they are so near, in units of the images' size
    elsewhere_deg: Internal[float] = 10.0  # between those in all other directions; 0: there are none
    distance: Internal[float] = 1.3  # radius, in units of the farthest known depth
    opacity: Internal[float] = 0.95  # of the shell's Gaussians


def far_shell(
    pointmaps: Sequence[Pointmap], images: Sequence[Image], config: BackgroundConfig, max_gaussians: int | None = None
) -> Gaussians:
    """Gaussians on a sphere around the cameras, closer where these look than elsewhere; at most `max_gaussians`.

    `images` (h, w, 3) are those of the point maps. Where there would be more Gaussians, there are none elsewhere, and
    if that does not suffice the others are farther apart.
    """
    shell = _shell(pointmaps, images, config)
    if max_gaussians is not None and len(shell) > max_gaussians:
        config = msgspec.structs.replace(config, elsewhere_deg=0.0)
        shell = _shell(pointmaps, images, config)
    while max_gaussians is not None and len(shell) > max_gaussians:
        wider = max(MIN_WIDENING, (len(shell) / max(max_gaussians, 1)) ** 0.5)
        config = msgspec.structs.replace(config, spacing_deg=wider * config.spacing_deg)
        shell = _shell(pointmaps, images, config)
    return shell


def _shell(pointmaps: Sequence[Pointmap], images: Sequence[Image], config: BackgroundConfig) -> Gaussians:
    """Gaussians with the colours that the images have there, or suggest."""
    centres = np.stack([pointmap.T_world_camera[:3, 3] for pointmap in pointmaps])
    centre = centres.mean(0)
    farthest = max(1e-9, *(float(pointmap.depth.max()) for pointmap in pointmaps))  # no depth may be known anywhere
    spread = float(np.linalg.norm(centres - centre, axis=1).max())
    radius = config.distance * max(farthest, spread)
    fine = _fibonacci_sphere(config.spacing_deg)
    coarse = _fibonacci_sphere(config.elsewhere_deg if len(fine) else 0.0)
    directions = np.concatenate([fine, coarse])
    spacing_deg = np.repeat([config.spacing_deg, config.elsewhere_deg], [len(fine), len(coarse)])
    outside, colours = _sample_colours(centre + radius * directions, farthest, pointmaps, images)
    kept = (outside < config.margin) == (np.arange(len(directions)) < len(fine))
    directions, outside, colours, spacing_deg = directions[kept], outside[kept], colours[kept], spacing_deg[kept]
    inside = outside <= 0
    if inside.any():
        upward = -np.sum([pointmap.T_world_camera[:3, 1] for pointmap in pointmaps], axis=0)
        colours[~inside] = _extrapolate_colours(directions[~inside], directions[inside], colours[inside], upward)
    count = len(directions)
    scales = EXTENT * radius * np.radians(spacing_deg)[:, None] * np.array([1.0, 1.0, THICKNESS])
    return Gaussians(
        means=torch.from_numpy(centre + radius * directions).float(),
        quats=quat_from_matrix(torch.from_numpy(_frames(directions)).float()),
        log_scales=torch.from_numpy(np.log(scales)).float(),
        logit_opacities=torch.full((count,), logit(config.opacity)),
        sh=torch.from_numpy((colours - 0.5) / SH_C0).float()[:, None],
        source_frame=torch.full((count,), SHELL, dtype=torch.int32),
    )


def _sample_colours(
    points: Array, farthest: float, pointmaps: Sequence[Pointmap], images: Sequence[Image]
) -> tuple[Array, Array]:
    """(M,) how far world points (M, 3) lie outside all images, in units of the images' size; (M, 3) their colours.

    A point inside an image has a negative distance, one that no view has before it an infinite one. A colour is
    strongly blurred over what is far or unknown: a near wall says nothing about what lies behind it. It comes from the
    view that sees farthest in that direction, less so the farther outside its image the point lies.
    """
    outside = np.full(len(points), np.inf)
    best = np.full(len(points), -np.inf)
    colours = np.zeros((len(points), 3))
    for pointmap, image in zip(pointmaps, images, strict=True):
        height, width = image.shape[:2]
        in_camera = transform_to_camera(points, pointmap.T_world_camera)
        ahead = in_camera[:, 2] > MIN_COSINE * np.linalg.norm(in_camera, axis=1)
        pixels = project(in_camera, pointmap.K)
        relative = pixels / (width, height) - 0.5
        distance = np.where(ahead, np.abs(relative).max(1) - 0.5, np.inf)
        blurred, sees_far = _far_colours(image, pointmap.depth / farthest, BLUR * max(height, width))
        size = np.array([blurred.shape[1], blurred.shape[0]])
        column, row = np.clip(pixels * (size / (width, height)), 0, size - 1).astype(int).T
        score = np.log(sees_far[row, column]) - OUTSIDE_PENALTY * distance
        better = score > best
        colours[better], best[better] = blurred[row, column][better], score[better]
        outside = np.minimum(outside, distance)
    return outside, colours


def _extrapolate_colours(directions: Array, seen: Array, colours: Array, upward: Array) -> Array:
    """(M, 3) colours for unseen unit `directions` (M, 3), from the colours (N, 3) of directions `seen` (N, 3).

    Inverse distance weighting with the fourth power (Shepard 1968), elevation stretched by ELEVATION_STRETCH.
    `upward` (3,) is of any length.
    """
    upward = upward / max(float(np.linalg.norm(upward)), 1e-9)
    stretched = np.eye(3) + (ELEVATION_STRETCH - 1.0) * np.outer(upward, upward)
    squared = (((directions @ stretched)[:, None] - (seen @ stretched)[None]) ** 2).sum(2)
    nearness = 1.0 / (squared + MIN_SQUARED_DISTANCE) ** 2
    return nearness @ colours / nearness.sum(1, keepdims=True)


def _far_colours(image: Image, relative_depth: Float32, sigma_px: float) -> tuple[Float32, Float32]:
    """Colours (h', w', 3) in [0, 1] blurred over far and unknown pixels, and the weight (h', w') of these.

    `relative_depth` (h, w) is 1 at the farthest known depth and 0 where the depth is unknown. The result has
    BLURRED_PX pixels to a standard deviation `sigma_px` of the blur.
    """
    far = np.where(relative_depth > 0, relative_depth**FAR_POWER, np.float32(1)) + np.float32(MIN_FAR_WEIGHT)
    shrink = max(1.0, sigma_px / BLURRED_PX)
    size = (max(1, round(image.shape[1] / shrink)), max(1, round(image.shape[0] / shrink)))
    weighted = cv2.resize(image * (far / 255)[..., None], size, interpolation=cv2.INTER_AREA)
    sigma = sigma_px / shrink
    weight = cv2.GaussianBlur(cv2.resize(far, size, interpolation=cv2.INTER_AREA), (0, 0), sigma)
    blurred = cv2.GaussianBlur(weighted, (0, 0), sigma)
    return np.asarray(blurred / weight[..., None], np.float32), np.asarray(weight, np.float32)


def _fibonacci_sphere(spacing_deg: float) -> Array:
    """(M, 3) unit directions that cover the sphere evenly, on a Fibonacci lattice; none for a spacing of 0."""
    count = int(4 * np.pi / np.radians(spacing_deg) ** 2) if spacing_deg > 0 else 0
    step = np.arange(count) + 0.5
    z = 1.0 - 2.0 * step / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * step
    across = np.sqrt(1.0 - z**2)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), z])


def _frames(directions: Array) -> Array:
    """(M, 3, 3) rotations whose third axis is each of the unit directions (M, 3)."""
    helper = np.where(np.abs(directions[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])  # far from parallel
    first: Array = np.cross(helper, directions)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first), directions], 2)


# Depth completion: pixels that no two views confirm are filled where no view contradicts it, else left empty.
#
# A plain wall or the sky gives stereo nothing to match. Left empty it would be black in every new view. So a pixel
# that no other view's point of like colour explains gets the first of these depths that hides no known surface from
# another view: stereo's own doubtful depth; the smoothest depth that may jump at the image's edges (the stated prior);
# a far background, which lies beyond all cameras, or it would be a wall before those that look at the scene from its
# other side. Where points of another colour fall on it, something nearer stands before them: it gets a depth
# close to the camera.
#
# The path of the cameras is free: whoever carried them went along it. A depth that would put a surface onto it, seen by
# one view alone and often from the other side of the scene, would veil every new view from there. The path is as wide
# as known surfaces allow, so that a floor below it hardly moves.

Mask = npt.NDArray[np.bool_]

BLUR_PX = 5  # side of the blur before colours are compared: a pixel's noise and half a pixel's offset should not count
GAP_PX = 5  # gaps of this size between the points of another view count as covered
NEAREST_PERCENTILE = 2.0  # of a view's known depths, or distances: what is nearest, of which this part may be wrong
DATA_WEIGHT = 10.0  # of a known inverse depth of confidence 1, against smoothness of weight 1 between neighbours
MIN_LINK = 1e-3  # weight of smoothness across the strongest edge: nothing is cut off from all known depths
PATH_NEIGHBOURS = 2  # other cameras, the nearest ones, to which the path goes on from each camera
PATH_STRIDE = 4  # pixels between the known points that tell how wide the path is
# Only what lies nearer to the path than so many times its distance from the camera that guesses it is moved: a wall
# beside the path goes on, unknown, nearer to its own camera than all that is known there.
PATH_SHARE = 0.5
PATH_STEP = 1.2  # factor by which a depth on the path grows until it lies beside or beyond it
MAX_PATH_STEPS = 12  # at most so often: a depth that is on the path even then is no guess
MAX_EXTRAPOLATION = 2.0  # factor by which a filled depth may lie nearer or farther than all known ones of its view


class DepthCompletionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Depth completion: pixels that no two views confirm are filled where no view contradicts it, else left empty."""

    min_confidence: float = 0.12  # least confidence of stereo for a known depth; those below are doubtful
    min_usable_confidence: float = 0.1  # doubtful depths below tell less than their surroundings do: they are dropped
    colour_tolerance: float = 0.12  # difference of colour, in [0, 1], up to which a point explains a pixel
    min_object_px: int = 15  # width of a region of other colour from which on it is taken for a foreground object
    foreground_depth: float = 0.4  # depth of an unknown foreground, over the nearest known depth of its view
    background_depth: float = 1.5  # depth of an unknown background, over the farthest known depth of its view
    # An unknown background lies outside the sphere around the middle of the cameras whose radius is so many times the
    # distance of the farthest one
    surround: float = 2.0
    # No unknown surface is nearer to the path of the cameras than this many times the nearest known one
    clearance: Internal[float] = 1.0
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
    known = [mask_doubtful(pointmap, config) for pointmap in pointmaps]
    blurred = [np.asarray(cv2.GaussianBlur(image, (BLUR_PX, BLUR_PX), 0), np.uint8) for image in images]
    partners = priors.find_overlapping(known, config.most_partners)
    smooth = map_parallel(partial(_smooth, config=config), known, images)
    beyond = _leave_cameras(known, config.surround)
    path = find_free_path(known, config.clearance)
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
        doubtful = replace(pointmaps[j], depth=_leave_path(pointmaps[j].depth * hole, pointmaps[j], path))
        guesses = _leave_path(filling * (hole & ~covered), known[j], path), beyond[j]
        for guess in _propose_fills(doubtful, known[j], guesses, covered, occluder, config):
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


def mask_doubtful(pointmap: Pointmap, config: DepthCompletionConfig) -> Pointmap:
    """Masks depths of less confidence than `config` wants of known ones."""
    return pointmap.apply_mask(pointmap.confidence >= config.min_confidence)


def _propose_fills(
    doubtful: Pointmap,
    known: Pointmap,
    guesses: tuple[Float32, Float32],
    covered: Mask,
    occluder: Mask,
    config: DepthCompletionConfig,
) -> Iterator[Pointmap]:
    """The point maps that a hole may be filled from, the best first; `guesses` are smooth depths, and those beyond."""
    smooth, beyond = guesses
    near, far = np.percentile(known.depth[known.depth > 0], [NEAREST_PERCENTILE, 100.0])
    yield doubtful
    facing = _facing_camera(known)
    yield replace(facing, depth=smooth).apply_mask(~covered)
    yield replace(facing, depth=np.maximum(beyond, np.float32(config.background_depth * far))).apply_mask(~covered)
    yield replace(facing, depth=np.full_like(smooth, config.foreground_depth * near)).apply_mask(occluder)


@dataclass(frozen=True, eq=False)
class FreePath:
    """The space that the cameras went through: all points within a radius of the segments between neighbours."""

    starts: Array  # (S, 3) world
    ends: Array  # (S, 3) world
    radii: Array  # (S,)

    def contains(self, points: Array, centres: Array | None = None) -> Mask:
        """(M,) whether world points (M, 3) lie there.

        Of points that cameras at `centres`, (M, 3) or (3,), guessed, only those count that are nearer to the path than
        PATH_SHARE of their distance from that camera.
        """
        radii = self.radii
        if centres is not None:
            radii = np.minimum(radii, PATH_SHARE * np.linalg.norm(points - centres, axis=1)[:, None])
        return np.asarray((_square_distances(points, self.starts, self.ends) < radii**2).any(1), bool)


def _square_distances(points: Array, starts: Array, ends: Array) -> Array:
    """(M, S) squared distances of points (M, 3) from segments with these ends (S, 3)."""
    along = ends - starts
    squared_length = (along**2).sum(1)
    dot = points @ along.T - (starts * along).sum(1)
    share = np.clip(dot / np.maximum(squared_length, 1e-18), 0.0, 1.0)
    to_start = (points**2).sum(1)[:, None] - 2.0 * points @ starts.T + (starts**2).sum(1)
    return to_start - share * (2.0 * dot - share * squared_length)


def find_free_path(known: Sequence[Pointmap], clearance: float) -> FreePath:
    """Finds the path of the cameras: `clearance` times as wide as the `known` depths of its cameras allow.

    A segment leads from each camera to its PATH_NEIGHBOURS nearest ones. It is as wide as the known points of each of
    its two cameras are away from it, but for NEAREST_PERCENTILE of them; 0 where a camera knows none.
    """
    centres = np.stack([pointmap.T_world_camera[:3, 3] for pointmap in known])
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    neighbours = np.argsort(distances, axis=1, kind="stable")[:, : min(PATH_NEIGHBOURS, len(centres) - 1)]
    pairs = sorted({(min(i, j), max(i, j)) for i, row in enumerate(neighbours.tolist()) for j in row})
    first, second = np.array(pairs, int).reshape(-1, 2).T
    starts, ends = centres[first], centres[second]
    points = [pointmap.thin_points(PATH_STRIDE).astype(np.float64) for pointmap in known]
    squared = [
        min(_find_nearest_squared(points[each], starts[[segment]], ends[[segment]]) for each in pair)
        for segment, pair in enumerate(pairs)
    ]
    return FreePath(starts, ends, clearance * np.sqrt(np.array(squared)))


def _find_nearest_squared(points: Array, start: Array, end: Array) -> float:
    """NEAREST_PERCENTILE of the squared distances of points (M, 3) from one segment (1, 3); 0 without points."""
    if not len(points):
        return 0.0
    return max(0.0, float(np.percentile(_square_distances(points, start, end), NEAREST_PERCENTILE)))


def _leave_path(depth: Float32, camera: Pointmap, path: FreePath) -> Float32:
    """(h, w) the depths that `camera` guesses, those of points on the path moved away until they have left it.

    0 stays 0: unknown. It is also what a depth becomes that MAX_PATH_STEPS do not suffice for.
    """
    rows, columns = np.nonzero(depth)
    rays = _compute_rays(camera.K, *depth.shape[::-1])[rows, columns] @ camera.T_world_camera[:3, :3].T
    moved, centre = depth[rows, columns], camera.T_world_camera[:3, 3]
    inside = np.arange(len(moved))
    for _ in range(MAX_PATH_STEPS):
        inside = inside[path.contains(centre + moved[inside, None] * rays[inside], centre)]
        if not len(inside):
            break
        moved[inside] *= np.float32(PATH_STEP)
    else:
        moved[inside] = 0.0
    left = depth.copy()
    left[rows, columns] = moved
    return left


def _leave_cameras(pointmaps: Sequence[Pointmap], surround: float) -> list[Float32]:
    """(h, w) of each view: the depths at which its rays leave the sphere around the cameras, `surround` times as large.

    Cameras beside each other that look the same way have a small one, which changes nothing for them.
    """
    centres = np.stack([pointmap.T_world_camera[:3, 3] for pointmap in pointmaps])
    offsets = centres - centres.mean(0)
    radius = surround * float(np.linalg.norm(offsets, axis=1).max())
    found = []
    for pointmap, offset in zip(pointmaps, offsets, strict=True):
        height, width = pointmap.depth.shape
        rays = _compute_rays(pointmap.K, width, height) @ pointmap.T_world_camera[:3, :3].T
        squared, along = (rays**2).sum(-1), rays @ offset
        found.append(
            ((np.sqrt(along**2 + squared * (radius**2 - offset @ offset)) - along) / squared).astype(np.float32)
        )
    return found


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
        covered_here, explained_here = priors.find_explained(other, other_image, target, image, colour_tolerance)
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
        wrong |= priors.find_hiding(filled, other, occlusion_tolerance)
    return wrong


def _facing_camera(pointmap: Pointmap) -> Pointmap:
    """The point map with normals along the rays towards the camera."""
    rays = _compute_rays(pointmap.K, *pointmap.depth.shape[::-1])
    u, v = rays[..., 0], rays[..., 1]
    inverse_length = -1 / np.sqrt(u * u + v * v + 1)
    return replace(pointmap, normal=np.stack([u * inverse_length, v * inverse_length, inverse_length], -1))


def _compute_rays(K: Array, width: int, height: int) -> Float32:
    """(h, w, 3) the points at depth 1 that the pixels' middles show, in the camera's frame."""
    u = ((np.arange(width) + 0.5 - K[0, 2]) / K[0, 0]).astype(np.float32)
    v = ((np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]).astype(np.float32)
    across, down = np.meshgrid(u, v)
    return np.stack([across, down, np.ones_like(across)], -1)
