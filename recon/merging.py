"""One scene out of the submaps of a map: each a finished scene, in the world of the map that it is part of.

What stays of the submaps is fitted so that every camera sees what its own submap showed it. At a seam two scenes meet
that were fitted apart: their surfaces are a little beside each other, and what one camera never saw may hang before
another one. What each submap shows to its own cameras is known, so the Gaussians are refined to show that, all
together, and the cameras find their places among them. On the way those go that no camera would miss, and where there
is a limit, those that the cameras would miss least.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.capture.process.terminal import say, show_waiting
from splatnode.capture.process.text import LONGEST_TEXT, sanitize_text
from splatnode.recon.geometry import transform_to_camera
from splatnode.recon.optimize import training
from splatnode.recon.optimize.control import ControlChoice, prune
from splatnode.recon.rasterize import Camera
from splatnode.recon.result.export import SceneFileError, write_result
from splatnode.recon.result.export.formats.ply import compute_max_gaussians, encode_ply
from splatnode.recon.result.export.limits import sanitize_gaussians, select_gaussians
from splatnode.recon.result.export.staged import hold_result_folder, json_bytes
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.levels_of_detail import (
    LEVELS_FILE,
    DetailLevel,
    concatenate_gaussians,
    find_far_shell,
    make_detail_levels,
    make_levels_record,
)
from splatnode.recon.result.placement import Placement, matrices_from_quats
from splatnode.recon.result.rendering import NEAR, render_arrays
from splatnode.recon.result.report import (
    build_report,
    estimate_result_bytes,
    make_contact_sheet,
    peak_rss_mb,
    render_camera,
)
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot, format_rounded_up
from splatnode.recon.result.stored_snapshot import (
    DEPTHS,
    SHELL_PIECE,
    encode_depths,
    make_merged_path,
    make_piece_name,
    read_depths,
    read_up,
)
from splatnode.recon.result.submap_index import JoinedMap, MapSet, SubmapEntry, group_edges, read_map_set, walk_edges
from splatnode.recon.result.verdict import SURE, TWO_SIDED_95, Code, ReferenceFrame, Scale, Up, Verdict
from splatnode.recon.scene import Gaussians, Scene, TrainingView
from splatnode.recon.scene.background import SHELL


@dataclass(frozen=True, eq=False)
class Submap:
    """A scene's Gaussians and cameras in the map's world and unit."""

    scene_id: str
    verdict: str
    gaussians: GaussianArrays
    cameras: tuple[CameraEstimate, ...]
    shell: npt.NDArray[np.bool_]  # (N,) which of the Gaussians are its far shell
    # Confirmed z by camera, as of a Snapshot; none of a scene that is known too roughly for a map of free space
    depths: Mapping[str, npt.NDArray[np.float16]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Submaps:
    """The submaps of a map that can be merged, and why the rest cannot."""

    used: tuple[Submap, ...]
    left_out: dict[str, str]  # scene_id: why


def load_submaps(whole: MapSet, of: JoinedMap) -> Submaps:
    """The scenes of a map that are final and published, in the order of places.json.

    Raises SceneFileError where a result is damaged, OSError where it cannot be read.
    """
    used, left_out = [], {}
    for scene_id, placement in of.placements.items():
        place = whole.submaps[scene_id]
        why = _explain_exclusion(place)
        if why:
            left_out[scene_id] = why
        else:
            used.append(_load(place, placement))
    return Submaps(tuple(used), left_out)


def place_submap(
    scene_id: str,
    verdict: str,
    gaussians: GaussianArrays,
    cameras: tuple[CameraEstimate, ...],
    placement: Placement,
    depths: Mapping[str, npt.NDArray[np.float16]] = MappingProxyType({}),
) -> Submap:
    """The scene, given in its own world, where `placement` puts it."""
    shell = find_far_shell(gaussians, cameras)
    moved = tuple(placement.transform_camera(camera) for camera in cameras)
    farther = {name: (placement.scale * depth.astype(np.float32)).astype(np.float16) for name, depth in depths.items()}
    return Submap(scene_id, verdict, placement.transform_gaussians(gaussians), moved, shell, farther)


def _explain_exclusion(place: SubmapEntry) -> str:
    if place.folder is None or not place.publishable:
        return f"it has no result: {place.verdict}"
    if place.provisional:
        return "its scene is not final yet"
    if not (place.folder / "scene.ply").is_file():
        return f"{place.folder.name}/scene.ply is not there"
    return ""


def _load(place: SubmapEntry, placement: Placement) -> Submap:
    assert place.folder is not None  # `_explain_exclusion` has seen to it
    result = StoredResult.create_from_path(place.folder)
    try:
        sure = place.verdict in {code.value for code in SURE}
        depths = read_depths(place.folder) if sure else {}
        return place_submap(place.scene_id, place.verdict, result.gaussians(), result.cameras(), placement, depths)
    except SceneFileError as error:
        raise SceneFileError(f"{place.folder}: {error}") from error


# The unit and the up of a map: those of its first scene, and how well they are known in the others.
#
# The others hang on the first one by links. Where a scene lies by all links together is known no worse than by any one
# way along them; so the way of the fewest links bounds how wrong its scale and its rotation are to those of the first.
# By that much more than the first scene's, and independently, they may be wrong.

_MOST_SIGMA = 1.0  # of the logarithm of a scale: beyond, nothing is known of it


@dataclass(frozen=True)
class _Sigmas:
    """Standard deviations, to the first scene: of the logarithm of the scale, and of the rotation."""

    scale: float
    deg: float

    def add_link(self, scale: float, deg: float) -> _Sigmas:
        return _Sigmas(math.hypot(self.scale, scale), math.hypot(self.deg, deg))


def scale_and_up(whole: MapSet, of: JoinedMap, scenes: Sequence[str]) -> tuple[Scale, Up | None]:
    """Combines scale and up of a map of these scenes: what is said of all holds for the one that is known worst.

    The world and the unit are those of the scene that the map is named after. Raises SceneFileError, OSError.
    """
    place = whole.submaps.get(of.name)
    if place is None or place.folder is None:
        return Scale(), None
    scale, up = StoredResult.create_from_path(place.folder).scale(), read_up(place.folder)
    further = [each for each in scenes if each != of.name]
    if not further:
        return scale, up
    worst = _find_largest_sigmas(whole, of.name, further)
    scale = replace(scale, frame=_combine_frames(scale.frame, worst, of.name))
    return _combine_scales(scale, worst, of.name, len(further)), up and _combine_up(up, worst, of.name)


def _find_largest_sigmas(whole: MapSet, first: str, further: Sequence[str]) -> _Sigmas | None:
    """The largest of all further scenes; None where it is not known of one of them."""
    known = {first: _Sigmas(0.0, 0.0)}
    for here, there, link in walk_edges(first, group_edges(whole.links)):
        if here in known and link.sigma_scale is not None and link.sigma_deg is not None:
            known[there] = known[here].add_link(link.sigma_scale, link.sigma_deg)
    if not all(each in known for each in further):
        return None
    return _Sigmas(max(known[each].scale for each in further), max(known[each].deg for each in further))


def _combine_scales(scale: Scale, worst: _Sigmas | None, first: str, further: int) -> Scale:
    if not scale.metric:
        return scale
    scenes = "a further scene hangs" if further == 1 else f"{further} further scenes hang"
    source = f"{scale.source or 'metres'}, in {first}; {scenes} on it by links, "
    if scale.interval_95 is None or worst is None or worst.scale > _MOST_SIGMA:
        return _set_source(
            replace(scale, interval_95=None), f"{source}and how well the metres are known there is not told"
        )
    low, high = scale.interval_95
    of_links = TWO_SIDED_95 * worst.scale
    wider = math.exp(-math.hypot(math.log(low), of_links)), math.exp(math.hypot(math.log(high), of_links))
    source += f"known to {format_rounded_up(100 * (wider[1] - 1.0))} % in all"
    return _set_source(replace(scale, interval_95=wider), source)


def _set_source(scale: Scale, source: str) -> Scale:
    """Sets the source, unless it is longer than files may have it."""
    return replace(scale, source=source) if len(source) <= LONGEST_TEXT else scale


def _combine_frames(frame: ReferenceFrame, worst: _Sigmas | None, first: str) -> ReferenceFrame:
    """The frame of the first scene, in which the further ones may be turned; its first camera stays that of a map."""
    if frame.source is None:
        return frame
    source = sanitize_text(f"{frame.source}, in {first}", LONGEST_TEXT)
    if frame.sigma_deg is None or worst is None:
        return replace(frame, source=source)
    return replace(frame, source=source, sigma_deg=min(math.hypot(frame.sigma_deg, worst.deg), 180.0))


def _combine_up(up: Up, worst: _Sigmas | None, first: str) -> Up:
    sigma_deg = up.sigma_deg if worst is None else min(math.hypot(up.sigma_deg, worst.deg), 180.0)
    return replace(up, source=f"{up.source}, in {first}", sigma_deg=sigma_deg)


PASSES = 16  # iterations for each camera
RATE = 0.5  # of the step sizes of a refinement: the submaps are fitted already
SHELL_SHARE = 0.1  # of a limit on the Gaussians, at most, for the far shells


@dataclass(frozen=True, eq=False)
class FitResult:
    """The Gaussians of a map, each with the number of its submap as source frame, or SHELL; and all its cameras."""

    gaussians: GaussianArrays
    cameras: tuple[tuple[CameraEstimate, ...], ...]  # of each submap, where they see what that submap showed


def fit_gaussians(
    submaps: Sequence[Submap],
    gaussians: GaussianArrays,
    *,
    most: int | None = None,
    passes: int = PASSES,
    seed: int = 0,
) -> FitResult:
    """The `gaussians` of the `submaps`, whose median depth must be about 1, at most `most` of them.

    Their source frames are as `FitResult` has them.
    """
    views = [_view(each.gaussians, camera) for each in submaps for camera in each.cameras]
    begun = _tensors(gaussians)
    if most is not None:
        begun = _limit_shells(begun, [_camera(view) for view in views], most, seed)
    config = training.RefinementConfig(
        iterations=passes * len(views),
        checkpoints=(),
        first_opacity=None,
        control=ControlChoice("prune", prune.Config()),
        lr=_rates(),
    )
    *_, scene = training.refine(Scene(tuple(views), begun), config, seed=seed, max_gaussians=most)
    found = iter(scene.views)
    cameras = tuple(
        tuple(replace(camera, T_world_camera=_rigid(next(found).T_world_camera)) for camera in each.cameras)
        for each in submaps
    )
    return FitResult(scene.arrays(), cameras)


def _rates() -> training.LearningRates:
    whole = training.CAUTIOUS
    slower = {name: RATE * getattr(whole, name) for name in ("means", "quats", "log_scales", "sh")}
    return msgspec.structs.replace(whole, **slower)


def _view(gaussians: GaussianArrays, camera: CameraEstimate) -> TrainingView:
    """Renders the submap in its own camera, as the image to fit."""
    return TrainingView(
        camera.name,
        camera.frame_id,
        render_camera(gaussians, camera),
        torch.from_numpy(camera.T_world_camera).float(),
        torch.from_numpy(camera.K).float(),
    )


def _camera(view: TrainingView) -> Camera:
    return Camera(view.T_world_camera, view.K, view.width, view.height)


def _limit_shells(gaussians: Gaussians, cameras: Sequence[Camera], most: int, seed: int) -> Gaussians:
    """Without the shells' Gaussians that are missed least, where a limit left too little beside all of them."""
    shell = (gaussians.source_frame == SHELL).nonzero()[:, 0]
    room = int(SHELL_SHARE * most)
    if len(shell) <= room:
        return gaussians
    worth = prune.estimate_removal_changes(gaussians, cameras, 1, torch.Generator().manual_seed(seed))
    keep = gaussians.source_frame != SHELL
    keep[shell[worth[shell].topk(room).indices]] = True
    return gaussians.subset(keep)


def _tensors(gaussians: GaussianArrays) -> Gaussians:
    opacities = np.clip(gaussians.opacities.astype(np.float64), 1e-6, 1 - 1e-6)

    def tensor(values: npt.NDArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))

    return Gaussians(
        means=tensor(gaussians.means),
        quats=tensor(gaussians.quats),
        log_scales=tensor(np.log(gaussians.scales)),
        logit_opacities=tensor(np.log(opacities) - np.log1p(-opacities)),
        sh=tensor(gaussians.sh),
        source_frame=torch.from_numpy(gaussians.source_frame),
    )


def _rigid(T: Tensor) -> npt.NDArray[np.float64]:
    """(4, 4) in float64, with a rotation that is one: that of float32 is rounded in every step."""
    exact = T.double().numpy().copy()
    u, _, vt = np.linalg.svd(exact[:3, :3])
    exact[:3, :3] = u @ vt
    return exact


# What a submap's cameras know of a point: whether they see a surface there, through it, or something before it.

Array = npt.NDArray[np.float64]

ALIKE = 0.05  # part of the depth within which a point lies on the surface: the depth that is rendered is a mean
BEFORE = 0.1  # part of the depth from which on a point lies before the surface
SOLID = 0.5  # opacity from which on a pixel has a surface
_AROUND = np.ones((3, 3), np.uint8)  # pixels among which a point's own is looked for: edges are blurred


@dataclass(frozen=True, eq=False)
class DepthView:
    """A camera, and between which depths the surface lies around each of its pixels."""

    camera: CameraEstimate
    nearest: npt.NDArray[np.float32]  # (H, W) infinite where there is no surface
    farthest: npt.NDArray[np.float32]  # (H, W) 0 where there is none


@dataclass(frozen=True, eq=False)
class PointVisibility:
    """The visibility of M points in the cameras of one submap. Pixels are those of the cameras at modelled size."""

    resolution: Array  # (M,) pixels a unit of length of the best camera that has the point on its surface, or 0
    on: npt.NDArray[np.int32]  # (M,) cameras that have the point on their surface
    before: npt.NDArray[np.int32]  # (M,) cameras that have it before their surface: they look through it
    veiled: Array  # (M,) pixels a unit of length at the surface behind the point, of the best such camera, or 0

    @property
    def quality(self) -> Array:
        """(M,) how well the point's surface is seen: the resolution, less for few views or disagreeing ones."""
        return self.resolution * self.on / (self.on + 1.0) * self.on / np.maximum(self.on + self.before, 1)


def depth_views(gaussians: GaussianArrays, cameras: Sequence[CameraEstimate]) -> tuple[DepthView, ...]:
    """Renders the surface of the Gaussians in each camera."""
    return tuple(_depth_view(gaussians, camera) for camera in cameras)


def surface_views(
    gaussians: GaussianArrays, shell: npt.NDArray[np.bool_], cameras: Sequence[CameraEstimate]
) -> tuple[DepthView, ...]:
    """The same without the far shell, which is no surface."""
    return depth_views(select_gaussians(gaussians, ~shell), cameras)


def measure_visibility(views: Sequence[DepthView], points: npt.NDArray[np.floating]) -> PointVisibility:
    """Measures the visibility of the world points (M, 3) in all `views` together."""
    count = len(points)
    resolution, veiled = np.zeros(count), np.zeros(count)
    on, before = np.zeros(count, np.int32), np.zeros(count, np.int32)
    for view in views:
        index, depth, nearest, farthest = _look_up_depths(view, points)
        focal = float(view.camera.K[0, 0])
        here = (depth >= (1 - ALIKE) * nearest) & (depth <= (1 + ALIKE) * farthest)
        through = depth < (1 - BEFORE) * nearest
        through &= np.isfinite(nearest)
        on[index[here]] += 1
        before[index[through]] += 1
        resolution[index[here]] = np.maximum(resolution[index[here]], focal / depth[here])
        veiled[index[through]] = np.maximum(veiled[index[through]], focal / nearest[through])
    return PointVisibility(resolution, on, before, veiled)


def _depth_view(gaussians: GaussianArrays, camera: CameraEstimate) -> DepthView:
    height, width = camera.height, camera.width
    if not len(gaussians):
        return DepthView(camera, np.full((height, width), np.inf, np.float32), np.zeros((height, width), np.float32))
    rendered = render_arrays(gaussians, camera.T_world_camera, camera.K, width, height, channels=("depth",))
    solid = (rendered.alpha >= SOLID) & (rendered.depth > 0)
    nearest = np.where(solid, rendered.depth, np.float32(np.inf)).astype(np.float32)
    farthest = np.where(solid, rendered.depth, np.float32(0)).astype(np.float32)
    eroded, dilated = cv2.erode(nearest, _AROUND), cv2.dilate(farthest, _AROUND)
    return DepthView(camera, np.asarray(eroded, np.float32), np.asarray(dilated, np.float32))


def _look_up_depths(
    view: DepthView, points: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.intp], Array, Array, Array]:
    """Looks up the points (M, 3) inside the image: returns indices, depths, and the nearest and farthest surface."""
    camera = view.camera
    local = transform_to_camera(points.astype(np.float64), camera.T_world_camera)
    ahead = np.flatnonzero(local[:, 2] > NEAR)
    x, y, z = local[ahead].T
    columns = np.floor(camera.K[0, 0] * x / z + camera.K[0, 2])
    rows = np.floor(camera.K[1, 1] * y / z + camera.K[1, 2])
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    at = rows[inside].astype(np.intp), columns[inside].astype(np.intp)
    nearest, farthest = view.nearest[at].astype(np.float64), view.farthest[at].astype(np.float64)
    return ahead[inside], z[inside], nearest, farthest


# Regions of space, and which submap sees each best: voxels whose size follows the resolution of the views.


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


# The verb merge.

EXIT_GOOD, EXIT_REFUSED = 0, 65
Reports = dict[str, dict[str, object]]
_LEVELS_BYTES = 0.5  # of a result, for its coarser levels


def merge(args: argparse.Namespace) -> int:
    """Writes map-NAME for each map of the node's results; what cannot be merged is told."""
    reports = write_maps(args.folder, args.out or args.folder, partial(compute_gaussian_limit, args), quiet=args.json)
    if args.json:
        print(json.dumps(reports))
    return EXIT_GOOD if reports else EXIT_REFUSED


def write_maps(
    folder: Path, out: Path, most: Callable[[Sequence[Submap]], int | None], quiet: bool, least: int = 1
) -> Reports:
    """Writes the merged result of each map of the scenes in `folder` into `out`; their reports by their folders.

    `most` says how many Gaussians the map of these submaps may have; maps of fewer than `least` scenes are left out.
    Raises FileNotFoundError, SceneFileError,
    ResultWriteError.
    """
    whole = read_map_set(folder)
    reports = {}
    for each in whole.maps:
        if len(each.placements) < least:
            continue
        with show_waiting(f"reading the scenes of {each.name}"):
            found = load_submaps(whole, each)
        if not found.used:
            reasons = "; ".join(f"{scene_id}: {why}" for scene_id, why in found.left_out.items())
            if not quiet:
                say(f"{each.name}: nothing to merge ({reasons})")
            continue
        merged_into = make_merged_path(out, each)
        with show_waiting(f"merging {len(found.used)} scenes into {merged_into.name}"):
            reports[merged_into.name] = write_map(whole, each, found, merged_into, most(found.used))
        if not quiet:
            _print_report(reports[merged_into.name], merged_into)
    return reports


def write_map(whole: MapSet, of: JoinedMap, found: Submaps, folder: Path, most: int | None) -> dict[str, object]:
    """Writes the merged result of one map, whole or not at all; returns its report. Raises ResultWriteError."""
    given = sum(len(each.gaussians) for each in found.used)
    with hold_result_folder(
        folder, round((1 + _LEVELS_BYTES) * estimate_result_bytes(given if most is None else min(given, most)))
    ):
        one = merge_submaps(found.used, most)
        snapshot = _snapshot(one, found, *scale_and_up(whole, of, [each.scene_id for each in found.used]))
        coarse = make_detail_levels(one.gaussians)
        report = _report(snapshot, one, found, coarse, given)
        write_result(
            snapshot,
            folder,
            report,
            preview=make_contact_sheet(snapshot),
            further=_encode_extra_files(snapshot, one, coarse),
        )
    return report


def compute_gaussian_limit(args: argparse.Namespace, submaps: Sequence[Submap]) -> int | None:
    """How many Gaussians a merged scene may have by both limits; None: there is none."""
    bases = max(each.gaussians.sh.shape[1] for each in submaps)
    by_size = None if args.max_mb is None else compute_max_gaussians(round(args.max_mb * 1e6), bases)
    return min((limit for limit in (args.max_gaussians, by_size) if limit is not None), default=None)


def _snapshot(one: MergedScene, found: Submaps, scale: Scale, up: Up | None) -> Snapshot:
    rough = [each.verdict for each in found.used if each.verdict != Code.OK.value]
    names = ", ".join(each.scene_id for each in found.used)
    message = f"One scene of {len(found.used)}: {names}."
    if rough:
        message += f" {len(rough)} of them known less well: {', '.join(sorted(set(rough)))}."
    verdict = Verdict(Code.OK_ROUGH if rough else Code.OK, message, "", publishable=True)
    seconds = dict(one.seconds)
    return Snapshot(0, verdict, one.cameras, one.gaussians, {}, (), 0, seconds, final=True, scale=scale, up=up)


def _report(
    snapshot: Snapshot, one: MergedScene, found: Submaps, coarse: Sequence[DetailLevel], given: int
) -> dict[str, object]:
    report = build_report(snapshot, seed=0, preset="merge", peak_rss_mb=peak_rss_mb())
    return report | {
        "scenes": [share.record() for share in one.shares],
        "scenes_left_out": [{"scene": scene_id, "reason": why} for scene_id, why in found.left_out.items()],
        "gaussians_given": given,
        "far_shell": one.shell,
        **make_levels_record(coarse, snapshot.cameras),
    }


def _encode_extra_files(snapshot: Snapshot, one: MergedScene, coarse: Sequence[DetailLevel]) -> dict[str, bytes]:
    """levels/1.ply and so on, levels.json (from how far away each suffices), each submap's piece, and depth.npz."""
    parts = {f"levels/{number}.ply": sanitize_gaussians(each.gaussians) for number, each in enumerate(coarse, 1)}
    source = one.gaussians.source_frame
    numbers = {each.scene_id: number for number, each in enumerate(one.shares)} | {SHELL_PIECE: SHELL}
    parts |= {
        make_piece_name(each): select_gaussians(one.gaussians, source == number) for each, number in numbers.items()
    }
    levels_file = json_bytes(snapshot.scale.record() | make_levels_record(coarse, snapshot.cameras))
    depths = {DEPTHS: encode_depths(one.depths)} if one.depths else {}
    return (
        {name: encode_ply(part, snapshot.scale) for name, part in parts.items()} | {LEVELS_FILE: levels_file} | depths
    )


def _print_report(report: dict[str, object], folder: Path) -> None:
    verdict, scenes = report["verdict"], report["scenes"]
    assert isinstance(verdict, dict) and isinstance(scenes, list)
    say(f"{verdict['code']}: {verdict['message']}")
    for each in scenes:
        say(f"{each['scene']}: {each['kept']} of {each['gaussians']} Gaussians kept")
    left_out = report["scenes_left_out"]
    assert isinstance(left_out, list)
    for each in left_out:
        say(f"left out: {each['scene']}: {each['reason']}")
    shell = f"{report['far_shell']} of them the far shell"
    say(f"{report['num_gaussians']} of {report['gaussians_given']} Gaussians ({shell})")
    say(f"results: {folder}/ (scene.ply, levels/, cameras.json, preview.png, report.json)")
