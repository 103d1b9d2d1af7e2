"""A submap: one finished scene, in the world of the map that it is part of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.depth_file import read_depths
from splatnode.recon.result.export import SceneFileError
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.placement import Placement
from splatnode.recon.result.shell import find_far_shell
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.result.verdict import SURE
from splatnode.recon.result.whole import JoinedMap, MapSet, SubmapEntry


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
