"""Subpixel refinement of observations: patches of the model's points aligned in every view that may show them.

Feature positions of one point are independent in each image and differ by half a pixel; aligned patches differ by a
tenth. One observation of a point, the reference, defines the point and is kept; the others are aligned to it. Views in
which the point was not matched are tried too, so that tracks become longer.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.core import library
from splatnode.recon.keyframes import REFERENCE_SIDE
from splatnode.recon.registration import bundle_adjustment

# Affine alignment of image patches to parts of a pixel (Baker and Matthews, 2004).

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Grey = npt.NDArray[np.float32]

MAX_RADIUS = 12  # pixels; `kMaxRadius` of recon/core/align.cpp


class PatchAlignmentConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Affine alignment of image patches to parts of a pixel (Baker and Matthews, 2004)."""

    radius: int = 8  # of a patch, pixels; at most 12
    max_iterations: int = 20  # of Gauss-Newton, at most


@dataclass(frozen=True, eq=False)
class Patches:
    """M patches of reference images, with a first guess of their positions in target images.

    Pixels are those of the images given to `align`, the top-left pixel's centre at (0.5, 0.5).
    """

    reference_image: Index  # (M,)
    reference: Array  # (M, 2) pixels
    target_image: Index  # (M,)
    target: Array  # (M, 2) pixels
    affine: Array  # (M, 2, 2) from offsets in the reference to offsets in the target


@dataclass(frozen=True, eq=False)
class AlignedPatches:
    """The M patches after alignment."""

    target: Array  # (M, 2) pixels
    affine: Array  # (M, 2, 2)
    correlation: Array  # (M,) normalised, of grey levels after the warp; -1 where a patch could not be aligned
    sigma: Array  # (M,) standard deviation of the position along its worst direction, pixels; infinite where it failed


def align(images: Sequence[Grey], patches: Patches, config: PatchAlignmentConfig) -> AlignedPatches:
    """Aligns the patches with their targets, by an affine warp and a gain and offset of the grey levels.

    `images` are (H, W) float32, grey levels of 0 to 255. With `max_iterations` 0 nothing moves: the result has the
    correlations of the first guess. Raises ValueError for a radius or an image number out of range.
    """
    count = len(patches.reference)
    if not 1 <= config.radius <= MAX_RADIUS:
        raise ValueError(f"the radius of a patch must be 1 to {MAX_RADIUS} pixels, got {config.radius}")
    for name, index in (("reference", patches.reference_image), ("target", patches.target_image)):
        if count and not 0 <= index.min() <= index.max() < len(images):
            raise ValueError(f"{name} images must be in [0, {len(images)}), got {index.min()} to {index.max()}")
    contiguous = [np.ascontiguousarray(image, dtype=np.float32) for image in images]
    pixels = (ctypes.c_void_p * len(images))(*(image.ctypes.data for image in contiguous))
    heights, widths = (np.array([image.shape[axis] for image in images], np.int32) for axis in (0, 1))
    indices = [np.ascontiguousarray(index, np.int32) for index in (patches.reference_image, patches.target_image)]
    reference = np.ascontiguousarray(patches.reference, np.float32)
    target, affine = (np.array(values, np.float32, order="C") for values in (patches.target, patches.affine))
    correlation, sigma = np.empty(count, np.float32), np.empty(count, np.float32)
    native_images = _Images(ctypes.cast(pixels, ctypes.c_void_p), widths.ctypes.data, heights.ctypes.data)
    arrays = (*indices, reference, target, affine, correlation, sigma)
    native = _Patches(*(array.ctypes.data for array in arrays), count, config.radius, config.max_iterations)
    library().core_align(ctypes.byref(native_images), ctypes.byref(native))
    return AlignedPatches(*(result.astype(np.float64) for result in (target, affine, correlation, sigma)))


class _Images(ctypes.Structure):
    """`Images` of recon/core/align.cpp."""

    _fields_ = tuple((name, ctypes.c_void_p) for name in ("pixels", "widths", "heights"))


class _Patches(ctypes.Structure):
    """`Patches` of recon/core/align.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("reference_image", "target_image", "reference", "target", "affine")),
        *((name, ctypes.c_void_p) for name in ("correlation", "sigma")),
        *((name, ctypes.c_int32) for name in ("count", "radius", "max_iterations")),
    )


# The image of a view as patches are taken from it: grey, smoothed, and of limited size.


class PatchImageConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The image of a view as patches are taken from it: grey, smoothed, and of limited size."""

    max_longer_side: int = 1600  # larger images are shrunk, pixels
    blur_px: float = 0.7  # sigma of the smoothing, after shrinking: interpolation errs less in a smooth image


@dataclass(frozen=True, eq=False)
class PatchImage:
    """A grey image of a frame; the frame's pixels are relative to its nominal principal point."""

    grey: Grey  # (h, w) 0 to 255
    scale: Array  # (2,) its pixels per pixel of the frame, horizontally and vertically
    principal: Array  # (2,) nominal principal point, pixels of the frame
    size: Array  # (2,) width and height of the frame, pixels

    def map_to_grey(self, pixels: Array) -> Array:
        """(M, 2) pixels of the grey image, from `pixels` (M, 2) of the frame relative to its principal point."""
        return (pixels + self.principal) * self.scale

    def map_from_grey(self, pixels: Array) -> Array:
        """(M, 2) the inverse of `map_to_grey`."""
        return pixels / self.scale - self.principal

    def rescale(self, scale: float) -> PatchImage:
        """The same image, as that of the frame resized by this factor."""
        return PatchImage(self.grey, self.scale / scale, scale * self.principal, scale * self.size)


def patch_image(image: npt.NDArray[np.uint8], principal: Array, config: PatchImageConfig) -> PatchImage:
    """The patch image of a frame's `image` (H, W, 3) RGB with its principal point (2,) in pixels."""
    height, width = image.shape[:2]
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    shrink = min(1.0, config.max_longer_side / max(width, height))
    if shrink < 1.0:
        grey = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    grey = cv2.GaussianBlur(grey, (0, 0), config.blur_px).astype(np.float32)
    size = np.array([width, height], np.float64)
    return PatchImage(grey, np.array(grey.shape[::-1]) / size, principal, size)


_PARALLEL = 0.7  # component of a unit vector below which its axis is clearly not parallel to it
_MIN_ALONG_NORMAL = 1e-12  # component of a ray along a surface's normal, in place of 0: the surface is seen edge-on


class SubpixelConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Subpixel refinement of observations: patches of the model's points aligned in every view that may show them."""

    patch_alignment: PatchAlignmentConfig = PatchAlignmentConfig()
    patch_image: PatchImageConfig = PatchImageConfig()
    # Angles that are tried, of the surface's normal from the direction to the reference
    slants_deg: tuple[float, ...] = (0.0, 50.0)
    directions: int = 6  # that are tried for a slanted normal, evenly around
    min_correlation: float = 0.8  # least correlation of an aligned patch with its reference
    max_move_px: float = 3.0  # farthest from the matched or predicted position, pixels at REFERENCE_SIDE
    # Largest sigma of a position in its worst direction, pixels: an edge alone does not fix it
    max_sigma_px: float = 0.2
    # Largest between the rays of the reference and of a view in which the point was not matched
    max_angle_deg: float = 50.0


@dataclass(frozen=True, eq=False)
class _Observations:
    """S observations, matched or predicted, of points in views other than their reference."""

    camera: Index  # (S,)
    point: Index  # (S,)
    pixels: Array  # (S, 2) relative to the principal point


def refine(
    problem: bundle_adjustment.Problem, registered: Sequence[int], images: Sequence[PatchImage], config: SubpixelConfig
) -> bundle_adjustment.Problem:
    """The problem with aligned observations, sorted by point.

    Observations that do not align are dropped, and points with fewer than two. `images` are those of the cameras.
    """
    reference = _references(problem)
    matched = _others(problem, reference)
    normals = _best_normals(problem, reference, matched, images, config)
    predicted = _predict_observations(problem, reference, registered, images, config)
    observations = _Observations(
        *(
            np.concatenate([getattr(part, name) for part in (matched, predicted)])
            for name in ("camera", "point", "pixels")
        )
    )
    aligned = _align(problem, reference, observations, normals[observations.point], images, config.patch_alignment)
    pixels = _per_image(images, observations.camera, aligned.target, PatchImage.map_from_grey)
    longer_side = np.array([image.size.max() for image in images])[observations.camera]
    moved_px = np.linalg.norm(pixels - observations.pixels, axis=1) * REFERENCE_SIDE / longer_side
    good = (
        (aligned.correlation > config.min_correlation)
        & (aligned.sigma < config.max_sigma_px)
        & (moved_px < config.max_move_px)
    )
    kept, position = np.unique(observations.point[good], return_inverse=True)
    point_of = np.concatenate([np.arange(len(kept)), position])
    order = np.argsort(point_of, kind="stable")
    return replace(
        problem,
        points=problem.points[kept],
        camera_of=np.concatenate([problem.camera_of[reference[kept]], observations.camera[good]])[order],
        point_of=point_of[order],
        pixels=np.concatenate([problem.pixels[reference[kept]], pixels[good]])[order],
    )


def _references(problem: bundle_adjustment.Problem) -> Index:
    """(P,) each point's most central observation, from which the warps to the others are smallest."""
    towards = bundle_adjustment.centres(problem)[problem.camera_of] - problem.points[problem.point_of]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    mean = np.zeros_like(problem.points)
    np.add.at(mean, problem.point_of, towards)
    central = (towards * mean[problem.point_of]).sum(1)
    order = np.lexsort((-central, problem.point_of))
    _, first = np.unique(problem.point_of[order], return_index=True)
    return order[first]


def _others(problem: bundle_adjustment.Problem, reference: Index) -> _Observations:
    """The observations that are not the reference of their point."""
    others = np.ones(len(problem.camera_of), bool)
    others[reference] = False
    return _Observations(problem.camera_of[others], problem.point_of[others], problem.pixels[others])


def _predict_observations(
    problem: bundle_adjustment.Problem,
    reference: Index,
    registered: Sequence[int],
    images: Sequence[PatchImage],
    config: SubpixelConfig,
) -> _Observations:
    """Projections of points into registered views that do not observe them but see them from a similar direction."""
    unobserved = np.zeros((len(problem.points), len(problem.rotations)), bool)
    unobserved[:, list(registered)] = True
    unobserved[problem.point_of, problem.camera_of] = False
    point, camera = np.nonzero(unobserved)
    elsewhere = replace(problem, camera_of=camera, point_of=point, pixels=np.zeros((len(camera), 2)))
    pixels, depth = bundle_adjustment.project(elsewhere)
    size = np.array([image.size for image in images])[camera]
    in_frame = pixels + np.array([image.principal for image in images])[camera]
    centres = bundle_adjustment.centres(problem)
    similar = _cosines(problem.points[point], centres[camera], centres[problem.camera_of[reference]][point])
    good = (depth > 0) & (in_frame > 0).all(1) & (in_frame < size).all(1)
    good &= similar > np.cos(np.radians(config.max_angle_deg))
    return _Observations(camera[good], point[good], pixels[good])


def _best_normals(
    problem: bundle_adjustment.Problem,
    reference: Index,
    matched: _Observations,
    images: Sequence[PatchImage],
    config: SubpixelConfig,
) -> Array:
    """(P, 3) the surface normal, of those tried, with the highest summed correlation of a point's matched patches."""
    towards = bundle_adjustment.centres(problem)[problem.camera_of[reference]] - problem.points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    unmoved = msgspec.structs.replace(config.patch_alignment, max_iterations=0)
    best, chosen = np.full(len(towards), -1.0), towards
    for candidates in _slant_directions(towards, config.slants_deg, config.directions):
        correlation = _align(problem, reference, matched, candidates[matched.point], images, unmoved).correlation
        total = np.bincount(matched.point, np.maximum(correlation, 0.0), minlength=len(towards))
        better = total > best
        best, chosen = np.where(better, total, best), np.where(better[:, None], candidates, chosen)
    return chosen


def _slant_directions(towards: Array, slants_deg: Sequence[float], directions: int) -> list[Array]:
    """Unit vectors `towards` (P, 3) slanted by each angle into so many directions; by an angle of 0 once."""
    helper = np.where(np.abs(towards[:, :1]) < _PARALLEL, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    across = np.cross(towards, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(towards, across)
    result = []
    for slant in np.radians(slants_deg):
        for angle in 2.0 * np.pi * np.arange(directions if slant else 1) / directions:
            aside = np.cos(angle) * across + np.sin(angle) * along
            result.append(np.cos(slant) * towards + np.sin(slant) * aside)
    return result


def _align(
    problem: bundle_adjustment.Problem,
    reference: Index,
    observations: _Observations,
    normals: Array,  # (S, 3)
    images: Sequence[PatchImage],
    config: PatchAlignmentConfig,
) -> AlignedPatches:
    """Aligns the reference patch of each observed point, warped as a plane with its normal, with the observation."""
    observed = reference[observations.point]
    source = problem.camera_of[observed]
    scale = np.array([image.scale.mean() for image in images])
    affine = plane_affines(problem, problem.points[observations.point], normals, source, observations.camera)
    patches = Patches(
        reference_image=source,
        reference=_per_image(images, source, problem.pixels[observed], PatchImage.map_to_grey),
        target_image=observations.camera,
        target=_per_image(images, observations.camera, observations.pixels, PatchImage.map_to_grey),
        affine=affine * (scale[observations.camera] / scale[source])[:, None, None],
    )
    return align([image.grey for image in images], patches, config)


def plane_affines(
    problem: bundle_adjustment.Problem, points: Array, normals: Array, source: Index, target: Index
) -> Array:
    """(S, 2, 2) derivatives of pixels in the cameras `target` (S,) by pixels in the cameras `source` (S,).

    They are those of the plane's homography at `points` (S, 3) with the `normals` (S, 3). Distortion is left out: over
    a patch it hardly changes.
    """
    focal = np.exp(problem.log_focals[problem.lens_of_camera])
    in_source, in_target = (
        np.einsum("sij,sj->si", problem.rotations[camera], points) + problem.translations[camera]
        for camera in (source, target)
    )
    axes = problem.rotations[source]  # rows: the camera's axes in the world
    ray = points - bundle_adjustment.centres(problem)[source]
    along_normal = (normals * ray).sum(1)
    # A step of one pixel moves the ray aside by depth / focal at the point, and from there along the ray to the plane.
    steps = axes[:, :2] * (in_source[:, 2] / focal[source])[:, None, None]
    along_normal = np.where(np.abs(along_normal) < _MIN_ALONG_NORMAL, _MIN_ALONG_NORMAL, along_normal)
    slide = np.einsum("skj,sj->sk", steps, normals) / along_normal[:, None]
    steps = steps - slide[:, :, None] * ray[:, None, :]
    moved = np.einsum("sij,skj->ski", problem.rotations[target], steps)
    depth = in_target[:, 2]
    flat = moved[:, :, :2] - moved[:, :, 2:] * (in_target[:, :2] / depth[:, None])[:, None, :]
    return np.swapaxes(flat * (focal[target] / depth)[:, None, None], 1, 2)


def _cosines(points: Array, one: Array, other: Array) -> Array:
    """(S,) cosines of the angles at `points` (S, 3) between the directions to `one` and to `other` (S, 3)."""
    first, second = one - points, other - points
    return (first * second).sum(1) / (np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1))


def _per_image(
    images: Sequence[PatchImage], camera: Index, pixels: Array, convert: Callable[[PatchImage, Array], Array]
) -> Array:
    """(S, 2) the `pixels` (S, 2) of the cameras `camera` (S,), each converted by its own image."""
    result = np.empty_like(pixels)
    for index, image in enumerate(images):
        own = camera == index
        result[own] = convert(image, pixels[own])
    return result
