"""A tour that swings around the scene, inside the arc from which it was photographed and above the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.viewer.ground import Ground, ground
from splatnode.viewer.moment import Moment
from splatnode.viewer.viewpoint import Viewpoint, look_at, overview

Array = npt.NDArray[np.float64]

_WIDEST = math.radians(60.0), math.radians(20.0)  # to either side, and up and down
_ALONE = math.radians(6.0), math.radians(3.0)  # around a single camera, or where none is known
_CLEARANCE = 0.02  # of the distance to the scene: no lower above the ground


@dataclass(frozen=True, eq=False)
class Arc:
    """The arc of the cameras, as seen from the pivot: angles in radians around `up`, and above the level."""

    azimuths: tuple[float, float]  # least and greatest, from the direction of the cameras' mean
    elevations: tuple[float, float]
    distance: float  # the median


def turntable_views(moment: Moment, frames: int) -> list[Viewpoint]:
    """A closed tour, `frames` long, around the pivot: an ellipse within the arc that was seen, and above the ground.

    A full circle would mostly show what no photograph shows.
    """
    start, cameras, below = overview(moment), moment.snapshot.cameras, ground(moment)
    level = _mean_level_direction(cameras, start) if cameras else None
    if level is None or len(cameras) < 2:
        width, height, level = *_ALONE, (start.T_world_camera[:3, 3] - start.pivot) / start.distance
        middle, distance = (0.0, math.asin(float(np.clip(level @ start.up, -1.0, 1.0)))), start.distance
        level = _project_to_level(level, start.up)
    else:
        arc = compute_arc(cameras, start.pivot, start.up)
        (left, right), (low, high), distance = arc.azimuths, arc.elevations, arc.distance
        width, height = min((right - left) / 2.0, _WIDEST[0]), min((high - low) / 2.0, _WIDEST[1])
        middle = (left + right) / 2.0, (low + high) / 2.0
    angles = 2.0 * np.pi * np.arange(frames) / frames
    return [
        _view(start, level, middle[0] + width * math.sin(a), middle[1] + height * math.cos(a), distance, below)
        for a in angles
    ]


def compute_arc(cameras: tuple[CameraEstimate, ...], pivot: Array, up: Array) -> Arc:
    """The arc of at least one camera's centre around the `pivot` (3,)."""
    offsets = np.array([camera.T_world_camera[:3, 3] for camera in cameras]) - pivot
    distances = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    level = _project_to_level(offsets.mean(0), up)
    azimuths = np.arctan2(offsets @ np.cross(up, level), offsets @ level)
    elevations = np.arcsin(np.clip(offsets @ up / distances, -1.0, 1.0))
    return Arc(
        (float(azimuths.min()), float(azimuths.max())),
        (float(elevations.min()), float(elevations.max())),
        float(np.median(distances)),
    )


def _mean_level_direction(cameras: tuple[CameraEstimate, ...], start: Viewpoint) -> Array:
    """(3,) the level direction from the pivot to the middle of the cameras."""
    centres = np.array([camera.T_world_camera[:3, 3] for camera in cameras])
    return _project_to_level(centres.mean(0) - start.pivot, start.up)


def _project_to_level(direction: Array, up: Array) -> Array:
    flat = direction - (direction @ up) * up
    if np.linalg.norm(flat) < 1e-9:  # straight above: any level direction will do
        flat = np.cross(up, np.roll(up, 1))
    return flat / max(float(np.linalg.norm(flat)), 1e-12)


def _view(
    start: Viewpoint, level: Array, azimuth: float, elevation: float, distance: float, below: Ground | None
) -> Viewpoint:
    """At these angles around the pivot; as much higher as keeps it above the ground."""
    side = np.cross(start.up, level)
    outwards = math.cos(elevation) * (math.cos(azimuth) * level + math.sin(azimuth) * side)
    centre = start.pivot + distance * (outwards + math.sin(elevation) * start.up)
    if below is not None:
        centre = centre + max(_CLEARANCE * distance - below.height(centre), 0.0) * start.up
    return replace(start, T_world_camera=look_at(centre, start.pivot, start.up), distance=distance)
