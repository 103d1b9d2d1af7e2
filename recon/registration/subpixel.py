"""Observations to a small part of a pixel: patches of a map's points found again in every view that may show them.

Features are found in each image by itself and differ by half a pixel; a patch of one image laid over another one by
their brightness differs by a tenth. One observation of a point defines what the point is, and is kept; where the others
are follows from it. Views in which the point was not matched are looked at too, so that tracks become longer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.registration import bundle, patch_alignment
from splatnode.recon.registration.patch_alignment import Patches

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    patch_alignment: patch_alignment.Config = patch_alignment.Config()
    longer_side: int = 1600  # pixels; larger images are shrunk
    blur_px: float = 0.7  # before the patches are compared: interpolation adds less to a smooth image
    tilts_deg: tuple[float, ...] = (0.0, 50.0)  # of the surface against the direction to the reference view
    turns: int = 6  # directions into which a tilted surface is tried
    min_correlation: float = 0.8
    max_move_px: float = 3.0  # from where the point was expected, at 1024 px on the longer side
    max_sigma_px: float = 0.2  # of a position along its worst direction: an edge alone does not fix it
    max_angle_deg: float = 50.0  # between the reference view and one in which the point was not matched


@dataclass(frozen=True, eq=False)
class Picture:
    """An image as patches are taken from it."""

    grey: patch_alignment.Grey  # (h, w)
    scale: Array  # (2,) its pixels per pixel of the frame
    principal: Array  # (2,) nominal principal point, pixels of the frame
    size: Array  # (2,) width and height of the frame

    def to_grey(self, pixels: Array) -> Array:
        """Pixels of the grey image, from those of the frame relative to its principal point."""
        return (pixels + self.principal) * self.scale

    def from_grey(self, pixels: Array) -> Array:
        return pixels / self.scale - self.principal

    def enlarged(self, by: float) -> Picture:
        """The picture of a frame that is larger by this factor and shows the same."""
        return Picture(self.grey, self.scale / by, by * self.principal, by * self.size)


def picture(image: npt.NDArray[np.uint8], principal: Array, config: Config) -> Picture:
    """The picture of a frame's `image` (H, W, 3) RGB."""
    height, width = image.shape[:2]
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    shrink = min(1.0, config.longer_side / max(width, height))
    if shrink < 1.0:
        grey = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    grey = cv2.GaussianBlur(grey, (0, 0), config.blur_px).astype(np.float32)
    size = np.array([width, height], np.float64)
    return Picture(grey, np.array(grey.shape[::-1]) / size, principal, size)


@dataclass(frozen=True, eq=False)
class _Sightings:
    """Where points are, or should be, in views other than their reference."""

    camera: Index  # (S,)
    point: Index  # (S,)
    pixels: Array  # (S, 2) relative to the principal point


def refine(
    problem: bundle.Problem, registered: Sequence[int], pictures: Sequence[Picture], config: Config
) -> bundle.Problem:
    """The problem with aligned observations; those that do not align are left out, and points with fewer than two."""
    reference = _central_observations(problem)
    matched = _matched(problem, reference)
    normals = _facing_normals(problem, reference, matched, pictures, config)
    expected = _expected(problem, reference, registered, pictures, config)
    sightings = _Sightings(
        *(
            np.concatenate([getattr(part, name) for part in (matched, expected)])
            for name in ("camera", "point", "pixels")
        )
    )
    aligned = _align(problem, reference, sightings, normals[sightings.point], pictures, config.patch_alignment)
    pixels = _per_picture(pictures, sightings.camera, aligned.target, Picture.from_grey)
    longer_side = np.array([picture.size.max() for picture in pictures])[sightings.camera]
    moved_px = np.linalg.norm(pixels - sightings.pixels, axis=1) * 1024.0 / longer_side
    good = (
        (aligned.correlation > config.min_correlation)
        & (aligned.sigma < config.max_sigma_px)
        & (moved_px < config.max_move_px)
    )
    kept, position = np.unique(sightings.point[good], return_inverse=True)
    point_of = np.concatenate([np.arange(len(kept)), position])
    order = np.argsort(point_of, kind="stable")
    return replace(
        problem,
        points=problem.points[kept],
        camera_of=np.concatenate([problem.camera_of[reference[kept]], sightings.camera[good]])[order],
        point_of=point_of[order],
        pixels=np.concatenate([problem.pixels[reference[kept]], pixels[good]])[order],
    )


def _central_observations(problem: bundle.Problem) -> Index:
    """(P,) each point's observation from the middle of the directions that it is seen from: warps are smallest."""
    towards = _centres(problem)[problem.camera_of] - problem.points[problem.point_of]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    mean = np.zeros_like(problem.points)
    np.add.at(mean, problem.point_of, towards)
    central = (towards * mean[problem.point_of]).sum(1)
    order = np.lexsort((-central, problem.point_of))
    _, first = np.unique(problem.point_of[order], return_index=True)
    return order[first]


def _matched(problem: bundle.Problem, reference: Index) -> _Sightings:
    others = np.ones(len(problem.camera_of), bool)
    others[reference] = False
    return _Sightings(problem.camera_of[others], problem.point_of[others], problem.pixels[others])


def _expected(
    problem: bundle.Problem,
    reference: Index,
    registered: Sequence[int],
    pictures: Sequence[Picture],
    config: Config,
) -> _Sightings:
    """Projections into registered views that do not observe a point but look at it from a similar direction."""
    unseen = np.zeros((len(problem.points), len(problem.rotations)), bool)
    unseen[:, list(registered)] = True
    unseen[problem.point_of, problem.camera_of] = False
    point, camera = np.nonzero(unseen)
    there = replace(problem, camera_of=camera, point_of=point, pixels=np.zeros((len(camera), 2)))
    pixels, depth = bundle.project(there)
    size = np.array([picture.size for picture in pictures])[camera]
    in_frame = pixels + np.array([picture.principal for picture in pictures])[camera]
    centres = _centres(problem)
    similar = _cosines(problem.points[point], centres[camera], centres[problem.camera_of[reference]][point])
    good = (depth > 0) & (in_frame > 0).all(1) & (in_frame < size).all(1)
    good &= similar > np.cos(np.radians(config.max_angle_deg))
    return _Sightings(camera[good], point[good], pixels[good])


def _facing_normals(
    problem: bundle.Problem, reference: Index, matched: _Sightings, pictures: Sequence[Picture], config: Config
) -> Array:
    """(P, 3) of the directions tried, the surface normal under which each point's matched patches agree best."""
    towards = _centres(problem)[problem.camera_of[reference]] - problem.points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    unmoved = msgspec.structs.replace(config.patch_alignment, max_iterations=0)
    best, chosen = np.full(len(towards), -1.0), towards
    for candidates in _tilted(towards, config.tilts_deg, config.turns):
        agreed = _align(problem, reference, matched, candidates[matched.point], pictures, unmoved).correlation
        total = np.bincount(matched.point, np.maximum(agreed, 0.0), minlength=len(towards))
        better = total > best
        best, chosen = np.where(better, total, best), np.where(better[:, None], candidates, chosen)
    return chosen


def _tilted(directions: Array, tilts_deg: Sequence[float], turns: int) -> list[Array]:
    """Unit `directions` (P, 3) tilted by each angle to `turns` sides; not tilted, once."""
    helper = np.where(np.abs(directions[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    across = np.cross(directions, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(directions, across)
    result = []
    for tilt in np.radians(tilts_deg):
        for turn in 2.0 * np.pi * np.arange(turns if tilt else 1) / turns:
            aside = np.cos(turn) * across + np.sin(turn) * along
            result.append(np.cos(tilt) * directions + np.sin(tilt) * aside)
    return result


def _align(
    problem: bundle.Problem,
    reference: Index,
    sightings: _Sightings,
    normals: Array,  # (S, 3)
    pictures: Sequence[Picture],
    config: patch_alignment.Config,
) -> patch_alignment.Aligned:
    """The reference patches of the sighted points, each laid over its target as a plane with its normal says."""
    observed = reference[sightings.point]
    source = problem.camera_of[observed]
    scale = np.array([picture.scale.mean() for picture in pictures])
    affine = plane_affines(problem, problem.points[sightings.point], normals, source, sightings.camera)
    patches = Patches(
        reference_image=source,
        reference=_per_picture(pictures, source, problem.pixels[observed], Picture.to_grey),
        target_image=sightings.camera,
        target=_per_picture(pictures, sightings.camera, sightings.pixels, Picture.to_grey),
        affine=affine * (scale[sightings.camera] / scale[source])[:, None, None],
    )
    return patch_alignment.align([picture.grey for picture in pictures], patches, config)


def plane_affines(problem: bundle.Problem, points: Array, normals: Array, source: Index, target: Index) -> Array:
    """(S, 2, 2) how offsets of pixels in camera `source` (S,) become offsets in `target` (S,).

    Near `points` (S, 3) the scene is a plane with the `normals` (S, 3). Distortion is left out: over a patch it is
    nothing.
    """
    focal = np.exp(problem.log_focals[problem.lens_of_camera])
    in_source, in_target = (
        np.einsum("sij,sj->si", problem.rotations[camera], points) + problem.translations[camera]
        for camera in (source, target)
    )
    axes = problem.rotations[source]  # rows: the camera's axes in the world
    ray = points - _centres(problem)[source]
    along_normal = (normals * ray).sum(1)
    # A step of one pixel moves the ray aside by depth / focal at the point, and from there along the ray to the plane.
    steps = axes[:, :2] * (in_source[:, 2] / focal[source])[:, None, None]
    slide = (
        np.einsum("skj,sj->sk", steps, normals) / np.where(np.abs(along_normal) < 1e-12, 1e-12, along_normal)[:, None]
    )
    steps = steps - slide[:, :, None] * ray[:, None, :]
    moved = np.einsum("sij,skj->ski", problem.rotations[target], steps)
    depth = in_target[:, 2]
    flat = moved[:, :, :2] - moved[:, :, 2:] * (in_target[:, :2] / depth[:, None])[:, None, :]
    return np.swapaxes(flat * (focal[target] / depth)[:, None, None], 1, 2)


def _centres(problem: bundle.Problem) -> Array:
    return -np.einsum("cji,cj->ci", problem.rotations, problem.translations)


def _cosines(points: Array, one: Array, other: Array) -> Array:
    """(S,) of the angles under which `points` see two places."""
    first, second = one - points, other - points
    return (first * second).sum(1) / (np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1))


def _per_picture(pictures: Sequence[Picture], camera: Index, pixels: Array, convert) -> Array:
    result = np.empty_like(pixels)
    for index, one in enumerate(pictures):
        mine = camera == index
        result[mine] = convert(one, pixels[mine])
    return result
