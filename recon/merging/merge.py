"""One scene out of the submaps of a map."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.merging.fit import fit_gaussians
from splatnode.recon.merging.seams import resolve_seams
from splatnode.recon.merging.submap import Submap
from splatnode.recon.result.coarser import concatenate_gaussians
from splatnode.recon.result.export.prepare import sanitize_gaussians, select_gaussians
from splatnode.recon.result.placement import Placement
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.scene.background import SHELL

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
