"""A submap: one finished scene, in the world of the map that it is part of."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from splatnode.capture.process.text import LONGEST_TEXT, sanitize_text
from splatnode.recon.result.export import SceneFileError
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.levels_of_detail import find_far_shell
from splatnode.recon.result.npz_files import read_depths
from splatnode.recon.result.placement import Placement
from splatnode.recon.result.reference_frame import ReferenceFrame
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, format_rounded_up
from splatnode.recon.result.stored_snapshot import read_up
from splatnode.recon.result.submap_index import JoinedMap, MapSet, SubmapEntry, group_edges, walk_edges
from splatnode.recon.result.verdict import SURE, TWO_SIDED_95, Scale, Up


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
        place = whole.places[scene_id]
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
    place = whole.places.get(of.name)
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
    told = f"{scale.source or 'metres'}, in {first}; {scenes} on it by links, "
    if scale.interval_95 is None or worst is None or worst.scale > _MOST_SIGMA:
        return _set_source(
            replace(scale, interval_95=None), f"{told}and how well the metres are known there is not told"
        )
    low, high = scale.interval_95
    of_links = TWO_SIDED_95 * worst.scale
    wider = math.exp(-math.hypot(math.log(low), of_links)), math.exp(math.hypot(math.log(high), of_links))
    told += f"known to {format_rounded_up(100 * (wider[1] - 1.0))} % in all"
    return _set_source(replace(scale, interval_95=wider), told)


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
