"""Where the person looks from: orbit, pan, zoom, and the viewpoints that a scene suggests. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.viewer.state import Moment

Array = npt.NDArray[np.float64]

_STEEPEST = math.radians(85.0)  # of a viewing direction, from the horizontal
_SLANT = math.radians(50.0)  # at which a map is looked down on
_NEAREST = 1e-3  # world units, of the pivot
_SHALLOWEST = 0.1  # world units, of the pivot that a camera's viewpoint is given
_LENS = np.array([[0.9, 0.0, 0.5], [0.0, 0.9, 0.375], [0.0, 0.0, 1.0]]), 1.0, 0.75  # where no camera suggests one


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A camera that the person moves. The pivot is `distance` ahead of it; orbits go around it."""

    T_world_camera: Array  # (4, 4)
    distance: float
    up: Array  # (3,) unit, the world's
    lens: tuple[Array, float, float]  # K (3, 3), width, height: what has to fit into the window

    @property
    def pivot(self) -> Array:
        return self.T_world_camera[:3, 3] + self.distance * self.T_world_camera[:3, 2]

    def K(self, width: int, height: int) -> Array:
        """(3, 3) for a window in which the lens's image lies in the middle, as large as it fits."""
        K, lens_width, lens_height = self.lens
        scale = min(width / lens_width, height / lens_height)
        margin = np.array([width - scale * lens_width, height - scale * lens_height]) / 2.0
        fitted = K.copy()
        fitted[:2] *= scale
        fitted[:2, 2] += margin
        return fitted


def look_at(centre: Array, target: Array, up: Array) -> Array:
    """(4, 4) T_world_camera at `centre` that looks at `target`, with `up` pointing up in the image."""
    forward = (target - centre) / max(float(np.linalg.norm(target - centre)), 1e-12)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:  # straight up or down: any direction to the right will do
        right = np.cross(forward, np.roll(up, 1))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3] = np.column_stack([right, np.cross(forward, right), forward, centre])
    return T


def orbit(view: Viewpoint, right_rad: float, up_rad: float) -> Viewpoint:
    """After a walk around the pivot: to the right around the world's up, then upwards, not over the pole."""
    outwards = (view.T_world_camera[:3, 3] - view.pivot) / view.distance
    elevation = math.asin(float(np.clip(outwards @ view.up, -1.0, 1.0)))
    raised = float(np.clip(elevation + up_rad, -_STEEPEST, _STEEPEST)) if abs(elevation) < _STEEPEST else elevation
    turned = _rotation(view.up, right_rad) @ outwards
    flat = turned - (turned @ view.up) * view.up
    flat /= max(float(np.linalg.norm(flat)), 1e-12)
    direction = math.cos(raised) * flat + math.sin(raised) * view.up
    return replace(view, T_world_camera=look_at(view.pivot + view.distance * direction, view.pivot, view.up))


def pan(view: Viewpoint, right_px: float, down_px: float, focal_px: float) -> Viewpoint:
    """After a drag of the scene by pixels: what is at the pivot's distance stays under the pointer."""
    T = view.T_world_camera.copy()
    T[:3, 3] -= view.distance / focal_px * (right_px * T[:3, 0] + down_px * T[:3, 1])
    return replace(view, T_world_camera=T)


def zoom(view: Viewpoint, factor: float) -> Viewpoint:
    """Returns the view with its distance to the pivot multiplied by `factor`."""
    distance = max(view.distance * factor, _NEAREST)
    T = view.T_world_camera.copy()
    T[:3, 3] = view.pivot - distance * T[:3, 2]
    return replace(view, T_world_camera=T, distance=distance)


def move_to_camera(view: Viewpoint, camera: CameraEstimate) -> Viewpoint:
    """The viewpoint of an estimated camera, with its lens."""
    lens = camera.K, float(camera.width), float(camera.height)
    return replace(view, T_world_camera=camera.T_world_camera, lens=lens)


def set_pivot_depth(view: Viewpoint, pivot: Array) -> Viewpoint:
    """The same picture, with the point that orbits go around as deep as the `pivot` (3,)."""
    depth = float((pivot - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, 2])
    return replace(view, distance=max(depth, _SHALLOWEST))


def first_view(moment: Moment) -> Viewpoint:
    """From the camera in the middle of the others, which saw what is shown; of a map, or without cameras, outside."""
    view, cameras = overview(moment), moment.snapshot.cameras
    if moment.graph is not None or not cameras:
        return view
    centres = np.array([camera.T_world_camera[:3, 3] for camera in cameras])
    middle = cameras[int(np.linalg.norm(centres - centres.mean(0), axis=1).argmin())]
    return set_pivot_depth(move_to_camera(view, middle), scene_pivot(moment))


def overview(moment: Moment, also: Sequence[Array] = ()) -> Viewpoint:
    """From behind and above the cameras, at the middle of what they see; the points (3,) `also` are in the picture."""
    cameras = moment.snapshot.cameras
    if moment.graph is not None and cameras:
        return _map_overview(cameras)
    up, pivot = scene_up(cameras), scene_pivot(moment)
    if not cameras:
        spread = scene_spread(moment, pivot)
        centre = pivot - np.array([0.0, 0.0, 2.5 * spread]) + 0.5 * spread * up
        return Viewpoint(look_at(centre, pivot, up), float(np.linalg.norm(centre - pivot)), up, _LENS)
    centres = np.array([camera.T_world_camera[:3, 3] for camera in cameras])
    backwards = centres.mean(0) - pivot
    middle = cameras[len(cameras) // 2]
    lens = middle.K, float(middle.width), float(middle.height)
    slope = np.array([middle.width, middle.height]) / (2.0 * middle.K[[0, 1], [0, 1]])
    seen = np.array([*centres, *also])
    for factor in np.arange(1.3, 4.0, 0.15):  # as close as it can be with every camera in the picture
        centre = pivot + factor * (backwards + 0.25 * float(np.linalg.norm(backwards)) * up)
        view = Viewpoint(look_at(centre, pivot, up), float(np.linalg.norm(centre - pivot)), up, lens)
        local = (seen - centre) @ view.T_world_camera[:3, :3]
        if (np.abs(local[:, :2]) < 0.93 * slope * local[:, 2:]).all():
            break
    return view


def _map_overview(cameras: tuple[CameraEstimate, ...]) -> Viewpoint:
    """From above at a slant, along the shorter side of where the cameras were, with all of them in the picture."""
    up = scene_up(cameras)
    centres = np.array([camera.T_world_camera[:3, 3] for camera in cameras])
    pivot = (centres.max(0) + centres.min(0)) / 2.0
    flat = (centres - centres.mean(0)) @ (np.eye(3) - np.outer(up, up))
    shorter = np.cross(up, np.linalg.svd(flat, full_matrices=False)[2][0])
    length = float(np.linalg.norm(shorter))
    away = shorter / length if length > 1e-6 else -cameras[0].T_world_camera[:3, 2]
    reach = max(float(np.linalg.norm(centres - pivot, axis=1).max()), 0.5)
    middle = cameras[len(cameras) // 2]
    lens = middle.K, float(middle.width), float(middle.height)
    slope = min(middle.width / middle.K[0, 0], middle.height / middle.K[1, 1]) / 2.0
    distance = reach * math.hypot(1.0, 1.0 / slope)
    centre = pivot + distance * (math.sin(_SLANT) * up + math.cos(_SLANT) * away)
    return Viewpoint(look_at(centre, pivot, up), distance, up, lens)


def scene_up(cameras: tuple[CameraEstimate, ...]) -> Array:
    """(3,) people hold cameras upright: the mean of their upward axes; the first camera's where there are none."""
    if not cameras:
        return np.array([0.0, -1.0, 0.0])
    total = np.sum([-camera.T_world_camera[:3, 1] for camera in cameras], axis=0)
    length = float(np.linalg.norm(total))
    return total / length if length > 1e-6 else -cameras[0].T_world_camera[:3, 1]


def scene_pivot(moment: Moment) -> Array:
    """(3,) the middle of what the cameras see: ahead of their middle, at the median depth of the Gaussians."""
    cameras, means = moment.snapshot.cameras, moment.snapshot.gaussians.means
    if not cameras:
        return np.median(means, axis=0).astype(np.float64) if len(means) else np.array([0.0, 0.0, 1.0])
    centre = np.mean([camera.T_world_camera[:3, 3] for camera in cameras], axis=0)
    forward = np.sum([camera.T_world_camera[:3, 2] for camera in cameras], axis=0)
    if np.linalg.norm(forward) < 0.3 * len(cameras):  # cameras all around: they look inwards or outwards
        return np.median(means, axis=0).astype(np.float64) if len(means) else centre
    forward /= np.linalg.norm(forward)
    depths = (means - centre) @ forward
    ahead = depths[depths > 0]
    return centre + (float(np.median(ahead)) if len(ahead) else 1.0) * forward


@lru_cache(maxsize=1)  # of the moment that is shown: all its pictures ask for it
def scene_depth(moment: Moment) -> float:
    """How far what the cameras see is from their middle; 1, which it is about, where lengths are no metres."""
    cameras = moment.snapshot.cameras
    if not moment.snapshot.scale.metric or not cameras:
        return 1.0
    middle = np.mean([camera.T_world_camera[:3, 3] for camera in cameras], axis=0)
    return float(np.linalg.norm(scene_pivot(moment) - middle)) or 1.0


def scene_spread(moment: Moment, pivot: Array) -> float:
    """The median distance of the Gaussians from the pivot; 1 where there are none."""
    means = moment.snapshot.gaussians.means
    return float(np.median(np.linalg.norm(means - pivot, axis=1))) or 1.0 if len(means) else 1.0


def _rotation(axis: Array, angle: float) -> Array:
    """(3, 3) rotation by Rodrigues' formula; `axis` is a unit vector."""
    cross = np.cross(np.eye(3), axis)  # cross @ v is axis x v
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


# The picture that is being painted: colours, and how far what they show is away.

FloatArray = npt.NDArray[np.floating]
Image = npt.NDArray[np.uint8]  # (H, W, 3) RGB

BACKGROUND = (24, 26, 30)
NEAR = 0.005  # world units: nothing closer is drawn


@dataclass(frozen=True, eq=False)
class Canvas:
    image: Image
    depth: npt.NDArray[np.float32]  # (H, W) z of what is there, infinite where there is nothing


def empty_canvas(width: int, height: int) -> Canvas:
    return Canvas(np.full((height, width, 3), BACKGROUND, np.uint8), np.full((height, width), np.inf, np.float32))


def project(points: FloatArray, view: Viewpoint, width: int, height: int) -> FloatArray:
    """(M, 3) pixel x, pixel y and z of world points (M, 3) in the window."""
    local = transform_to_camera(points, np.linalg.inv(view.T_world_camera))
    z = np.where(np.abs(local[:, 2]) > 1e-9, local[:, 2], 1e-9)
    homogeneous = local @ view.K(width, height).T
    return np.column_stack([homogeneous[:, :2] / z[:, None], local[:, 2]])


def transform_to_camera(points: FloatArray, T_camera_world: FloatArray) -> FloatArray:
    """(..., 3) world points in the camera's frame."""
    return points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
