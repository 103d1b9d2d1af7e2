"""occupancy_map: a snapshot's cameras and confirmed depths, as a map of three states."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.occupancy.carving import carve_free_space, ignore_cancel
from splatnode.recon.occupancy.layout import choose_layout
from splatnode.recon.occupancy.occupancy_map import OccupancyMap, VoxelState
from splatnode.recon.occupancy.sight import DepthObservation, make_depth_observations
from splatnode.recon.occupancy.surfaces import find_surface_voxels, thicken_points
from splatnode.recon.occupancy.upright import upright
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import SURE

UNSURE_DEG = 3.0  # standard deviation of up by gravity, beyond which the floor tells it better
MOST_SAMPLED = 4_000_000  # surface points by which the map is laid out and its floor found; about 80 photographs
LEAST_KNOWN = 0.01  # of the pixels: with fewer confirmed depths there is no map


class NoMap(ValueError):
    """A result has no map; the text says why, and what to do."""

    exit_code = 65


def occupancy_map(
    snapshot: Snapshot,
    voxel: float | None = None,
    up: npt.NDArray[np.float64] | None = None,
    pause: Callable[[], None] = ignore_cancel,
) -> OccupancyMap:
    """The map of what the photographs show at depths that two of them confirm; nothing else makes a voxel known.

    A voxel is free where a camera looks through all of it, and occupied where a confirmed surface is in it, which
    counts for more. `voxel` is its side in the result's unit; None: a 64th of the median depth. `up` (3,) is the
    direction of up in the world; None: gravity tells it, where the snapshot knows it. `pause` is called several times
    a second, and may raise to abandon the work. Raises NoMap, and ValueError for arguments that cannot be used.
    """
    seen = _load_depth_observations(snapshot)
    points, unit = _sample(seen)
    told, how = _up(snapshot) if up is None else (up, "given")
    frame = upright([camera.T_world_camera for camera in snapshot.cameras], points, told, unit, how)
    T = frame.T_world_map
    centres = np.stack([camera.T_world_camera[:3, 3] for camera in snapshot.cameras])
    layout = choose_layout(
        _transform_to_map(points, T), _transform_to_map(centres, T), unit, snapshot.scale.metric, voxel
    )
    states = np.zeros(layout.shape, np.uint8)
    for sight in seen:
        states[carve_free_space(sight, layout, T, pause)] = VoxelState.FREE
    pause()
    states[find_surface_voxels((_transform_to_map(thicken_points(sight), T) for sight in seen), layout)] = (
        VoxelState.OCCUPIED
    )
    return OccupancyMap(states, layout.voxel, layout.origin, frame, snapshot.scale)


def _sample(seen: Sequence[DepthObservation]) -> tuple[npt.NDArray[np.float64], float]:
    """World points (M, 3) of what was seen, all or evenly MOST_SAMPLED of them, and their median depth."""
    each = -(-sum(int(np.count_nonzero(sight.depth)) for sight in seen) // MOST_SAMPLED)
    depths = np.concatenate([sight.depth[sight.depth > 0][::each] for sight in seen])
    return np.concatenate([sight.points[::each] for sight in seen]), float(np.median(depths))


def _up(snapshot: Snapshot) -> tuple[npt.NDArray[np.float64] | None, str]:
    """Returns up by gravity, and its source; none where it is unknown, or too unsure to keep the floor level."""
    up = snapshot.up
    return (None, "") if up is None or up.sigma_deg > UNSURE_DEG else (np.array(up.direction), up.source)


def _transform_to_map(points: npt.NDArray[np.float64], T_world_map: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return (points - T_world_map[:3, 3]) @ T_world_map[:3, :3]


def _load_depth_observations(snapshot: Snapshot) -> list[DepthObservation]:
    """Makes the depth observations of a scene that a map may be made of. Raises NoMap."""
    verdict = snapshot.verdict
    if not verdict.publishable:
        raise NoMap(f"there is no map of a scene that was refused: {verdict.code.value}. {verdict.message}")
    if verdict.code not in SURE and not snapshot.scenes:  # a merged one has depths of its sure scenes alone
        raise NoMap(
            f"the verdict is {verdict.code.value}: the scene can be looked at, but a map of it could call free what is "
            f"solid. {verdict.advice or 'Take more photographs'}"
        )
    if not snapshot.depths:
        raise NoMap(
            "it is not known which depths two photographs confirm: the result has no depth.npz. An earlier splatnode "
            "made it, or it is a scene file, or not final, or merged of scenes that are all known roughly. Reconstruct "
            "the photographs again"
        )
    seen = make_depth_observations(snapshot.cameras, snapshot.depths)
    known = sum(int((sight.depth > 0).sum()) for sight in seen)
    if known < LEAST_KNOWN * sum(sight.depth.size for sight in seen) or not known:
        raise NoMap("next to no depth is confirmed by two photographs: give photographs that share more of the scene")
    return seen
