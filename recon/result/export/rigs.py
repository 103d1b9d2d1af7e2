"""Rigs and frames as COLMAP has them since 3.12: which cameras keep their relative poses, and what they took together.

A camera whose images do not keep their relative poses, or have several lenses, is a rig of its own: what COLMAP reads
must have the poses that were estimated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.snapshot import CameraEstimate

_TURNED, _MOVED = 1e-4, 1e-4  # radians, and parts of the spread of all cameras, by which relative poses may differ

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ExportedRig:
    """A rig: T_sensor_rig (4, 4) by COLMAP camera; the first is the reference, whose pose is the rig's."""

    sensors: Mapping[int, Array]


@dataclass(frozen=True, eq=False)
class ExportedFrame:
    """The images that a rig took at one time."""

    rig: int  # its place among the rigs
    T_rig_world: Array  # (4, 4)
    images: Sequence[int]  # the places of its images among the cameras


def find_rigs(
    cameras: Sequence[CameraEstimate], sensor_of: Sequence[int]
) -> tuple[list[ExportedRig], list[ExportedFrame]]:
    """The rigs of images, each of COLMAP's camera `sensor_of`, and their frames; every image is in one frame."""
    by_set = _group_by_set(cameras, sensor_of)
    together = _find_rigid_sensors(cameras, sensor_of, by_set)
    rigs = [ExportedRig(together)] if len(together) > 1 else []
    rigs += [
        ExportedRig({sensor: np.eye(4)})
        for sensor in dict.fromkeys(sensor_of)
        if len(rigs) == 0 or sensor not in together
    ]
    rig_of = {sensor: place for place, rig in enumerate(rigs) for sensor in rig.sensors}
    frames, done = [], set()
    for images in by_set.values():
        kept = [image for image in images if len(together) > 1 and sensor_of[image] in together]
        if len(kept) > 1:
            frames.append(_make_frame(cameras, sensor_of, rigs, rig_of, kept))
            done.update(kept)
    frames += [_make_frame(cameras, sensor_of, rigs, rig_of, [i]) for i in range(len(cameras)) if i not in done]
    return rigs, sorted(frames, key=lambda frame: min(frame.images))


def _group_by_set(cameras: Sequence[CameraEstimate], sensor_of: Sequence[int]) -> dict[int, list[int]]:
    """The images of each frame set, at most one of a sensor."""
    found: dict[int, list[int]] = {}
    for place, camera in enumerate(cameras):
        if camera.frame_set is not None:
            images = found.setdefault(camera.frame_set, [])
            if all(sensor_of[other] != sensor_of[place] for other in images):
                images.append(place)
    return found


def _find_rigid_sensors(
    cameras: Sequence[CameraEstimate], sensor_of: Sequence[int], by_set: Mapping[int, Sequence[int]]
) -> dict[int, Array]:
    """T_sensor_rig of the sensors that keep their poses to the one with most images, which is first."""
    ids: dict[str, set[int]] = {}
    for camera, sensor in zip(cameras, sensor_of, strict=True):
        ids.setdefault(camera.camera_id, set()).add(sensor)
    single = {sensor for camera_id, sensors in ids.items() if camera_id and len(sensors) == 1 for sensor in sensors}
    if not single:
        return {}
    reference = max(sorted(single), key=list(sensor_of).count)
    centres = np.array([camera.T_world_camera[:3, 3] for camera in cameras])
    spread = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
    found = {reference: np.eye(4)}
    for sensor in sorted(single - {reference}):
        relative = []
        for images in by_set.values():
            of = {sensor_of[image]: cameras[image].T_world_camera for image in images}
            if sensor in of and reference in of:
                relative.append(np.linalg.inv(of[sensor]) @ of[reference])
        if relative and all(_is_same(relative[0], other, spread) for other in relative):
            found[sensor] = relative[0]
    return found


def _is_same(one: Array, other: Array, spread: float) -> bool:
    turned = np.abs(one[:3, :3] - other[:3, :3]).max() <= _TURNED
    return bool(turned and np.abs(one[:3, 3] - other[:3, 3]).max() <= _MOVED * spread)


def _make_frame(
    cameras: Sequence[CameraEstimate],
    sensor_of: Sequence[int],
    rigs: Sequence[ExportedRig],
    rig_of: Mapping[int, int],
    images: Sequence[int],
) -> ExportedFrame:
    rig = rig_of[sensor_of[images[0]]]
    reference = next(iter(rigs[rig].sensors))
    chosen = next((image for image in images if sensor_of[image] == reference), images[0])
    T_sensor_rig = rigs[rig].sensors[sensor_of[chosen]]
    T_rig_world = np.linalg.inv(cameras[chosen].T_world_camera @ T_sensor_rig)
    return ExportedFrame(rig, np.asarray(T_rig_world, np.float64), images)
