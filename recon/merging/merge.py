"""One scene out of the submaps of a map."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.merging.merge_fit import (
    DepthView,
    PointVisibility,
    depth_views,
    fit_gaussians,
    measure_visibility,
    surface_views,
)
from splatnode.recon.merging.submap import Submap
from splatnode.recon.result.export.prepare import sanitize_gaussians, select_gaussians
from splatnode.recon.result.export.quaternions import matrices_from_quats
from splatnode.recon.result.levels_of_detail import concatenate_gaussians
from splatnode.recon.result.placement import Placement
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.scene.background import SHELL

# Regions of space, and which submap sees each best: voxels whose size follows the resolution of the views.

Array = npt.NDArray[np.float64]

REGION_PX = 16.0  # side of a region in pixels of the camera that sees it best, up to a factor of 2
NOBODY = -1


def regions(points: npt.NDArray[np.floating], resolution: Array) -> npt.NDArray[np.intp]:
    """(M,) numbers of the regions that the points (M, 3) are in.

    `resolution` (M,) is in pixels a unit of length. A region is a cube with a side of a power of two; a place that is
    seen twice as finely has regions half as large. Points of no resolution share one region.
    """
    known = resolution > 0
    level = np.full(len(points), np.iinfo(np.int32).max, np.int64)
    level[known] = np.ceil(np.log2(REGION_PX / resolution[known])).astype(np.int64)
    side = np.exp2(np.where(known, level, 0).astype(np.float64))
    cells = np.where(known[:, None], np.floor(points / side[:, None]), 0.0).astype(np.int64)
    _, number = np.unique(np.column_stack([level, cells]), axis=0, return_inverse=True)
    return number.reshape(-1).astype(np.intp)


def owners(region: npt.NDArray[np.intp], quality: Array) -> npt.NDArray[np.intp]:
    """(M,) which of S submaps sees the region of each point best in the mean; NOBODY where none sees it.

    `region` (M,) are numbers from 0 on without gaps, `quality` (M, S) is not negative. Of equals the first wins.
    """
    sums = np.stack([np.bincount(region, column) for column in quality.T], 1)
    best = np.where(sums.max(1) > 0, sums.argmax(1), NOBODY)
    return best[region]


# Which Gaussians of each submap stay where submaps overlap.
#
# A region stays with the submap that sees it best. Another submap's Gaussian goes only where the better one has a
# surface itself: so no hole opens. What hangs before a surface that another submap sees, as a far shell does when the
# walk goes on through it, goes too.

Mask = npt.NDArray[np.bool_]

_BODY = (-1.5, 0.0, 1.5)  # standard deviations at which a Gaussian of a far shell is looked at, along it
_WITNESSES = 2  # cameras of another submap that must look through a Gaussian before it counts as a veil


def resolve_seams(submaps: Sequence[Submap]) -> tuple[Mask, ...]:
    """(N,) for each submap, which of its Gaussians stay."""
    if len(submaps) < 2:
        return tuple(np.ones(len(each.gaussians), bool) for each in submaps)
    views = [surface_views(each.gaussians, each.shell, each.cameras) for each in submaps]
    points = np.concatenate([each.gaussians.means for each in submaps])
    seen = [measure_visibility(each, points) for each in views]
    shell = np.concatenate([each.shell for each in submaps])
    mine = np.repeat(np.arange(len(submaps)), [len(each.gaussians) for each in submaps])
    stays = shell | ~(_find_better_elsewhere(points, mine, seen))
    stays &= ~_find_occluders(mine, seen)
    ends = np.cumsum([len(each.gaussians) for each in submaps])[:-1]
    left = np.split(stays, ends)
    for number, each in enumerate(submaps):
        for other, its_views in enumerate(views):
            if other != number:
                left[number] &= ~_find_floaters(each.gaussians, each.shell & left[number], its_views)
    return _remove_near_shells(submaps, left)


def _find_better_elsewhere(
    points: npt.NDArray[np.floating], mine: npt.NDArray[np.intp], seen: Sequence[PointVisibility]
) -> Mask:
    """(M,) whether the region's owner is another submap, and has a surface at the point."""
    quality = np.stack([each.quality for each in seen], 1)
    owner = owners(regions(points, np.stack([each.resolution for each in seen], 1).max(1)), quality)
    on = np.stack([each.on for each in seen], 1)
    return (owner != NOBODY) & (owner != mine) & (on[np.arange(len(points)), owner] > 0)


def _find_occluders(mine: npt.NDArray[np.intp], seen: Sequence[PointVisibility]) -> Mask:
    """(M,) whether a Gaussian hangs before a surface of another submap which is better seen than it is itself."""
    own_on = np.stack([each.on for each in seen], 1)[np.arange(len(mine)), mine]
    own_quality = np.stack([each.quality for each in seen], 1)[np.arange(len(mine)), mine]
    found = np.zeros(len(mine), bool)
    for number, each in enumerate(seen):
        others = mine != number
        through = (each.before >= _WITNESSES) & (each.before > each.on)
        better = (each.veiled > own_quality) | (each.before > own_on)
        found |= others & through & better
    return found


def _find_floaters(gaussians: GaussianArrays, which: Mask, views: Sequence[DepthView]) -> Mask:
    """(N,) whether a Gaussian of `which` (N,) hangs with any part before what one of the `views` has as its surface.

    It is for a far shell: that is large, and nobody has seen it, so one camera that looks through it is enough.
    """
    chosen = np.flatnonzero(which)
    part = select_gaussians(gaussians, chosen)
    axes = matrices_from_quats(part.quats) * part.scales[:, None]  # (M, 3, 3), columns
    steps = np.array([[a, b, 0.0] for a in _BODY for b in _BODY])
    steps = np.take_along_axis(steps[None], np.argsort(np.argsort(-part.scales, 1), 1)[:, None], 2)  # (M, 9, 3)
    body = part.means[:, None] + steps @ axes.transpose(0, 2, 1)
    found = np.zeros(len(gaussians), bool)
    found[chosen] = (
        (measure_visibility(views, body.reshape(-1, 3)).before > 0).reshape(len(chosen), len(_BODY) ** 2).any(1)
    )
    return found


def _remove_near_shells(submaps: Sequence[Submap], stays: Sequence[Mask]) -> tuple[Mask, ...]:
    """The masks without the shells' Gaussians that hang before what another submap shows behind them.

    One submap after the other, each judged by what is left of the others: two shells never drop each other.
    """
    left = [mask.copy() for mask in stays]
    for number, each in enumerate(submaps):
        for other_number, other in enumerate(submaps):
            mine = each.shell & left[number]
            if other_number == number or not mine.any() or not (other.shell & left[other_number]).any():
                continue
            views = depth_views(select_gaussians(other.gaussians, left[other_number]), other.cameras)
            left[number] &= ~_find_floaters(each.gaussians, mine, views)
    return tuple(left)


_LOOKS = 24  # cameras whose median depth tells the unit


@dataclass(frozen=True)
class SubmapShare:
    """The counts of one submap's Gaussians through the merge."""

    scene_id: str
    given: int
    after_seams: int  # that no other submap sees better, and that veil nothing of another
    kept: int  # in the merged scene, without those of its far shell
    cameras: int

    def record(self) -> dict[str, object]:
        """For report.json."""
        return {
            "scene": self.scene_id,
            "gaussians": self.given,
            "after_seams": self.after_seams,
            "kept": self.kept,
            "cameras": self.cameras,
        }


@dataclass(frozen=True, eq=False)
class MergedScene:
    """One scene in the world and unit of its map. A photograph that several submaps have is one camera."""

    gaussians: GaussianArrays  # the source frame is the number of the submap, SHELL in the far shells
    cameras: tuple[CameraEstimate, ...]  # without bounds: those of a submap do not hold across a map
    shares: tuple[SubmapShare, ...]
    shell: int  # Gaussians of the far shells among those that are kept
    depths: Mapping[str, npt.NDArray[np.float16]]  # confirmed z by camera, of the submap that the camera is of
    seconds: Mapping[str, float]


def merge_submaps(submaps: Sequence[Submap], most: int | None = None) -> MergedScene:
    """The submaps as one scene, of at most so many Gaussians. A single one without a limit is as it was.

    Raises ValueError without submaps.
    """
    if not submaps:
        raise ValueError("there must be at least one submap to merge")
    began = time.perf_counter()
    unit = _depth(submaps)
    smaller = Placement(1.0 / unit, np.eye(3), np.zeros(3))
    scaled = [_transform_submap(each, smaller) for each in submaps]
    stays = resolve_seams(scaled)
    parts = [_keep_gaussians(each, number, mask) for number, (each, mask) in enumerate(zip(scaled, stays, strict=True))]
    together, cameras = concatenate_gaussians(parts), tuple(each.cameras for each in scaled)
    seamed = time.perf_counter()
    if len(submaps) > 1 or (most is not None and len(together) > most):
        found = fit_gaussians(scaled, together, most=most)
        together, cameras = found.gaussians, found.cameras
    source = together.source_frame
    shares = tuple(
        SubmapShare(
            each.scene_id, len(each.gaussians), int(mask.sum()), int((source == number).sum()), len(each.cameras)
        )
        for number, (each, mask) in enumerate(zip(scaled, stays, strict=True))
    )
    larger = smaller.inverse()
    gaussians = sanitize_gaussians(larger.transform_gaussians(together))
    seconds = {"seams": seamed - began, "fit": time.perf_counter() - seamed}
    shell = int((source == SHELL).sum())
    return MergedScene(gaussians, _deduplicate_cameras(cameras, larger), shares, shell, _depths(submaps), seconds)


def _keep_gaussians(submap: Submap, number: int, mask: npt.NDArray[np.bool_]) -> GaussianArrays:
    """The Gaussians that stay, with the submap's number, or SHELL, as source frame."""
    source = np.where(submap.shell, SHELL, number).astype(np.int32)
    return select_gaussians(replace(submap.gaussians, source_frame=source), mask)


def _transform_submap(submap: Submap, placement: Placement) -> Submap:
    moved = tuple(placement.transform_camera(camera) for camera in submap.cameras)
    return replace(submap, gaussians=placement.transform_gaussians(submap.gaussians), cameras=moved)


def _depth(submaps: Sequence[Submap]) -> float:
    """The median depth of what the cameras see, in the map's unit; 1 where they see nothing."""
    pairs = [(select_gaussians(each.gaussians, ~each.shell), camera) for each in submaps for camera in each.cameras]
    chosen = np.linspace(0, len(pairs) - 1, min(_LOOKS, len(pairs))).round().astype(int)
    depths = []
    for gaussians, camera in (pairs[index] for index in chosen):
        size = camera.width, camera.height
        depth = render_arrays(gaussians, camera.T_world_camera, camera.K, *size, channels=("depth",)).depth
        depths += [float(np.median(depth[depth > 0]))] if (depth > 0).any() else []
    return float(np.median(depths)) if depths else 1.0


def _deduplicate_cameras(
    cameras: Sequence[Sequence[CameraEstimate]], placement: Placement
) -> tuple[CameraEstimate, ...]:
    """Every photograph's camera once, as its first submap has it, in the order of their frames."""
    found: dict[str, CameraEstimate] = {}
    for camera in (camera for each in cameras for camera in each):
        found.setdefault(camera.name, replace(placement.transform_camera(camera), bounds=None))
    return tuple(sorted(found.values(), key=lambda camera: camera.frame_id))


def _depths(submaps: Sequence[Submap]) -> dict[str, npt.NDArray[np.float16]]:
    """Those of each photograph's first submap, which its camera is of."""
    first: dict[str, Submap] = {}
    for each in submaps:
        for camera in each.cameras:
            first.setdefault(camera.name, each)
    return {name: each.depths[name] for name, each in first.items() if name in each.depths}
